"""How much memory this program may still take: what the machine has free, and what limits leave of that."""

from __future__ import annotations

import math
import os
import resource
from pathlib import Path

_ROOT = Path("/")


def free_memory(root: Path = _ROOT) -> float:
    """Bytes: the least of what is free, of what `ulimit -v` leaves, and of what the limits of containers leave.

    Where the system does not say what is free it is what is installed. `root`: where its files stand.
    """
    return max(min(_of_machine(root), _of_process(root), _of_groups(root)), 0.0)


def _of_machine(root: Path) -> float:
    try:
        lines = (root / "proc/meminfo").read_text("ascii").splitlines()
        return next(1024.0 * float(line.split()[1]) for line in lines if line.startswith("MemAvailable:"))
    except (OSError, StopIteration):
        return float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))


def _of_process(root: Path) -> float:
    """Of the address space, less what is taken of it."""
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit == resource.RLIM_INFINITY:
        return math.inf
    try:
        pages = float((root / "proc/self/statm").read_text("ascii").split()[0])
    except OSError:
        return float(limit)
    return limit - pages * os.sysconf("SC_PAGE_SIZE")


def _of_groups(root: Path) -> float:
    """Of the control group (version 2) of this process, and of all above it; what files fill there is free."""
    try:
        lines = (root / "proc/self/cgroup").read_text("utf-8").splitlines()
    except OSError:
        return math.inf
    own = next((line[3:].strip("/") for line in lines if line.startswith("0::")), None)
    if own is None:
        return math.inf
    top = root / "sys/fs/cgroup"
    return min(_of_group(top / path) for path in (Path(own), *Path(own).parents))


def _of_group(group: Path) -> float:
    """The root group has no limit, and says none."""
    try:
        limit = (group / "memory.max").read_text("ascii").strip()
        taken = float((group / "memory.current").read_text("ascii"))
        parts = dict(line.split() for line in (group / "memory.stat").read_text("ascii").splitlines())
    except OSError:
        return math.inf
    return math.inf if limit == "max" else float(limit) - taken + float(parts.get("inactive_file", 0))
