"""Where messages come in: what the guard lets pass goes on to whoever computes, the rest is dropped and counted."""

from __future__ import annotations

import threading
from collections import deque
from typing import NamedTuple

from agent.contract.messages import Message, Stamp, digest_of
from agent.guard import FLOOD, FORGED, REPEATED, Guard, Unfit
from agent.network.session import CAPACITY, Channel
from agent.network.words import Sample

MOST = 512  # messages that are taken from one topic before another one has its turn


class Admitted(NamedTuple):
    """A message that fits, as it was sent and as it reads."""

    topic: str
    payload: bytes
    stamp: Stamp | None
    message: Message


def vouch(guard: Guard, sample: Sample) -> None:
    """Raises Unfit where a sample cannot be from its sender, or is too much to be looked at."""
    if sample.flaw:
        raise Unfit(sample.flaw)
    guard.vouch(sample.topic, len(sample.payload), sample.stamp)


def admit(guard: Guard, sample: Sample, *, for_record: bool) -> Admitted:
    """What may come in; raises Unfit.

    `for_record`: it keeps account of numbers itself, for what it has asked for may come twice; and its digest is held
    against it, for what is recorded will be.
    """
    topic, payload, stamp = sample.topic, sample.payload, sample.stamp
    if sample.flaw:
        raise Unfit(sample.flaw)
    message = guard.admit(topic, payload, stamp)
    if for_record and stamp is not None:
        if stamp.digest and stamp.digest != digest_of(topic, payload):
            raise Unfit(FORGED)
    elif not guard.first_time(topic, message.step, stamp):
        raise Unfit(REPEATED)
    return Admitted(topic, payload, stamp, message)


class Arrived(NamedTuple):
    """A sample that its sender has sent, not yet examined, for its `gate` to open."""

    gate: Gate
    sample: Sample


class Gate:
    """A topic's messages that may come in, in order. One thread takes them; another may `relieve` it.

    Where zenoh's own queue is full it holds up everything on that link, and who waits for one topic takes nothing of
    the others. So somebody looks after the queues from time to time, and what cannot be kept is dropped.
    """

    def __init__(self, channel: Channel, guard: Guard, *, for_record: bool) -> None:
        self.topic = channel.topic
        self._channel, self._guard, self._for_record = channel, guard, for_record
        self._kept: deque[Sample] = deque()  # what was taken for relief
        self._lock = threading.Lock()  # held by whoever takes

    def next(self) -> Admitted:
        """The next message; blocks until there is one. Raises ChannelClosed."""
        with self._lock:
            while True:
                sample = self._kept.popleft() if self._kept else self._channel.next()
                if (admitted := self._admitted(sample)) is not None:
                    return admitted

    def waiting(self, most: int = MOST) -> list[Admitted]:
        """The messages that are there already, of `most` that are looked at; does not block."""
        found = []
        with self._lock:
            for _ in range(most):
                sample = self._kept.popleft() if self._kept else self._channel.take()
                if sample is None:
                    break
                if (admitted := self._admitted(sample)) is not None:
                    found.append(admitted)
        return found

    def arrived(self) -> Arrived:
        """The next of its sender's samples as it is, whether it fits or not. Blocks; raises ChannelClosed."""
        while True:
            with self._lock:
                sample = self._kept.popleft() if self._kept else self._channel.next()
            try:
                vouch(self._guard, sample)
            except Unfit as unfit:
                if unfit.kind == FORGED:
                    self._guard.refuse(self.topic, unfit.kind)
                    continue
            return Arrived(self, sample)

    def open(self, sample: Sample) -> Admitted | None:
        """A sample that has arrived; None, and counted, where it does not fit."""
        return self._admitted(sample)

    def overflow(self) -> None:
        """Count a sample that nobody had room for."""
        self._guard.refuse(self.topic, FLOOD)

    def relieve(self) -> int:
        """Take what waits in zenoh's queue where nobody else does; returns how many there were."""
        if not self._lock.acquire(blocking=False):
            return 0
        try:
            taken = 0
            while taken < CAPACITY and (sample := self._channel.take()) is not None:
                taken += 1
                self._keep(sample)
            return taken
        finally:
            self._lock.release()

    def _keep(self, sample: Sample) -> None:
        try:
            vouch(self._guard, sample)
            if len(self._kept) >= CAPACITY:
                self._guard.turn_away(sample.topic, sample.payload, sample.stamp)
            self._kept.append(sample)
        except Unfit as unfit:
            self._guard.refuse(self.topic, unfit.kind)

    def _admitted(self, sample: Sample) -> Admitted | None:
        try:
            return admit(self._guard, sample, for_record=self._for_record)
        except Unfit as unfit:
            self._guard.refuse(self.topic, unfit.kind)
            return None
