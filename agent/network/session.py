"""The door to Zenoh, and the only module that imports it: the topics of one run, as bytes.

Callbacks run on Zenoh's threads, where an exception is printed and lost. So nothing is decoded there: what comes in
is handed over as a duty, for the main thread to do.
"""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from typing import Any

import zenoh

from agent.contract.errors import InputError, RunBroken
from agent.contract.keys import (
    BESIDE,
    COORDINATOR,
    alive,
    key,
    replay,
    run_of,
    sensor_who,
    session,
    speaker_of,
    topic_of,
    watch,
)
from agent.contract.messages import Stamp, Way
from agent.guard import FORGED, UNREADABLE
from agent.network.configuration import Network, zenoh_configuration
from agent.network.outbox import Sent
from agent.network.words import ChannelClosed, Duty, Ignored, Incoming, Quota, Replayed, Sample
from agent.plan import LARGEST_WINDOW

# Zenoh's pools of threads as one. Else what arrives wakes a thread of the pool that has accepted the connection, that
# wakes one of the pool that receives, and an answer one of the pool that sends. But who passes on what others say waits
# on a thread that receives for one that sends: with one pool for both it would wait for itself.
ONE_POOL = "(tx:(handover:rx),net:(handover:rx),acc:(handover:rx),app:(handover:rx))"

CAPACITY = 8 * LARGEST_WINDOW  # messages that a channel holds; a full one would hold up everything on its link
MOST_ANSWERS = 1 << 16  # to one question, that wait; what is left out is asked for again
BLOCK = zenoh.CongestionControl.BLOCK  # the default drops without a word
TRACED = zenoh.TimestampInstrumentationBuilder().set_send(True).set_route(True).build()  # 1 µs a message
DROP = zenoh.CongestionControl.DROP  # what viewers get: one that stands still must hold up nobody


class Channel:
    """A topic's messages, in order. They wait in zenoh, without running any Python, until they are asked for.

    Without a `topic` it has what viewers are shown, of every topic.
    """

    def __init__(self, topic: str, handler: Any) -> None:
        self.topic, self._handler = topic, handler

    def next(self) -> Sample:
        """The next message; blocks until there is one. Raises ChannelClosed."""
        try:
            sample = self._handler.recv()
        except zenoh.ZError:
            raise ChannelClosed from None
        return _sample(self.topic or topic_of(str(sample.key_expr)).removeprefix(watch("")), sample)

    def take(self) -> Sample | None:
        """A message that is there already; does not block."""
        sample = self._handler.try_recv()
        return None if sample is None else _sample(self.topic, sample)


class Session:
    """A zenoh session of `who`, opened for `run`; `hand_over` takes the duties, on any thread."""

    def __init__(self, network: Network, *, run: str, who: str, hand_over: Callable[[Duty], None]) -> None:
        self._run, self._who, self._hand_over = run, who, hand_over
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._shown: dict[str, zenoh.Publisher] = {}  # the same for viewers
        self._watched: dict[str, bool] = {}  # whether a viewer is there
        self._declared: list[Any] = []  # zenoh drops what nobody holds
        self._kind = network.kind
        hosts = who == COORDINATOR and (network.sockets is None or network.hosts)  # clients may be there
        self.traced = False  # whether messages are to say when they were where
        self._largest = network.largest
        with nullcontext() if network.routes or hosts else _one_pool():
            self._zenoh = _open(network, run)
        self._zid = str(self._zenoh.zid())
        self.identity = f"{time.time_ns():020d}-{self._zid}"  # of two with one name the earlier comes first

    # Data: messages of a topic, and what was missed of them.
    def channel(self, topic: str) -> Channel:
        """Receive a topic's messages."""
        subscriber = self._zenoh.declare_subscriber(key(self._run, topic), zenoh.handlers.FifoChannel(CAPACITY))
        self._declared.append(subscriber)
        return Channel(topic, subscriber.handler)

    def collect(self, topics: Iterable[str]) -> None:
        """Have the messages of several topics handed over, in the order in which they were sent on a link."""

        def hear(sample: zenoh.Sample) -> None:
            self._hand_over(lambda: _sample(topic_of(str(sample.key_expr)), sample))

        for topic in topics:
            handler: Any = zenoh.handlers.Callback(hear, indirect=False)
            self._declared.append(self._zenoh.declare_subscriber(key(self._run, topic), handler))

    def overhear(self) -> Channel:
        """Receive what is shown to viewers, of every topic; what is not taken in time goes, the oldest first."""
        kept: Any = zenoh.handlers.RingChannel(CAPACITY)
        subscriber = self._zenoh.declare_subscriber(key(self._run, watch("**")), kept)
        self._declared.append(subscriber)
        return Channel("", subscriber.handler)

    def advertise(self, topic: str, *, express: bool) -> None:
        """Announce that a topic will be published; an `express` message does not wait for others to go with."""
        self._publishers[topic] = self._zenoh.declare_publisher(
            key(self._run, topic, who=self._who), congestion_control=BLOCK, express=express
        )
        shown = self._shown[topic] = self._zenoh.declare_publisher(
            key(self._run, watch(topic), who=self._who), congestion_control=DROP
        )
        self._watched[topic] = False

        def note(status: zenoh.MatchingStatus) -> None:
            self._watched[topic] = status.matching

        self._declared.append(shown.declare_matching_listener(note))

    def publish(self, sent: Sent) -> None:
        """Send a message of an advertised topic; where a viewer is there, to it too, as long as it keeps up."""
        self._refuse_larger(sent.topic, sent.payload)
        traced = TRACED if self.traced else None
        self._publishers[sent.topic].put(sent.payload, attachment=sent.stamp.encode(), timestamp_instrumentation=traced)
        if self._watched[sent.topic]:
            self._shown[sent.topic].put(sent.payload)

    def offer_replay(
        self, who: str, since: Callable[[int], Iterable[Sent]], *, is_for: Callable[[str, Duty], bool | None]
    ) -> None:
        """Answer requests for the messages of `who` from a number on, of a session that they are for.

        `is_for` is given the request, too: where it says None, it will hand that over once more.
        """
        quota = Quota(CAPACITY)

        def answer(query: zenoh.Query) -> Ignored | None:
            first, by = (query.parameters.get(name) or "" for name in ("from", "by"))
            is_number = first.isdecimal() and first.isascii() and len(first) < 20
            may_ask = is_number and "_anyke" in query.parameters and is_for(by, lambda: answer(query))
            if may_ask is None:
                return Ignored()
            quota.leave()
            with query:
                if not may_ask:
                    return Ignored()  # not the recorder's question
                for sent in since(int(first)):
                    query.reply(key(self._run, sent.topic, who=who), sent.payload, attachment=sent.stamp.encode())
                return None

        def hear(query: zenoh.Query) -> None:
            if quota.enter():
                self._hand_over(lambda: answer(query))
            else:
                query.drop()  # type: ignore[no-untyped-call]  # zenoh leaves it untyped

        self._declared.append(self._zenoh.declare_queryable(key(self._run, replay(who)), hear))

    def request_replay(self, who: str, *, first: int, seconds: float) -> None:
        """Ask `who` for its messages from number `first` on: they come as samples, then Replayed(who)."""

        quota = Quota(MOST_ANSWERS)

        def answered(reply: zenoh.Reply) -> Incoming:
            quota.leave()
            sample = reply.ok
            topic = "" if sample is None else str(sample.key_expr)
            if sample is None or not topic.startswith(key(self._run, "")):
                return Ignored()
            return _sample(topic_of(topic), sample)

        def hear(reply: zenoh.Reply) -> None:
            if quota.enter():
                self._hand_over(lambda: answered(reply))

        self._zenoh.get(
            # answers come under their own keys
            f"{key(self._run, replay(who))}?from={first};by={self.identity};_anyke",
            zenoh.handlers.Callback(hear, lambda: self._hand_over(lambda: Replayed(who))),
            consolidation=zenoh.ConsolidationMode.NONE,  # the default keeps one reply for each key
            timeout=seconds,
        )

    def answer(self, topic: str, payload: bytes) -> None:
        """Answer whoever asks on `topic` with these bytes, from now on."""

        quota = Quota(CAPACITY)

        def reply(query: zenoh.Query) -> Ignored:
            quota.leave()
            with query:
                query.reply(key(self._run, topic), payload)
            return Ignored()

        def hear(query: zenoh.Query) -> None:
            if quota.enter():
                self._hand_over(lambda: reply(query))
            else:
                query.drop()  # type: ignore[no-untyped-call]  # zenoh leaves it untyped

        self._declared.append(self._zenoh.declare_queryable(key(self._run, topic), hear))

    def ask(self, topic: str, decode: Callable[[bytes], Incoming | None], *, seconds: float) -> None:
        """Have whatever is answered on `topic` decoded."""

        def hear(reply: zenoh.Reply) -> None:
            if (sample := reply.ok) is not None:
                self._hand_over(lambda: decode(sample.payload.to_bytes()))

        self._zenoh.get(key(self._run, topic), hear, timeout=seconds)

    def watch_runs(self, found: Callable[[str], None]) -> None:
        """Have every run named whose coordinator is there, whatever run this session is for; on Zenoh's threads."""

        def see(sample: zenoh.Sample) -> None:
            if sample.kind == zenoh.SampleKind.PUT:
                found(run_of(str(sample.key_expr)))

        liveliness = self._zenoh.liveliness()
        self._declared.append(liveliness.declare_subscriber(key("*", alive(COORDINATOR)), see, history=True))

    # Words that run the run.
    def listen(self, topic: str, decode: Callable[[bytes], Incoming | None], *, overflow: Callable[[], None]) -> None:
        """Have every word on `topic` decoded; `overflow` is told of each for which there is no room."""
        quota = Quota(CAPACITY)

        def decoded(payload: bytes) -> Incoming | None:
            quota.leave()
            return decode(payload)

        def hear(sample: zenoh.Sample) -> None:
            payload = sample.payload.to_bytes()
            if quota.enter():
                self._hand_over(lambda: decoded(payload))
            else:
                overflow()

        self._declared.append(self._zenoh.declare_subscriber(key(self._run, topic), hear))

    def say(self, topic: str, payload: bytes) -> None:
        """Send a word."""
        self._refuse_larger(topic, payload)
        self._zenoh.put(key(self._run, topic), payload, congestion_control=BLOCK)

    def _refuse_larger(self, topic: str, payload: bytes) -> None:
        """Say so here: the others would never know."""
        if len(payload) > self._largest:
            raise RunBroken(f"a message on {topic} has {len(payload)} bytes; others take {self._largest} at most")

    def watch(self, see: Callable[[str, str, bool], None]) -> None:
        """Hear of everybody who comes and goes: name, session ("" of a sensor), and whether it is there now.

        `see` is called on zenoh's thread, before anything that the session sends afterwards has come in.
        """

        def hear(sample: zenoh.Sample) -> None:
            _, who, *identity = topic_of(str(sample.key_expr)).split("/")
            see(who, "".join(identity), sample.kind == zenoh.SampleKind.PUT)

        liveliness = self._zenoh.liveliness()
        for topic in (session("*", "*"), alive(sensor_who("$*"))):
            self._declared.append(
                liveliness.declare_subscriber(
                    key(self._run, topic), zenoh.handlers.Callback(hear, indirect=False), history=True
                )
            )

    def appear(self, who: str) -> None:
        """Show the tokens of `who`, until this session is closed or its process ends."""
        for topic in (session(who, self.identity), alive(who)):
            self._declared.append(self._zenoh.liveliness().declare_token(key(self._run, topic)))

    # The session itself.
    def locators(self) -> list[str]:
        """The addresses at which it can be reached; none where it listens nowhere."""
        if self._kind == "client":
            return []
        for reply in self._zenoh.get(f"@/{self._zid}/{self._kind}"):
            if reply.ok is not None:
                return list(json.loads(reply.ok.payload.to_bytes())["locators"])
        raise RunBroken("zenoh does not tell its own address")

    def close(self) -> None:
        """Withdraw what was declared, the last first: where that is the token, the others see us go."""
        with suppress(zenoh.ZError):  # somebody does not answer; what there was to say has been said
            for declared in reversed(self._declared):
                declared.undeclare()
        with suppress(zenoh.ZError):
            self._zenoh.close()  # type: ignore[no-untyped-call]  # zenoh leaves it untyped


def _sample(topic: str, sample: zenoh.Sample) -> Sample:
    attachment, stamp, flaw = sample.attachment, None, ""
    if attachment is not None:
        try:
            stamp = Stamp.decode(attachment.to_bytes())
        except ValueError:
            flaw = UNREADABLE
    if topic in BESIDE and stamp is not None and stamp.sender != speaker_of(str(sample.key_expr)):
        flaw = FORGED
    return Sample(topic, sample.payload.to_bytes(), stamp, flaw, sample.timestamp_stack)


def way_of(trace: Any, at: float) -> Way | None:
    """Where a message that arrived `at`, by time.time(), spent its time; None where it does not say."""
    if trace is None:
        return None
    sent = [_seconds(record) for record in trace.records if record.point == zenoh.InterceptionPoint.SEND]
    routed = [_seconds(record) for record in trace.records if record.point == zenoh.InterceptionPoint.ROUTE]
    if not sent or len(routed) < 2:
        return None
    return Way(routed[0] - sent[0], routed[-1] - routed[0], at - routed[-1])


def _seconds(record: zenoh.TimestampStackRecord) -> float:
    stamp = record.timestamp()
    return stamp.get_time().timestamp() if isinstance(stamp, zenoh.Timestamp) else math.nan


@contextmanager
def _one_pool() -> Iterator[None]:
    """Zenoh reads the variable once, when the first session of a process is opened; no child is to inherit it."""
    is_given = "ZENOH_RUNTIME" in os.environ
    if not is_given:
        os.environ["ZENOH_RUNTIME"] = ONE_POOL
    try:
        yield
    finally:
        if not is_given:
            del os.environ["ZENOH_RUNTIME"]


def _open(network: Network, run: str) -> zenoh.Session:
    """A client is there once it is connected; signals are heeded between its attempts."""
    config, deadline = json.dumps(zenoh_configuration(network, run=run)), time.monotonic() + network.wait
    while True:
        try:
            return zenoh.open(zenoh.Config.from_json5(config))
        except zenoh.ZError as error:
            if network.kind != "client":
                raise _not_open(network, str(error)) from None
        if time.monotonic() >= deadline:
            where = ", ".join(network.connect)
            raise RunBroken(f"nobody answered at {where} within {network.wait:g} s; is the coordinator running there?")


def _not_open(network: Network, reason: str) -> InputError:
    """An address that looks well, and which Zenoh cannot use all the same."""
    cause = "the port is in use" if "in use" in reason else reason.split(" at /")[0]
    if "in use" in reason or "listen" in reason.lower() or not network.connect:
        return InputError(f"cannot listen on {network.listen}: {cause}; port 0 takes a free one")
    return InputError(f"cannot connect to {', '.join(network.connect)}: {cause}")
