"""What comes from several sources with the time at which each arrived, for whoever works against the clock."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from queue import Empty, SimpleQueue
from threading import Thread
from typing import Generic, NamedTuple, TypeVar

from agent.contract.messages import Way
from agent.network.session import CAPACITY, way_of
from agent.network.words import ChannelClosed, Quota, Sample

T = TypeVar("T")


class Arrival(NamedTuple, Generic[T]):
    """A message, and when it arrived, on time.monotonic()."""

    sample: T
    at: float


class Arrivals(Generic[T]):
    """What these sources give from now on, which nobody else may ask any more; a thread for each waits there.

    A source blocks until it has something, and raises ChannelClosed at its end. A thread's clock is read when the
    message is there, whatever the one who computes is doing; `in_thread` starts it. What is too much to wait for that
    one is left out, and given to `overflow`.
    """

    def __init__(
        self,
        sources: Iterable[Callable[[], T]],
        *,
        in_thread: Callable[..., None] | None = None,
        overflow: Callable[[T], None] = lambda left: None,
    ) -> None:
        self._queue: SimpleQueue[tuple[Quota, Arrival[T]] | None] = SimpleQueue()  # None: a source has closed
        self._overflow = overflow
        for source in sources:
            (in_thread or _daemon)(partial(self._watch, source), name="arrivals")

    def until(self, deadline: float) -> Iterator[Arrival[T]]:
        """What has arrived, once something has; nothing where the deadline passes first. Raises ChannelClosed."""
        left = deadline - time.monotonic()
        try:
            came = self._queue.get(timeout=None if left == math.inf else max(0.0, left))
            while True:
                if came is None:
                    raise ChannelClosed
                quota, arrival = came
                quota.leave()
                yield arrival
                came = self._queue.get_nowait()
        except Empty:
            return

    def _watch(self, source: Callable[[], T]) -> None:
        quota = Quota(CAPACITY)
        try:
            while True:
                sample = source()
                if quota.enter():
                    self._queue.put((quota, Arrival(sample, time.monotonic())))
                else:
                    self._overflow(sample)
        except ChannelClosed:
            self._queue.put(None)


def way(sample: Sample, at: float) -> Way | None:
    """Where a sample that arrived `at`, on time.monotonic(), spent its time, as far as it says."""
    return way_of(sample.trace, at + time.time() - time.monotonic())


def _daemon(work: Callable[[], None], *, name: str) -> None:
    Thread(target=work, daemon=True, name=name).start()
