"""Ctrl-C and SIGTERM while gains are designed: the first ends the search, and what was found by then becomes a file.

A second one cuts short what comes after the search; then the file has a gamma that is proved at once. A signal itself
raises nothing: whoever works looks at the budget, and ends there.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from agent.contract.errors import Interrupted
from agent.signals import heed, restore
from designer.patience import Budget

STOPPING = (
    "stopping: the best gains so far are chosen and certified, which takes seconds, of large networks minutes; "
    "once more, and their gamma is one that is proved at once"
)
STOPPED = "still at it: the search is over, and the gains are written as soon as they are certified"
HURRYING = "hurrying: what can be proved at once is written, and nothing that takes longer"
NOTHING = "nothing was found by then that could be proved, so nothing is written"


@contextmanager
def stoppable(budget: Budget) -> Iterator[None]:
    """Signals are told to the budget, and answered; where nothing comes of it all, Interrupted."""
    first: list[int] = []

    def stop(number: int, frame: FrameType | None) -> None:
        budget.asked += 1
        first.append(number)
        said = HURRYING if budget.asked > 1 else STOPPED if budget.over else STOPPING
        print(said, file=sys.stderr, flush=True)

    handlers = heed(stop)
    try:
        yield
    except KeyboardInterrupt:
        if first:
            print(NOTHING, file=sys.stderr)
            raise Interrupted(first[0]) from None
        raise
    finally:
        restore(handlers)
