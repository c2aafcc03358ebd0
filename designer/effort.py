"""How long the search for the least exact gain takes, estimated before it begins: what the default method depends on.

The search takes about 12 f^0.7 steps for f free entries of the gains, and a step about 0.17 ms m N^1.4 for m modes and
N entries of the error state. The factors are a fit to measured times of one core (benchmarks/design.py measures them
anew): within a factor of 3 of what problems from 4 nodes to 30 took, and beyond that an extrapolation.
"""

from __future__ import annotations

import numpy as np

from agent.contract.problem import Problem
from designer.barrier import Entries

LONGEST = 600.0  # seconds that a default may take
LONG = 60.0  # worth a word beforehand


def default_method(problem: Problem, *, designs: float = 1.0) -> str:
    """ "exact" where so many designs of this size take at most about ten minutes, else "decomposed"."""
    return "exact" if designs * seconds_of_exact(problem) <= LONGEST else "decomposed"


def seconds_of_exact(problem: Problem) -> float:
    """Estimated processor time of method "exact", without the certificate."""
    modes, size = len(problem.topologies), (problem.n + 1) * problem.nx
    entries = Entries(problem)
    free = float(np.count_nonzero(entries.K) + np.count_nonzero(entries.H))
    return float(0.002 * modes * free**0.7 * size**1.4)


def in_words(seconds: float) -> str:
    """ "40 seconds", "12 minutes", "3 hours"."""
    for unit, size in (("hours", 3600.0), ("minutes", 60.0)):
        if seconds >= 2.0 * size:
            return f"{seconds / size:.0f} {unit}"
    return f"{max(seconds, 2.0):.0f} seconds"
