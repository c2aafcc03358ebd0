"""Jobs for worker processes, which import this and little else."""

from __future__ import annotations

import math
import os
import threading
from pathlib import Path

from agent.contract.errors import Unattainable


def where(item: int) -> tuple[int, int]:
    """Late items are done first, so that the order is not that of finishing; and who did it."""
    if item == 0:
        sum(math.sqrt(number) for number in range(200_000))
    return item, os.getpid()


def refuse(item: int) -> int:
    if item == 2:
        raise Unattainable("item 2 has no answer")
    return item


def die(item: int) -> int:
    os._exit(item)


def stay(item: int) -> int:
    """Item 0 is done; the others never are."""
    if item:
        threading.Event().wait()
    return item


def threads_after_a_product(_item: int) -> tuple[int, int]:
    """Threads of this process before and after numpy has multiplied matrices."""
    tasks = Path("/proc/self/task")
    before = len(list(tasks.iterdir()))
    import numpy as np

    np.ones((300, 300)) @ np.ones((300, 300))
    return before, len(list(tasks.iterdir()))
