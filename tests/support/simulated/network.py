"""The network between simulated sessions, as zenoh makes it: a link between every two peers, and each in order.

A declaration travels over a link like everything else, and nobody sends what the other end has not asked for: so what
comes before a subscription is known, is lost, as with zenoh. A link is lost, and what is on its way with it, where a
process dies or nothing passes for the lease; after a shorter time everything arrives late. A seed may ask for worse
than that of data messages: lost, twice, in another order.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

from simulated.machine import Machine

if TYPE_CHECKING:
    from simulated.door import Door

LEASE = 10.0  # seconds without a word after which a link is lost
TO_SEE_THE_END = 0.05  # seconds after which a killed process is missed, at most
Do = Callable[[], None]


class Weather(NamedTuple):
    """How long things take, in seconds, and what becomes of data messages: each a probability."""

    delay: float = 1e-3  # of a message, on average
    reaction: float = 1e-4  # of a thread that could run, on average
    stutter: float = 0.0  # part of the reactions that take a hundred times as long
    dropped: float = 0.0
    doubled: float = 0.0
    disordered: float = 0.0
    victims: str = ""  # whose; "" is everybody's


class Network:
    """All sessions, and a link between every two."""

    def __init__(self, machine: Machine, weather: Weather) -> None:
        self.machine, self.weather = machine, weather
        self.links: dict[frozenset[Door], Link] = {}
        self.doors: list[Door] = []

    def delay(self) -> float:
        return self.machine.random.expovariate(1.0 / self.weather.delay)

    def join(self, door: Door) -> None:
        """A session has opened: it finds the others one by one."""
        for other in self.doors:
            self._connect_soon(door, other, self.machine.random.uniform(0.005, 0.3))
        self.doors.append(door)
        door.process.on_end.append(partial(self._lose, door))
        door.process.on_freeze.append(partial(self.isolate, door))

    def _connect_soon(self, a: Door, b: Door, seconds: float) -> None:
        self.machine.at(self.machine.now + seconds, partial(self._connect, a, b))

    def _connect(self, a: Door, b: Door) -> None:
        pair = frozenset((a, b))
        if a.is_open and b.is_open and pair not in self.links:
            self.links[pair] = Link(self, a, b)

    def _lose(self, door: Door) -> None:
        """The process of a session is over: its system ends the connections, but the last messages may stay unsent."""
        if door not in self.doors:
            return
        self.doors.remove(door)
        door.is_open = False
        for link in [link for pair, link in self.links.items() if door in pair]:
            unsent = self.machine.random.choice((0.0, 0.0, 2e-3, TO_SEE_THE_END)) if door.process.was_killed else 0.0
            link.end(door, unsent)

    def part(self, a: Door, b: Door, seconds: float) -> None:
        """Nothing passes between two for so long; where that is longer than the lease, both lose the other."""
        link = self.links.get(frozenset((a, b)))
        if link is None:
            return
        until = self.machine.now + seconds
        link.stall(until)
        if seconds > LEASE:
            self.machine.at(self.machine.now + LEASE, link.break_off)
            self._connect_soon(a, b, seconds + self.machine.random.uniform(0.02, 0.2))

    def isolate(self, door: Door, seconds: float) -> None:
        """Nothing passes to or from a session: its process is frozen, or its cable is out."""
        for other in self.doors:
            if other is not door:
                self.part(door, other, seconds)


class Link:
    """Between two sessions, once it is up; what each has declared is told to the other first."""

    def __init__(self, network: Network, a: Door, b: Door) -> None:
        self._network, self._ends = network, (a, b)
        self._pipes = {a: Pipe(network), b: Pipe(network)}  # by who sends
        for here, there in ((a, b), (b, a)):
            here.peers[there] = self._pipes[here]
            for declared in here.declared:
                self._pipes[here].send(partial(there.learn, here, declared))

    def stall(self, until: float) -> None:
        for pipe in self._pipes.values():
            pipe.stalled = max(pipe.stalled, until)

    def end(self, door: Door, unsent: float) -> None:
        """One end is gone; of what it has sent, the last so many seconds never left."""
        (other,) = (end for end in self._ends if end is not door)
        self._pipes[other].close()
        pipe = self._pipes[door]
        pipe.unsent_from = self._network.machine.now - unsent if unsent else math.inf
        later = self._network.machine.random.uniform(0.002, TO_SEE_THE_END)
        pipe.send(partial(self._lost_by, other, door), always=True, later=later)
        self._network.links.pop(frozenset(self._ends), None)

    def break_off(self) -> None:
        """Neither has heard of the other for too long."""
        pair = frozenset(self._ends)
        if self._network.links.get(pair) is not self:
            return
        del self._network.links[pair]
        for here, there in (self._ends, self._ends[::-1]):
            self._pipes[here].close()
            self._lost_by(here, there)

    def _lost_by(self, here: Door, there: Door) -> None:
        if here.peers.get(there) is self._pipes[here]:
            here.lose(there)


class Pipe:
    """One direction of a link: what is sent arrives later, in order."""

    def __init__(self, network: Network) -> None:
        self._network = network
        self._last = 0.0
        self._is_open = True
        self.stalled = 0.0  # nothing arrives before
        self.unsent_from = math.inf

    def send(self, do: Do, *, always: bool = False, later: float = 0.0) -> None:
        machine = self._network.machine
        self._last = max(machine.now + self._network.delay() + later, self._last, self.stalled)
        machine.at(self._last, partial(self._arrive, do, math.inf if always else machine.now, always))

    def send_data(self, do: Do, sender: str, receiver: str) -> None:
        """A data message, with which worse may happen."""
        weather, chance = self._network.weather, self._network.machine.random
        if weather.victims not in ("", sender, receiver):
            return self.send(do)
        if weather.dropped and chance.random() < weather.dropped:
            return None
        if weather.doubled and chance.random() < weather.doubled:
            self._aside(do)
        if weather.disordered and chance.random() < weather.disordered:
            return self._aside(do)
        return self.send(do)

    def _aside(self, do: Do) -> None:
        machine = self._network.machine
        at = max(machine.now + 10.0 * self._network.delay(), self.stalled)
        machine.at(at, partial(self._arrive, do, machine.now, False))

    def close(self) -> None:
        """What is on its way is lost."""
        self._is_open = False

    def _arrive(self, do: Do, sent: float, always: bool) -> None:
        if always or (self._is_open and sent <= self.unsent_from):
            do()
