"""Ctrl-C and SIGTERM while gains are designed: the first ends the search, and what was found by then becomes a file."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from agent.signals import heed, restore

STOPPING = "stopping: the best gains so far are chosen and certified, which takes some seconds"
STOPPED = "still at it: the search is over, and the gains are written as soon as they are certified"


@contextmanager
def stoppable() -> Iterator[None]:
    """The first signal raises KeyboardInterrupt, whichever it is; those after it are answered, and end nothing."""
    came = False

    def stop(number: int, frame: FrameType | None) -> None:
        nonlocal came
        print(STOPPED if came else STOPPING, file=sys.stderr, flush=True)
        if not came:
            came = True
            raise KeyboardInterrupt

    handlers = heed(stop)
    try:
        yield
    finally:
        restore(handlers)
