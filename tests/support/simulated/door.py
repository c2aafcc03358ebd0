"""The simulated door to the network: what `agent.network.session.Session` is to zenoh, with the same methods."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from itertools import count
from typing import Any, NamedTuple

from agent.contract.keys import MODE, RECORDER, alive, replay, session
from agent.network.outbox import Sent
from agent.network.session import CAPACITY
from agent.network.words import ChannelClosed, Duty, Incoming, Replayed, Sample
from simulated.machine import Machine, Process, Queue
from simulated.network import Network, Pipe


class Declared(NamedTuple):
    """What a session has told its peers of: a "subscriber", a "queryable" or a "token", of a topic."""

    kind: str
    topic: str


class Published(NamedTuple):
    """A data message as it went out."""

    who: str
    sent: Sent
    at: float


class Channel:
    """A topic's messages, in order."""

    def __init__(self, machine: Machine, topic: str) -> None:
        self.topic, self._queue = topic, Queue(machine)

    def put(self, sample: Sample | None) -> None:
        assert self._queue.qsize() < CAPACITY, "a channel that is full holds up its link"
        self._queue.put(sample)

    def next(self) -> Sample:
        sample = self._queue.get()
        if sample is None:
            self._queue.put(None)
            raise ChannelClosed
        return sample  # type: ignore[no-any-return]

    def take(self) -> Sample | None:
        if self._queue.empty():
            return None
        sample = self._queue.get_nowait()
        if sample is None:  # the end, which `next` is to find
            self._queue.put(None)
        return sample  # type: ignore[no-any-return]


class Door:
    """The session of a process; what it publishes is put down in `log`."""

    def __init__(
        self,
        net: Network,
        log: list[Published],
        network: object,
        *,
        run: str,
        who: str,
        hand_over: Callable[[Duty], None],
    ) -> None:
        process = net.machine.process
        assert process is not None
        self._net, self._log, self._hand_over = net, log, hand_over
        self.process: Process = process
        self.is_open = True
        self.traced = False
        self.declared: list[Declared] = []
        self.peers: dict[Door, Pipe] = {}
        self._known: dict[Door, set[Declared]] = {}  # what each peer has declared, as far as that has come
        self._subscribers: list[tuple[str, Callable[[str, Sent | bytes], None]]] = []
        self._channels: list[Channel] = []
        self._watches: list[tuple[str, Callable[[str, bool], None]]] = []
        self._is_for: Callable[[str, Duty], bool | None] = lambda by, question: True
        self._answer: Callable[[int, Callable[[Sent], None]], None] | None = None
        self._asked: dict[int, tuple[str, set[Door]]] = {}  # questions: about whom, and who has still to answer
        self._numbers = count()
        born = round(1e9 * (net.machine.now + process.wall_skew + 1e6))
        self.identity = f"{born:020d}-{len(net.doors):04x}"
        net.join(self)

    # data
    def channel(self, topic: str) -> Channel:
        channel = Channel(self._net.machine, topic)
        self._channels.append(channel)
        self._subscribe(topic, lambda at, sent: channel.put(Sample(at, sent.payload, sent.stamp)))  # type: ignore[union-attr]
        return channel

    def advertise(self, topic: str, *, express: bool) -> None:
        """Nobody has to know who will publish."""

    def publish(self, sent: Sent) -> None:
        self._net.machine.pause()
        self._log.append(Published(self.process.name, sent, self._net.machine.now))
        self._to_subscribers(sent.topic, sent, is_data=True)

    def offer_replay(
        self, who: str, since: Callable[[int], Iterable[Sent]], *, is_for: Callable[[str, Duty], bool | None]
    ) -> None:
        def answer(first: int, reply: Callable[[Sent], None]) -> None:
            for sent in since(first):
                self._net.machine.pause()
                reply(sent)

        self._answer, self._is_for = answer, is_for
        self._declare("queryable", replay(who))

    def request_replay(self, who: str, *, first: int, seconds: float) -> None:
        machine, number = self._net.machine, next(self._numbers)
        asked = {peer for peer, known in self._known.items() if Declared("queryable", replay(who)) in known}
        self._asked[number] = who, asked
        for peer in [peer for peer in self.peers if peer in asked]:
            self.peers[peer].send(partial(peer.hear_question, self, number, first))
        patience = seconds if asked else self._net.delay()
        machine.at(machine.now + patience, partial(self._end_question, number, None))

    def hear_question(self, asker: Door, number: int, first: int) -> None:
        def reply(sent: Sent) -> None:
            self._send(asker, partial(asker.hear_answer, number, sent))

        def duty() -> Incoming | None:
            assert self._answer is not None
            if (may_ask := self._is_for(asker.identity, duty)) is None:
                return None
            if may_ask:
                self._answer(first, reply)
            self._send(asker, partial(asker._end_question, number, self))
            return None

        self._hand_over_open(duty)

    def hear_answer(self, number: int, sent: Sent) -> None:
        if number in self._asked:
            self._hand_over_open(lambda: Sample(*sent))

    def _end_question(self, number: int, peer: Door | None) -> None:
        """One has answered, or cannot; or, `peer` is None, time is over."""
        who, waiting = self._asked.get(number, ("", set()))
        waiting.discard(peer)  # type: ignore[arg-type]
        if who and (peer is None or not waiting):
            del self._asked[number]
            self._hand_over_open(lambda: Replayed(who))

    def answer(self, topic: str, payload: bytes) -> None:
        """No viewer is there to ask."""

    # words
    def listen(self, topic: str, decode: Callable[[bytes], Incoming | None], *, overflow: Callable[[], None]) -> None:
        self._subscribe(topic, lambda at, payload: self._hand_over_open(lambda: decode(payload)))  # type: ignore[arg-type]

    def say(self, topic: str, payload: bytes) -> None:
        self._net.machine.pause()
        self._net.machine.note(self.process.name, f"says {topic} {payload.decode()[:200]}")
        self._to_subscribers(topic, payload, is_data=False)

    def watch(self, see: Callable[[str, str, bool], None]) -> None:
        def hear(topic: str, present: bool) -> None:
            _, who, *identity = topic.split("/")
            if self.is_open:
                see(who, "".join(identity), present)

        self._watch("session/*", hear)
        self._watch(alive("sensor-*"), hear)

    def appear(self, who: str) -> None:
        for topic in (session(who, self.identity), alive(who)):
            self._declare("token", topic)
            self._tell_watches(topic, True)

    # the session itself
    def locators(self) -> list[str]:
        return ["tcp/simulated"]

    def close(self) -> None:
        if not self.is_open:
            return
        for declared in reversed(self.declared):
            for peer in self.peers:
                self._send(peer, partial(peer.unlearn, self, declared))
        self.is_open = False
        for channel in self._channels:
            channel.put(None)
        for peer in self.peers:
            self._send(peer, partial(peer.lose, self))
        if self in self._net.doors:
            self._net.doors.remove(self)
        for pair in [pair for pair in self._net.links if self in pair]:
            del self._net.links[pair]

    # what comes over the links
    def learn(self, peer: Door, declared: Declared) -> None:
        self._known.setdefault(peer, set())
        is_new = declared.kind == "token" and not self._is_there(declared)
        self._known[peer].add(declared)
        if is_new:
            self._tell_watches(declared.topic, True)

    def unlearn(self, peer: Door, declared: Declared) -> None:
        if declared not in self._known.get(peer, ()):
            return
        self._known[peer].discard(declared)
        if declared.kind == "token" and not self._is_there(declared):
            self._tell_watches(declared.topic, False)

    def lose(self, peer: Door) -> None:
        """The link to a peer is gone, and with it all that it has declared, and the answers that it owes."""
        self.peers.pop(peer, None)
        for declared in sorted(self._known.get(peer, ())):
            self.unlearn(peer, declared)
        self._known.pop(peer, None)
        for number in [number for number, (_, asked) in self._asked.items() if peer in asked]:
            self._end_question(number, peer)

    def _is_there(self, token: Declared) -> bool:
        return any(token in known for known in self._known.values())

    def _deliver(self, topic: str, what: Sent | bytes) -> None:
        if self.is_open:
            for pattern, take in self._subscribers:
                if _fits(pattern, topic):
                    take(topic, what)

    def _to_subscribers(self, topic: str, what: Sent | bytes, *, is_data: bool) -> None:
        self._deliver(topic, what)
        for peer, known in list(self._known.items()):
            if any(declared.kind == "subscriber" and _fits(declared.topic, topic) for declared in known):
                if is_data and (topic != MODE or peer.process.who == RECORDER):
                    self.peers[peer].send_data(partial(peer._deliver, topic, what), self.process.who, peer.process.who)
                else:
                    self._send(peer, partial(peer._deliver, topic, what))

    def _subscribe(self, topic: str, take: Callable[[str, Sent | bytes], None]) -> None:
        self._subscribers.append((topic, take))
        self._declare("subscriber", topic)

    def _watch(self, pattern: str, see: Callable[[str, bool], None]) -> None:
        self._watches.append((pattern, see))
        for topic in sorted({d.topic for known in self._known.values() for d in known if d.kind == "token"}):
            if _fits(pattern, topic):
                see(topic, True)

    def _tell_watches(self, topic: str, present: bool) -> None:
        for pattern, see in self._watches:
            if _fits(pattern, topic):
                see(topic, present)

    def _declare(self, kind: str, topic: str) -> None:
        declared = Declared(kind, topic)
        self.declared.append(declared)
        self._net.machine.pause()
        for peer in list(self.peers):
            self._send(peer, partial(peer.learn, self, declared))

    def _send(self, peer: Door, do: Callable[[], None]) -> None:
        pipe: Any = self.peers.get(peer)
        if pipe is not None:
            pipe.send(do)

    def _hand_over_open(self, duty: Duty) -> None:
        if self.is_open:
            self._hand_over(duty)


def _fits(pattern: str, topic: str) -> bool:
    return pattern == topic or (pattern.endswith("*") and topic.startswith(pattern[:-1]))
