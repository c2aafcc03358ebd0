"""How long the search for the least exact gain takes, estimated before it begins: what the default method depends on.

The time grows with the free entries of the gains (how many steps the search takes), with the modes and with the size of
the error state (what a step costs). The estimate is rough. In seconds of processor time, measured and estimated: the
paper's examples (210 free entries, 4 modes, 10 states) 9 and 8, both estimated 9; quadruple-tank (1040, 3, 28) 19 and
115; 20 nodes (1362, 4, 42) 107 and 350; 30 nodes (2130, 4, 62) 840 and 898, which is where it matters. Lossy links make
a step dearer, and an unstable plant the search longer: inverted-pendulum takes 9 s in place of 2.
"""

from __future__ import annotations

import numpy as np

from agent.contract.problem import Problem
from designer.search.barrier import Entries

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
    return float(0.001 * modes * free**0.8 * size**1.5)


def in_words(seconds: float) -> str:
    """ "40 seconds", "12 minutes", "3 hours"."""
    for unit, size in (("hours", 3600.0), ("minutes", 60.0)):
        if seconds >= 2.0 * size:
            return f"{seconds / size:.0f} {unit}"
    return f"{max(seconds, 2.0):.0f} seconds"
