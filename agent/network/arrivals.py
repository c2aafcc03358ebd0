"""Messages of several channels with the time at which each arrived, for whoever works against the clock."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from queue import Empty, SimpleQueue
from threading import Thread
from typing import NamedTuple

from agent.contract.messages import Way
from agent.network.session import Channel, way_of
from agent.network.words import ChannelClosed, Sample


class Arrival(NamedTuple):
    """A message, and when it arrived, on time.monotonic()."""

    sample: Sample
    at: float

    def way(self) -> Way | None:
        """Where it spent its time, as far as it says."""
        return way_of(self.sample.trace, self.at + time.time() - time.monotonic())


class Arrivals:
    """What comes on these channels from now on, which nobody else may ask for any more; a thread for each waits there.

    A thread's clock is read when the message is there, whatever the one who computes is doing. `in_thread` starts it.
    """

    def __init__(self, channels: Iterable[Channel], *, in_thread: Callable[..., None] | None = None) -> None:
        self._queue: SimpleQueue[Arrival | None] = SimpleQueue()  # None: a channel has closed
        for channel in channels:
            (in_thread or _daemon)(partial(self._watch, channel), name="arrivals")

    def until(self, deadline: float) -> Iterator[Arrival]:
        """What has arrived, once something has; nothing where the deadline passes first. Raises ChannelClosed."""
        left = deadline - time.monotonic()
        try:
            arrival = self._queue.get(timeout=None if left == math.inf else max(0.0, left))
            while True:
                if arrival is None:
                    raise ChannelClosed
                yield arrival
                arrival = self._queue.get_nowait()
        except Empty:
            return

    def _watch(self, channel: Channel) -> None:
        try:
            while True:
                sample = channel.next()
                self._queue.put(Arrival(sample, time.monotonic()))
        except ChannelClosed:
            self._queue.put(None)


def _daemon(work: Callable[[], None], *, name: str) -> None:
    Thread(target=work, daemon=True, name=name).start()
