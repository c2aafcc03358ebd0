"""What the search for the least exact gain takes, estimated before it begins: what the default method depends on.

The time is that of about a thousand gradients, and a gradient costs a bit and, for large networks, what it takes to
pass over Y_bar. To the end of the search, which a budget may come before.
"""

from __future__ import annotations

import os
from pathlib import Path

from agent.contract.errors import InputError
from agent.contract.problem import Problem

MOST_NODES = 100  # up to which exact is the default: as far as it was measured to its end
BUDGET = 600.0  # seconds
LONG = 60.0  # worth a word beforehand
_GRADIENTS = 1000
_OF_A_GRADIENT = 1.5e-3  # seconds, whatever the size
_OF_A_NUMBER = 5.3e-7  # seconds of a gradient, for each of the numbers of Y_bar
_MATRICES = 70  # as large as Y_bar that the search keeps at once: the horizon, and what it works on
_OTHERS = 2e8  # bytes, whatever the size


def default_method(problem: Problem, *, designs: float = 1.0) -> str:
    """ "exact" up to 100 nodes, and of many designs where they take the default budget together at most."""
    small = problem.n <= MOST_NODES and (designs == 1.0 or designs * seconds_of_exact(problem) <= BUDGET)
    return "exact" if small else "decomposed"


def seconds_of_exact(problem: Problem) -> float:
    """Estimated processor time of method "exact" without a budget."""
    return _GRADIENTS * (_OF_A_GRADIENT + _OF_A_NUMBER * _numbers(problem))


def refuse_without_memory(problem: Problem, *, free: float | None = None) -> None:
    """InputError where the search needs more memory than is free; `free` in bytes, or as the system says."""
    needed, free = _OTHERS + 8.0 * _MATRICES * _numbers(problem), _free_memory() if free is None else free
    if needed > free:
        raise InputError(
            f"{problem.name}: method exact needs about {needed / 1e9:.1f} GB of memory for {problem.n} nodes and "
            f"{len(problem.topologies)} modes, and {free / 1e9:.1f} GB are free; --method decomposed needs less"
        )


def in_words(seconds: float) -> str:
    """ "40 seconds", "12 minutes", "3 hours"."""
    for unit, size in (("hours", 3600.0), ("minutes", 60.0)):
        if seconds >= 2.0 * size:
            return f"{seconds / size:.0f} {unit}"
    return f"{max(seconds, 2.0):.0f} seconds"


def _numbers(problem: Problem) -> float:
    """Of Y_bar: modes n_eta^2."""
    return float(len(problem.topologies) * (problem.plant_states + problem.n * problem.nx) ** 2)


def _free_memory() -> float:
    """Bytes that programs may still take; where the system does not say, what is installed."""
    try:
        lines = Path("/proc/meminfo").read_text("ascii").splitlines()
        return next(1024.0 * float(line.split()[1]) for line in lines if line.startswith("MemAvailable:"))
    except (OSError, StopIteration):
        return float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
