"""One participant's place on the network: publish, subscribe, start together, replay, end together.

The only module that imports zenoh. What makes it lose nothing:

* the start barrier: everybody declares what it receives, then a liveliness token, then waits for all tokens.
  Every two peers have a link of their own, and declarations keep their order on a link, so whoever sees a token
  knows that peer's subscriptions;
* every data message is numbered and kept until the recorder has acknowledged it, and the recorder can ask for it
  again;
* when a run ends, nobody who is well leaves before the recorder has closed the recording.
"""

from __future__ import annotations

import json
import math
import signal
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from queue import Empty, SimpleQueue
from types import FrameType, TracebackType
from typing import Any, NamedTuple, Self, TypeVar

import zenoh
from pydantic import ValidationError

from agent.contract.errors import InputError, Interrupted, RunBroken, first_fault
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
from agent.plan import LARGEST_WINDOW

LEASE_MS = 10_000  # a peer that is silent for so long is lost; a killed one is seen in milliseconds
BUFFER = 16_384  # bytes, of each direction of each link; messages are small, links are many
CAPACITY = 8 * LARGEST_WINDOW  # messages that a channel holds; a full one would hold up everything on its link
REPLAY_SECONDS = 1.0  # how long the recorder waits for what it asks for at the end
CLOSE_SECONDS = 10.0  # how long everybody else waits for the recorder to close, as long as it is there
LEAVE_SECONDS = 1.0  # how long one waits for the others to have gone


@dataclass(frozen=True)
class Network:
    """Where to listen, whom to connect to (one peer of the run is enough), how long to wait for the others."""

    listen: str = "tcp/127.0.0.1:0"
    connect: tuple[str, ...] = ()
    wait: float = 30.0


class Sample(NamedTuple):
    """A data message as it came in. `stamp` is None where the sender left it out."""

    topic: str
    payload: bytes
    stamp: Stamp | None


class Peer(NamedTuple):
    """Somebody who has come or gone."""

    who: str
    present: bool


class Replayed(NamedTuple):
    """The answers of `who` to a request for replay are complete."""

    who: str


Incoming = Sample | Peer | Control | Acknowledged | Ready | Replayed
T = TypeVar("T")


class RunClosed(Exception):
    """Raised by `Bus.receive` when the run is over; `control` says how."""

    def __init__(self, control: Control) -> None:
        super().__init__(control.reason)
        self.control = control


class ChannelClosed(Exception):
    """Raised by `Channel.next` when this participant leaves."""


class Channel:
    """A topic's messages, in order. They wait in zenoh, without running any Python, until they are asked for."""

    def __init__(self, topic: str, handler: Any) -> None:
        self._topic, self._handler = topic, handler

    def next(self) -> Sample:
        """The next message; blocks until there is one. Raises ChannelClosed."""
        try:
            return _sample(self._topic, self._handler.recv())
        except zenoh.ZError:
            raise ChannelClosed from None

    def waiting(self) -> Iterator[Sample]:
        """The messages that are there already; does not block."""
        while (sample := self._handler.try_recv()) is not None:
            yield _sample(self._topic, sample)


class Bus:
    """A zenoh session that belongs to participant `who` of run `run`. Use it with `with`.

    One thread may publish and take from channels; everything else belongs to the main thread.
    """

    def __init__(self, network: Network, *, run: str, who: str) -> None:
        self.run, self.who, self.network = run, who, network
        self._queue: SimpleQueue[Callable[[], Incoming | None]] = SimpleQueue()  # what the main thread has to do
        self._publishers: dict[str, Any] = {}
        self._declared: list[Any] = []  # zenoh drops what nobody holds
        self._kept: deque[tuple[Stamp, str, bytes]] = deque()  # what the recorder has not acknowledged
        self._published = 0
        self._early: list[Incoming] = []  # what came while we waited for something else
        self._alone = True  # nobody else of this run has been seen
        self._expected: set[str] = set()  # who takes part
        self._present: set[str] = set()  # whose token is there
        self._leaving = False  # a signal then changes nothing: we go as soon as all is recorded
        self._last_word: Acknowledged | None = None  # that the recording is closed
        self._session = _open(network)
        self._handlers = {number: signal.signal(number, self._on_signal) for number in (signal.SIGINT, signal.SIGTERM)}

    # Declare: first what we receive, then what we send, the token last.
    def channel(self, topic: str) -> Channel:
        """Receive a topic's messages."""
        subscriber = self._session.declare_subscriber(key(self.run, topic), zenoh.handlers.FifoChannel(CAPACITY))
        self._declared.append(subscriber)
        return Channel(topic, subscriber.handler)

    def advertise(self, topics: Iterable[str]) -> None:
        """Announce that these topics will be published, and offer replays of them."""
        queries = self._session.declare_queryable(
            key(self.run, replay(self.who)), lambda query: self._queue.put(lambda: self._replay(query))
        )
        self._declared.append(queries)
        for topic in topics:
            self._publishers[topic] = self._session.declare_publisher(
                key(self.run, topic),
                congestion_control=zenoh.CongestionControl.BLOCK,  # the default drops without a word
                express=topic.endswith("/estimate"),  # the only message that somebody waits for right now
            )

    def enter(self) -> None:
        """Receive what runs the run, watch the others' tokens, and show our own: the last declaration."""
        if self.who == COORDINATOR:
            self._listen(ready("*"), Ready)
        else:
            self._listen(CONTROL, Control)
        if self.who != RECORDER:
            self._listen(ACKNOWLEDGED, Acknowledged)
        liveliness = self._session.liveliness()
        watch = liveliness.declare_subscriber(key(self.run, alive("*")), self._on_token, history=True)
        self._declared.append(watch)
        self._declared.append(liveliness.declare_token(key(self.run, alive(self.who))))

    # Start together.
    def meet(self, others: Iterable[str]) -> Iterator[str]:
        """Wait for everybody's token, and yield who has come; RunBroken names who is missing when time is over."""
        self._expected = set(others) - {self.who}
        absent = set(self._expected)
        deadline = time.monotonic() + self.network.wait
        while absent:
            who = self._wait_for(Peer, deadline=deadline, missing=absent).who
            if who in absent:
                absent.remove(who)
                yield who

    def gather(self, others: Iterable[str]) -> dict[str, Ready]:
        """The coordinator's: wait until everybody has met everybody. InputError where a name is there twice."""
        answers: dict[str, Ready] = {}
        unready = set(others) - {self.who}
        deadline = time.monotonic() + self.network.wait
        while unready:
            answer = self._wait_for(Ready, deadline=deadline, missing=unready)
            if answers.setdefault(answer.who, answer).session != answer.session:
                raise InputError(f"{in_words(answer.who)} takes part twice; start it once")
            unready.discard(answer.who)
        return answers

    def report_ready(self, gains: str) -> None:
        """Tell the coordinator that we have met everybody, and which gains we run on."""
        self._put(ready(self.who), Ready(who=self.who, session=str(self._session.zid()), gains=gains))

    def wait_for_start(self) -> Control:
        """The coordinator's order to start, with the facts of the run."""
        deadline = time.monotonic() + self.network.wait
        return self._wait_for(Control, deadline=deadline, missing={COORDINATOR})

    # Run.
    def publish(self, topic: str, message: Message) -> None:
        """Send a data message, and keep it until the recorder has it."""
        payload = message.encode()
        stamp = Stamp(self._published, time.time_ns(), self.who)
        self._published += 1
        self._kept.append((stamp, topic, payload))
        self._publishers[topic].put(payload, attachment=stamp.encode())

    def receive(self, *, timeout: float = math.inf) -> Incoming | None:
        """The next word for the main thread; None where `timeout` seconds have passed.

        Raises RunClosed when the coordinator ends the run, RunBroken when the coordinator is lost, Interrupted
        on a signal, and whatever was given to `fail`.
        """
        deadline = time.monotonic() + timeout
        while True:
            item = self._early.pop(0) if self._early else self._take(deadline)
            match item:
                case Control(order="close" | "stop"):
                    raise RunClosed(item)
                case Peer(who="coordinator", present=False):
                    raise RunBroken("the coordinator was lost: its process ended, or the network to it failed")
            if item is not None or time.monotonic() >= deadline:
                return item

    def fail(self, error: BaseException) -> None:
        """Have the main thread raise `error`; called by the thread that computes."""
        self._queue.put(lambda: _raise(error))

    def order(self, control: Control) -> None:
        """The coordinator's word to everybody."""
        self._put(CONTROL, control)

    def acknowledge(self, acknowledged: Acknowledged) -> None:
        """The recorder's word to everybody."""
        self._put(ACKNOWLEDGED, acknowledged)

    def request_replay(self, who: str, *, first: int) -> None:
        """Ask `who` for its messages from number `first` on: they come as samples, then Replayed(who)."""

        def answer(reply: zenoh.Reply) -> None:
            self._queue.put(lambda: _replayed(reply))

        self._session.get(
            f"{key(self.run, replay(who))}?from={first};_anyke",  # answers come under their own keys
            zenoh.handlers.Callback(answer, lambda: self._queue.put(lambda: Replayed(who))),
            consolidation=zenoh.ConsolidationMode.NONE,  # the default keeps one reply for each key
            timeout=REPLAY_SECONDS,
        )

    # End together.
    def replayed(self, whos: Iterable[str]) -> Iterator[Sample]:
        """Samples that are still to come, until everybody in `whos` has answered a request for replay."""
        self._leaving = True
        waiting = set(whos)
        deadline = time.monotonic() + REPLAY_SECONDS
        while waiting and time.monotonic() < deadline:
            match self._take(deadline):
                case Sample() as sample:
                    yield sample
                case Replayed(who=who):
                    waiting.discard(who)

    def wait_for_close(self) -> Acknowledged | None:
        """Answer replays until the recorder has closed the recording; None where it has not."""
        self._until(lambda: self._last_word is not None or RECORDER not in self._present, seconds=CLOSE_SECONDS)
        return self._last_word

    def wait_until_gone(self, whos: Iterable[str]) -> None:
        """Stay until they have gone, so that our last word is sure to have reached them; but not for long."""
        names = set(whos)
        self._until(lambda: not names & self._present, seconds=LEAVE_SECONDS)

    def _until(self, condition: Callable[[], bool], *, seconds: float) -> None:
        self._leaving = True
        deadline = time.monotonic() + seconds
        while not condition() and time.monotonic() < deadline:
            self._take(deadline)

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
        try:
            for declared in reversed(self._declared):  # the token first: the others see us go
                declared.undeclare()
        finally:
            self._session.close()  # type: ignore[no-untyped-call]  # zenoh leaves it untyped
            for number, handler in self._handlers.items():
                signal.signal(number, handler)

    # Inside.
    def _take(self, deadline: float) -> Incoming | None:
        """The next word; None at the deadline, or where it was dealt with here: a replay, an acknowledgement."""
        left = deadline - time.monotonic()
        item: Incoming | None
        try:
            item = self._queue.get(timeout=None if left == math.inf else max(0.0, left))()
        except Empty:
            return None
        if item is not None and not (isinstance(item, Peer) and item.who == self.who):
            self._alone = False
        match item:
            case Acknowledged(received=received, closed=closed):
                while self._kept and self._kept[0][0].number < received.get(self.who, 0):
                    self._kept.popleft()
                self._last_word = item if closed else None
            case Peer(who=who, present=True):
                self._present.add(who)
            case Peer(who=who):
                self._present.discard(who)
        return item

    def _wait_for(self, kind: type[T], *, deadline: float, missing: set[str]) -> T:
        """The next word of one kind; what else comes is kept for `receive`."""
        for early in self._early:
            if isinstance(early, kind):
                self._early.remove(early)
                return early
        left = ""  # who went away; the coordinator's word on it may be on its way
        while True:
            item = self._take(deadline)
            if item is None:
                if time.monotonic() >= deadline:
                    raise RunBroken(left or self._who_is_missing(missing))
                continue
            match item:
                case Control(order="close" | "stop"):
                    raise RunClosed(item)
                case Peer(who=who, present=False) if who in self._expected:
                    left = left or f"{in_words(who)} left before the run had started"
                    deadline = min(deadline, time.monotonic() + (0.0 if self.who == COORDINATOR else LEAVE_SECONDS))
                    continue
            if isinstance(item, kind):
                return item
            self._early.append(item)

    def _who_is_missing(self, missing: set[str]) -> str:
        if self._alone and self.network.connect:
            where = ", ".join(self.network.connect)
            return (
                f'nobody of run "{self.run}" answered at {where} within {self.network.wait:g} s; '
                "is the coordinator running there, under the same --run?"
            )
        names = " and ".join(map(in_words, sorted(missing)))
        return f"{names} did not join the run within {self.network.wait:g} s"

    def _replay(self, query: zenoh.Query) -> None:
        first = query.parameters.get("from") or ""
        with query:
            if not first.isdecimal() or "_anyke" not in query.parameters:
                return  # not the recorder's question
            for stamp, topic, payload in tuple(self._kept):
                if stamp.number >= int(first):
                    query.reply(key(self.run, topic), payload, attachment=stamp.encode())

    def _listen(self, topic: str, model: type[Control] | type[Acknowledged] | type[Ready]) -> None:
        def decode(payload: bytes) -> Control | Acknowledged | Ready:
            try:
                return model.model_validate_json(payload)
            except ValidationError as error:
                fault = first_fault(error, {})
                raise RunBroken(f"what came on {topic} is not from peakmesh: {fault}") from None

        def enqueue(sample: zenoh.Sample) -> None:  # on zenoh's thread; decoded on ours, where a failure is seen
            self._queue.put(lambda: decode(sample.payload.to_bytes()))

        self._declared.append(self._session.declare_subscriber(key(self.run, topic), enqueue))

    def _put(self, topic: str, content: Control | Acknowledged | Ready) -> None:
        payload = content.model_dump_json().encode()
        self._session.put(key(self.run, topic), payload, congestion_control=zenoh.CongestionControl.BLOCK)

    def _on_token(self, sample: zenoh.Sample) -> None:
        who = topic_of(str(sample.key_expr)).removeprefix(alive(""))
        self._queue.put(lambda: Peer(who, sample.kind == zenoh.SampleKind.PUT))

    def _interrupt(self, number: int) -> None:
        if not self._leaving:
            raise Interrupted(number)

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        self._queue.put(lambda: self._interrupt(number))


def _raise(error: BaseException) -> None:
    raise error


def _sample(topic: str, sample: zenoh.Sample) -> Sample:
    attachment = sample.attachment
    try:
        stamp = Stamp.decode(attachment.to_bytes()) if attachment is not None else None
    except ValueError as error:
        raise RunBroken(f"a message on {topic} has no readable stamp: {error}") from None
    return Sample(topic, sample.payload.to_bytes(), stamp)


def _replayed(reply: zenoh.Reply) -> Sample | None:
    sample = reply.ok
    return _sample(topic_of(str(sample.key_expr)), sample) if sample is not None else None


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
        "transport": {
            "shared_memory": {"enabled": False},
            "link": {"tx": {"lease": LEASE_MS, "batch_size": BUFFER}, "rx": {"buffer_size": BUFFER}},
        },
    }
    try:
        return zenoh.open(zenoh.Config.from_json5(json.dumps(config)))
    except zenoh.ZError as error:
        raise InputError(_why_not_open(network, str(error))) from None


def _why_not_open(network: Network, reason: str) -> str:
    cause = "the port is in use" if "in use" in reason else reason.split(" at /")[0]
    return f"cannot listen on {network.listen}: {cause}; port 0 takes a free one"
