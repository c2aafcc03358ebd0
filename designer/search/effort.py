"""What the search for the least exact gain takes, estimated before it begins: what the default method depends on.

The time is that of many gradients, and a gradient costs a bit and, for large networks, what it takes to pass over
Y_bar. How many it takes depends on more than can be known beforehand, above all on how slowly errors decay at the least
gain: so beforehand there is a range, and while it goes on designer.search.outlook says more. docs/theory.md, section 6,
has what was measured.
"""

from __future__ import annotations

from typing import NamedTuple

from agent.contract.errors import InputError
from agent.contract.problem import Problem
from designer.decay import DENSE
from designer.search.descent import longest_horizon
from designer.search.memory import free_memory
from designer.search.outlook import growth
from designer.search.windows import windows

MOST_NODES = 200  # that are searched at once; larger networks are searched in windows first
BUDGET = 600.0  # seconds
BUDGET_WHERE_SLOW = 90.0  # seconds, after which little is gained where
_SLOW, _FEW_STATES = 0.999, 40  # the radius of the plant is this or more, and n nx no more than that
LONG, LARGE = 60.0, 5e8  # seconds and bytes, which are worth a word beforehand
_GRADIENTS = 680  # of 6 nodes or fewer, over 20 steps or as many as that
_STEPS, _LEFT = 20, 2.0
_FEWEST, _MORE = 300, 3.0  # where errors decay soon, and at most so many times as many of larger networks
_OF_A_WINDOW = 100  # gradients of one
_OF_THE_REST = 60  # gradients of a network in windows: start, exact gain and proof
_OF_A_GRADIENT = 1.5e-3  # seconds, whatever the size
_OF_A_NUMBER = 5.3e-7  # seconds of a gradient, for each of the numbers of Y_bar
_LEFT_AT_THE_END = 8.0  # e^-8 of what there was is left where a recursion ends
_MOST_OF_THE_END, _SOONER = 20_000, 300  # steps of it
_RECURSIONS, _STEPS_OF_A_GRADIENT = 40, 40  # of two exact gains and a proof; as long as a gradient takes
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
    slow = problem.carries_plant and problem.plant.spectral_radius >= _SLOW
    return BUDGET_WHERE_SLOW if slow and problem.n * problem.nx <= _FEW_STATES else BUDGET


def in_windows(problem: Problem) -> bool:
    """Whether the network is searched in windows before it is searched at once."""
    return problem.n > MOST_NODES and bool(windows(problem))


class Seconds(NamedTuple):
    """Of processor time that method "exact" takes, from `least` to `most`; without a budget `usual`, as a rule."""

    least: float
    usual: float
    most: float


def seconds_within(problem: Problem, budget: float) -> Seconds:
    """Estimated for a search that has so many seconds, of which a share is kept for the proof, at most half.

    But windows may take them all.
    """
    gradient, rest = _of_a_gradient(problem, problem.n), 0.0
    least = _FEWEST * min(growth(problem.n), _MORE) * _longer(problem) * gradient
    if in_windows(problem):
        rest = _OF_THE_REST * gradient
        least = rest + sum(_OF_A_WINDOW * _of_a_gradient(problem, len(window.nodes)) for window in windows(problem))
    most = budget if budget >= 2.0 * rest else budget + rest
    return Seconds(min(least, most), seconds_of_exact(problem), most)


def seconds_of_exact(problem: Problem) -> float:
    """Estimated processor time of method "exact" without a budget, as a rule."""
    return gradients_of_exact(problem) * _of_a_gradient(problem, problem.n)


def gradients_of_exact(problem: Problem) -> float:
    """Estimated number of gradients over 20 steps, as a rule; one over 40 counts twice."""
    return _GRADIENTS * growth(problem.n) * _longer(problem)


def seconds_of_the_end(problem: Problem) -> float:
    """Estimated for the choice and the proof, before anything is known of how slowly errors decay at the best gains.

    No faster than what the plant holds. Of few unknowns the border is known between what dies out and what grows, so
    that recursions end early.
    """
    radius = min(problem.plant.spectral_radius, 1.0) ** 2 if problem.carries_plant else 0.0
    unknowns, last = _numbers(problem, problem.n) / 2.0, _MOST_OF_THE_END
    steps = min(_LEFT_AT_THE_END / max(1.0 - radius, _LEFT_AT_THE_END / last), last if unknowns > DENSE else _SOONER)
    return _RECURSIONS * steps * _of_a_gradient(problem, problem.n) / _STEPS_OF_A_GRADIENT


def _of_a_gradient(problem: Problem, n: int) -> float:
    """Seconds, where n nodes are searched at once."""
    return _OF_A_GRADIENT + _OF_A_NUMBER * _numbers(problem, n)


def _longer(problem: Problem) -> float:
    """How many times 20 steps the horizon has to be, because what the plant holds decays slowly: e^-2 of it is left."""
    decay = 1.0 - min(problem.plant.spectral_radius, 1.0) ** 2 if problem.carries_plant else 1.0
    return min(max(_LEFT / (_STEPS * decay), 1.0), longest_horizon(problem) / _STEPS) if decay else 1.0


def whole_fits(problem: Problem, *, free: float | None = None) -> bool:
    """Whether there is memory to search the whole network at once; `free` in bytes, or as the system says."""
    return _bytes_of_whole(problem) <= (free_memory() if free is None else free)


def bytes_of_exact(problem: Problem, *, free: float | None = None) -> float:
    """The most memory that method "exact" takes, where so much is free; it has to do with no less than this."""
    whole = _bytes_of_whole(problem)
    if whole_fits(problem, free=free) or not in_windows(problem):
        return whole
    return min(whole, _OTHERS + 8.0 * _WORK_OF_WINDOWS * _numbers(problem, problem.n))


def refuse_without_memory(problem: Problem, *, free: float | None = None) -> None:
    """InputError where the search needs more memory than is free; `free` in bytes, or as the system says."""
    free = free_memory() if free is None else free
    needed = bytes_of_exact(problem, free=free)
    if needed > free:
        raise InputError(
            f"{problem.name}: method exact needs about {needed / 1e9:.1f} GB of memory for {problem.n} nodes and "
            f"{len(problem.topologies)} modes, and {free / 1e9:.1f} GB are free; --method decomposed needs less"
        )


def _bytes_of_whole(problem: Problem) -> float:
    return _OTHERS + 8.0 * (longest_horizon(problem) + _WORK) * _numbers(problem, problem.n)


def in_words(seconds: float) -> str:
    """ "40 seconds", "12 minutes", "3 hours"."""
    for unit, size in (("hours", 3600.0), ("minutes", 60.0)):
        if seconds >= 2.0 * size:
            return f"{seconds / size:.0f} {unit}"
    return f"{max(seconds, 2.0):.0f} seconds"


def _numbers(problem: Problem, n: int) -> float:
    """Of Y_bar of n nodes: modes n_eta^2."""
    return float(len(problem.topologies) * (problem.plant_states + n * problem.nx) ** 2)
