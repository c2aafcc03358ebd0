"""One participant's place on the network: publish, subscribe, start together, replay, end together.

The only module that imports zenoh. What makes it lose nothing:

* the start barrier: everybody declares what it receives, then a liveliness token, then waits for all tokens.
  Declarations keep their order on a link, so whoever sees a token knows that peer's subscriptions;
* every data message is numbered and kept until the recorder has acknowledged it, and can be asked for again;
* nobody leaves before the recorder has closed the recording.
"""

from __future__ import annotations

import json
import math
import signal
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from types import FrameType, TracebackType
from typing import Any, NamedTuple, Self, TypeVar

import zenoh

from agent.contract.errors import InputError, Interrupted, RunBroken
from agent.contract.messages import (
    ACKNOWLEDGED,
    CONTROL,
    COORDINATOR,
    RECORDER,
    Acknowledged,
    Control,
    Message,
    Ready,
    Stamp,
    alive,
    in_words,
    key,
    ready,
    replay,
    topic_of,
)
from agent.mailbox import Mailbox

LEASE_MS = 10_000  # a peer that is silent for so long is lost; a killed one is seen in milliseconds
COORDINATOR_LOST = "the coordinator was lost: its process ended, or the network to it failed"
CLOSE_SECONDS = 1.5  # how long a leaving participant waits for the recorder's last word


@dataclass(frozen=True)
class Network:
    """Where to listen, whom to connect to (one peer of the run is enough), how long to wait for the others."""

    listen: str = "tcp/127.0.0.1:0"
    connect: tuple[str, ...] = ()
    wait: float = 30.0


class Sample(NamedTuple):
    """A data message as it came in. `stamp` is None where the sender left it out; `time` is in ns."""

    topic: str
    payload: bytes
    stamp: Stamp | None
    time: int


class Peer(NamedTuple):
    """A participant that has come or gone."""

    who: str
    present: bool


class Replayed(NamedTuple):
    """The answers of `who` to a request for replay are complete."""

    who: str


class Signal(NamedTuple):
    """SIGINT or SIGTERM."""

    number: int


class Raw(NamedTuple):
    """What a callback enqueues: decoded by the main thread, so that a failure ends the process."""

    decode: Callable[[Raw], Incoming]
    topic: str
    content: Any
    time: int


T = TypeVar("T")
Incoming = Sample | Peer | Control | Acknowledged | Ready | Replayed


class RunClosed(Exception):
    """Raised by `Bus.receive` when the run is over; `control` says how."""

    def __init__(self, control: Control) -> None:
        super().__init__(control.reason)
        self.control = control


class Bus:
    """A zenoh session that belongs to participant `who` of run `run`. Use it with `with`."""

    def __init__(self, network: Network, *, run: str, who: str) -> None:
        self.run, self.who, self.network = run, who, network
        self._mailbox = Mailbox()
        self._publishers: dict[str, Any] = {}
        self._declared: list[Any] = []  # zenoh drops what nobody holds
        self._kept: deque[tuple[Stamp, str, bytes]] = deque()  # what the recorder has not acknowledged
        self._published = 0
        self._alone = True
        self._last_word: Acknowledged | None = None  # that the recording is closed
        self._recorder_gone = False
        self._ending: Exception | None = None  # how the run ended for us
        self._early: list[Incoming] = []  # what came while we waited for something else
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._on_signal)
        self._session = _open(network)

    # Declare: first what we receive, then what we send, the token last.
    def subscribe(self, topics: Iterable[str]) -> None:
        """Receive these topics' messages."""
        for topic in topics:
            self._listen(topic, _sample)

    def advertise(self, topics: Iterable[str]) -> None:
        """Announce that these topics will be published, and offer replays of them."""
        queries = _direct(lambda query: self._mailbox.put_urgent(query))
        self._declared.append(self._session.declare_queryable(key(self.run, replay(self.who)), queries))
        for topic in topics:
            self._publishers[topic] = self._session.declare_publisher(
                key(self.run, topic), congestion_control=zenoh.CongestionControl.BLOCK
            )

    def enter(self) -> None:
        """Receive what runs the run, watch the others' tokens, and show our own: the last declaration."""
        if self.who == COORDINATOR:
            self._listen(ready("*"), lambda raw: Ready.model_validate_json(_payload(raw)))
        else:
            self._listen(CONTROL, lambda raw: Control.model_validate_json(_payload(raw)), urgent=True)
        if self.who != RECORDER:
            self._listen(ACKNOWLEDGED, lambda raw: Acknowledged.model_validate_json(_payload(raw)))
        liveliness = self._session.liveliness()
        tokens = key(self.run, alive("*"))
        watch = self._enqueue(tokens, _peer, urgent=True)
        self._declared.append(liveliness.declare_subscriber(tokens, watch, history=True))
        self._declared.append(liveliness.declare_token(key(self.run, alive(self.who))))

    # Start together.
    def meet(self, others: Iterable[str]) -> None:
        """Wait for everybody's token; RunBroken names who is missing when the time is over."""
        absent = set(others) - {self.who}
        deadline = time.monotonic() + self.network.wait
        while absent:
            for item in self._wait_for(Peer, deadline=deadline, missing=absent):
                if item.present:
                    absent.discard(item.who)

    def gather(self, others: Iterable[str]) -> dict[str, Ready]:
        """The coordinator's: wait until everybody has met everybody."""
        answers: dict[str, Ready] = {}
        unready = set(others) - {self.who}
        deadline = time.monotonic() + self.network.wait
        while unready:
            for item in self._wait_for(Ready, deadline=deadline, missing=unready):
                answers[item.who] = item
                unready.discard(item.who)
        return answers

    def report_ready(self, gains: str) -> None:
        """Tell the coordinator that we have met everybody, and which gains we run on."""
        self._put(ready(self.who), Ready(who=self.who, gains=gains))

    def wait_for_start(self) -> Control:
        """The coordinator's order to start, with the facts of the run."""
        deadline = time.monotonic() + self.network.wait
        return self._wait_for(Control, deadline=deadline, missing={COORDINATOR})[0]

    # Run.
    def publish(self, topic: str, message: Message) -> None:
        """Send a data message, and keep it until the recorder has it."""
        payload = message.encode()
        stamp = Stamp(self._published, time.time_ns(), self.who)
        self._published += 1
        self._kept.append((stamp, topic, payload))
        self._publishers[topic].put(payload, attachment=stamp.encode())

    def receive(self, wanted: int = 1, *, timeout: float = math.inf) -> list[Incoming]:
        """Messages, once `wanted` are there; fewer where something urgent came or `timeout` has passed.

        Raises RunClosed when the coordinator ends the run, RunBroken when the coordinator is lost, and
        Interrupted on a signal; what came before is returned first.
        """
        if not self._early and self._ending is None:
            self._early = self._take(wanted, timeout=timeout)
        if not self._early and self._ending is not None:
            raise self._ending
        items, self._early = self._early, []
        for item in items:
            if isinstance(item, Control):
                self._ending = self._ending or RunClosed(item)
            if isinstance(item, Peer) and not item.present and item.who == COORDINATOR:
                self._ending = self._ending or RunBroken(COORDINATOR_LOST)
        return items

    def order(self, control: Control) -> None:
        """The coordinator's word to everybody."""
        self._put(CONTROL, control)

    def acknowledge(self, acknowledged: Acknowledged) -> None:
        """The recorder's word to everybody."""
        self._put(ACKNOWLEDGED, acknowledged)

    def request_replay(self, who: str, *, first: int) -> None:
        """Ask `who` for its messages from number `first` on: they come in as samples, then Replayed(who)."""
        put, done = self._enqueue("", _reply), Raw(lambda _: Replayed(who), "", None, 0)
        answers = zenoh.handlers.Callback(put.callback, lambda: self._mailbox.put(done))
        self._session.get(
            f"{key(self.run, replay(who))}?from={first}",
            answers,
            consolidation=zenoh.ConsolidationMode.NONE,  # the default keeps one reply for each key
            accept_replies=zenoh.ReplyKeyExpr.ANY,
            timeout=CLOSE_SECONDS,
        )

    def replayed(self, whos: Iterable[str]) -> Iterator[Sample]:
        """The samples that are still to come, until everybody in `whos` has answered a request for replay."""
        waiting = set(whos)
        deadline = time.monotonic() + CLOSE_SECONDS
        while waiting and time.monotonic() < deadline:
            for item in self._take(1, timeout=deadline - time.monotonic()):
                if isinstance(item, Sample):
                    yield item
                elif isinstance(item, Replayed):
                    waiting.discard(item.who)

    # End together.
    def wait_for_close(self, timeout: float = CLOSE_SECONDS) -> Acknowledged | None:
        """Answer replays until the recorder has closed the recording; None where it did not say so in time."""
        deadline = time.monotonic() + timeout
        while self._last_word is None and not self._recorder_gone and time.monotonic() < deadline:
            self._take(1, timeout=deadline - time.monotonic())
        return self._last_word

    def locators(self) -> list[str]:
        """The addresses at which this session can be reached."""
        for reply in self._session.get(f"@/{self._session.zid()}/peer"):
            if reply.ok is not None:
                return list(json.loads(reply.ok.payload.to_bytes())["locators"])
        raise RunBroken("zenoh does not tell its own address")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for declared in reversed(self._declared):  # the token first: the others see us go
            declared.undeclare()
        self._session.close()  # type: ignore[no-untyped-call]  # zenoh leaves it untyped

    # Inside.
    def _take(self, wanted: int, *, timeout: float) -> list[Incoming]:
        """What came in, decoded; replays are answered and acknowledgements heeded on the way."""
        passed_on: list[Incoming] = []
        for item in self._mailbox.take(wanted, timeout=timeout):
            if isinstance(item, Signal):
                self._ending = self._ending or Interrupted(item.number)
                continue
            if isinstance(item, zenoh.Query):
                self._replay(item)
                continue
            decoded = item.decode(item)
            if isinstance(decoded, Acknowledged):
                self._forget(decoded.received.get(self.who, 0))
                self._last_word = decoded if decoded.closed else None
            if isinstance(decoded, Peer) and decoded.who == RECORDER:
                self._recorder_gone = not decoded.present
            passed_on.append(decoded)
        return passed_on

    def _wait_for(self, kind: type[T], *, deadline: float, missing: set[str]) -> list[T]:
        """Items of one kind, at least one; what else comes is kept for `receive`."""
        found: list[T] = []
        while not found:
            items = self._take(1, timeout=deadline - time.monotonic())
            if self._ending is not None:
                raise self._ending
            if not items and time.monotonic() >= deadline:
                raise RunBroken(self._who_is_missing(missing))
            for item in items:
                self._alone = False
                if isinstance(item, Control) and item.order != "start":
                    raise RunClosed(item)
                if isinstance(item, Peer) and not item.present:
                    raise RunBroken(f"{in_words(item.who)} left before the run had started")
                if isinstance(item, kind):
                    found.append(item)
                else:
                    self._early.append(item)
        return found

    def _who_is_missing(self, missing: set[str]) -> str:
        if self._alone and self.network.connect:
            where = ", ".join(self.network.connect)
            return f"nobody answered at {where} within {self.network.wait:g} s; is the coordinator running there?"
        names = " and ".join(map(in_words, sorted(missing)))
        return f"{names} did not join the run within {self.network.wait:g} s"

    def _forget(self, received: int) -> None:
        while self._kept and self._kept[0][0].number < received:
            self._kept.popleft()

    def _replay(self, query: zenoh.Query) -> None:
        first = int(query.parameters.get("from") or 0)
        with query:
            for stamp, topic, payload in self._kept:
                if stamp.number >= first:
                    query.reply(key(self.run, topic), payload, attachment=stamp.encode())

    def _listen(self, topic: str, decode: Callable[[Raw], Incoming], *, urgent: bool = False) -> None:
        callback = self._enqueue(topic, decode, urgent=urgent)
        self._declared.append(self._session.declare_subscriber(key(self.run, topic), callback))

    def _enqueue(self, topic: str, decode: Callable[[Raw], Incoming], *, urgent: bool = False) -> Any:
        """A callback for zenoh's threads: it only enqueues."""
        put = self._mailbox.put_urgent if urgent else self._mailbox.put
        return _direct(lambda content: put(Raw(decode, topic, content, time.time_ns())))

    def _put(self, topic: str, content: Control | Acknowledged | Ready) -> None:
        payload = content.model_dump_json().encode()
        self._session.put(key(self.run, topic), payload, congestion_control=zenoh.CongestionControl.BLOCK)

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        self._mailbox.put_urgent(Signal(number))


def _direct(callback: Callable[[Any], None]) -> Any:
    """Call back on the thread that receives, without a Python thread in between."""
    return zenoh.handlers.Callback(callback, indirect=False)


def _payload(raw: Raw) -> bytes:
    return bytes(raw.content.payload.to_bytes())


def _sample(raw: Raw) -> Sample:
    attachment = raw.content.attachment
    try:
        stamp = Stamp.decode(attachment.to_bytes()) if attachment is not None else None
    except ValueError as error:
        raise RunBroken(f"a message on {raw.topic} has no readable stamp: {error}") from None
    return Sample(raw.topic, raw.content.payload.to_bytes(), stamp, raw.time)


def _reply(raw: Raw) -> Sample:
    sample = raw.content.ok
    return _sample(raw._replace(topic=topic_of(str(sample.key_expr)), content=sample))


def _peer(raw: Raw) -> Peer:
    who = topic_of(str(raw.content.key_expr)).removeprefix(alive(""))
    return Peer(who, raw.content.kind == zenoh.SampleKind.PUT)


def _open(network: Network) -> zenoh.Session:
    """Peer mode without multicast: one known address is enough, gossip makes the mesh.

    Connecting goes on in the background, so that a signal is heeded meanwhile; the barrier waits for everybody.
    """
    config = {
        "mode": "peer",
        "listen": {"endpoints": [network.listen]},
        "connect": {
            "endpoints": list(network.connect),
            "timeout_ms": -1,
            "exit_on_failure": False,
            "retry": {"period_init_ms": 20, "period_max_ms": 200, "period_increase_factor": 1.5},
        },
        "open": {"return_conditions": {"connect_scouted": False, "declares": False}},
        "scouting": {
            "multicast": {"enabled": False},
            "gossip": {
                "enabled": True,
                "autoconnect_strategy": {"peer": {"to_router": "always", "to_peer": "greater-zid"}},
            },
        },
        "adminspace": {"enabled": True},  # tells the port that 0 became
        "transport": {"shared_memory": {"enabled": False}, "link": {"tx": {"lease": LEASE_MS}}},
    }
    try:
        return zenoh.open(zenoh.Config.from_json5(json.dumps(config)))
    except zenoh.ZError as error:
        raise InputError(_why_not_open(network, str(error))) from None


def _why_not_open(network: Network, reason: str) -> str:
    if "must be of the form" in reason:
        given = ", ".join([network.listen, *network.connect])
        return f"an address is wrong in {given}: it must look like tcp/127.0.0.1:7447"
    cause = "the port is in use" if "in use" in reason else reason.split(" at /")[0]
    return f"cannot listen on {network.listen}: {cause}; port 0 takes a free one"
