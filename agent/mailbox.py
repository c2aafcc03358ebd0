"""Hands messages from the network's threads to the one thread that computes.

Callbacks only `put`. The computing thread says how many messages it lacks and sleeps until that many are
there, so that a step is woken once, not once a message.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from typing import Any


class Mailbox:
    """Many threads put, one takes."""

    def __init__(self) -> None:
        self._items: deque[Any] = deque()
        self._wanted: float = math.inf  # items that are worth a wake-up
        self._urgent = False
        self._signal = threading.Lock()
        self._signal.acquire()

    def put(self, item: Any) -> None:
        """Called by the network's threads."""
        self._items.append(item)
        if len(self._items) >= self._wanted:
            self._wake()

    def put_urgent(self, item: Any) -> None:
        """Wakes the taker whatever it waits for. Also fit for a signal handler: it takes no lock."""
        self._items.append(item)
        self._urgent = True
        self._wake()

    def take(self, wanted: int = 1, *, timeout: float = math.inf) -> list[Any]:
        """Everything there is, once `wanted` items are there, an urgent one is, or `timeout` seconds have passed."""
        deadline = time.monotonic() + timeout
        self._wanted = wanted
        while len(self._items) < wanted and not self._urgent:
            left = deadline - time.monotonic()
            if left <= 0.0:
                break
            self._signal.acquire(timeout=-1 if left == math.inf else left)
        self._wanted = math.inf
        self._urgent = False
        return [self._items.popleft() for _ in range(len(self._items))]

    def _wake(self) -> None:
        try:
            self._signal.release()
        except RuntimeError:  # released already: the taker is on its way
            return
