"""Ctrl-C and SIGTERM while gains are designed: the first ends the search, and what was found by then becomes a file."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from agent.signals import heed, restore

STOPPING = "stopping: the best gains so far are chosen and certified, which takes seconds, of large networks minutes"
STOPPED = "still at it: the search is over, and the gains are written as soon as they are certified"


class Search:
    """What signals may end."""

    over = False  # all that is left is to be written
    asked = False  # a signal has come

    def stepped(self) -> None:
        """A search goes on: KeyboardInterrupt where a signal came whose own was lost, in a callback of a library."""
        if self.asked:
            raise KeyboardInterrupt


@contextmanager
def stoppable() -> Iterator[Search]:
    """The first signal raises KeyboardInterrupt, unless the search is over; those after it are answered alone."""
    search = Search()

    def stop(number: int, frame: FrameType | None) -> None:
        print(STOPPED if search.over else STOPPING, file=sys.stderr, flush=True)
        if not search.over:
            search.over = search.asked = True
            raise KeyboardInterrupt

    handlers = heed(stop)
    try:
        yield search
    finally:
        restore(handlers)
