"""What the search for the least exact gain takes, estimated before it begins: what the default method depends on.

The time is that of many gradients, and a gradient costs a bit and, for large networks, what it takes to pass over
Y_bar. How many it takes depends on more than can be known beforehand: docs/theory.md, section 6, says how far off the
estimate was. It is of the whole search, whose end a budget may come before.
"""

from __future__ import annotations

import math
import os
from pathlib import Path

from agent.contract.errors import InputError
from agent.contract.problem import Problem
from designer.search.descent import longest_horizon
from designer.search.windows import windows

MOST_NODES = 200  # that are searched at once; larger networks are searched in windows first
BUDGET = 600.0  # seconds
BUDGET_WHERE_SLOW, SLOW, FEW_STATES = (
    90.0,
    0.999,
    40,
)  # seconds, from this radius, for so many n nx: the rest gains little
LONG = 60.0  # worth a word beforehand
_GRADIENTS = 680  # of 6 nodes or fewer, over 20 steps or as many as that
_STEPS, _LEFT = 20, 2.0
_MORE = 2.65  # times as many of large networks
_OF_A_GRADIENT = 1.5e-3  # seconds, whatever the size
_OF_A_NUMBER = 5.3e-7  # seconds of a gradient, for each of the numbers of Y_bar
_WORK = 50  # matrices as large as Y_bar that the search keeps beside those of the horizon
_WORK_OF_WINDOWS = 35  # and without a search of the whole: starts, exact gain and proof
_OTHERS = 2e8  # bytes, whatever the size


def default_method(problem: Problem, *, designs: float = 1.0) -> str:
    """ "exact", but for large networks without windows, and for many designs that take more than the default budget."""
    if designs > 1.0:
        return "exact" if designs * seconds_of_exact(problem) <= BUDGET else "decomposed"
    return "exact" if problem.n <= MOST_NODES or in_windows(problem) else "decomposed"


def default_budget(problem: Problem) -> float:
    """Seconds that a search may take."""
    slow = problem.carries_plant and problem.plant.spectral_radius >= SLOW
    return BUDGET_WHERE_SLOW if slow and problem.n * problem.nx <= FEW_STATES else BUDGET


def in_windows(problem: Problem) -> bool:
    """Whether the network is searched in windows before it is searched at once."""
    return problem.n > MOST_NODES and bool(windows(problem))


def seconds_of_exact(problem: Problem) -> float:
    """Estimated processor time of method "exact" without a budget."""
    return gradients_of_exact(problem) * (_OF_A_GRADIENT + _OF_A_NUMBER * _numbers(problem))


def gradients_of_exact(problem: Problem) -> float:
    """Estimated number of gradients over 20 steps; one over 40 counts twice.

    Counted, it was within a factor 2 in most networks, but 11 times too low in one of 12 nodes whose horizon had to be
    lengthened to 320 steps: the problem does not tell beforehand that the least gains let errors decay slowly.
    """
    return _GRADIENTS * min(math.pow(max(problem.n / 6.0, 1.0), 1.4), _MORE) * _longer(problem)


def _longer(problem: Problem) -> float:
    """How many times 20 steps the horizon has to be, because what the plant holds decays slowly: e^-2 of it is left."""
    decay = 1.0 - min(problem.plant.spectral_radius, 1.0) ** 2 if problem.carries_plant else 1.0
    return min(max(_LEFT / (_STEPS * decay), 1.0), longest_horizon(problem) / _STEPS) if decay else 1.0


def whole_fits(problem: Problem, *, free: float | None = None) -> bool:
    """Whether there is memory to search the whole network at once; `free` in bytes, or as the system says."""
    return _bytes_of_whole(problem) <= (_free_memory() if free is None else free)


def refuse_without_memory(problem: Problem, *, free: float | None = None) -> None:
    """InputError where the search needs more memory than is free; `free` in bytes, or as the system says."""
    needed, free = _bytes_of_whole(problem), _free_memory() if free is None else free
    if in_windows(problem):
        needed = min(needed, _OTHERS + 8.0 * _WORK_OF_WINDOWS * _numbers(problem))
    if needed > free:
        raise InputError(
            f"{problem.name}: method exact needs about {needed / 1e9:.1f} GB of memory for {problem.n} nodes and "
            f"{len(problem.topologies)} modes, and {free / 1e9:.1f} GB are free; --method decomposed needs less"
        )


def _bytes_of_whole(problem: Problem) -> float:
    return _OTHERS + 8.0 * (longest_horizon(problem) + _WORK) * _numbers(problem)


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
