"""Units in which a problem's numbers are near 1, for a solver that failed in the problem's own."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from agent.contract.arrays import Array
from agent.contract.problem import Problem

_DOUBLINGS = 20  # 2^20 terms of the sum of A^k B B' A'^k
_DAMPED = 0.95


class Units(NamedTuple):
    """x = diag(state) x' and z = output z'."""

    state: Array  # (nx,)
    output: float


def natural_units(problem: Problem) -> Units:
    """State units that a w of unit energy can reach and no more; the output unit that makes M near 1 in them.

    An unstable plant can be brought anywhere: its A is taken with less weight, as if its spectral radius were 0.95.
    """
    radius = problem.plant.spectral_radius
    gramian, power = problem.plant.B @ problem.plant.B.T, problem.plant.A * (_DAMPED / radius if radius >= 1.0 else 1.0)
    for _ in range(_DOUBLINGS):
        gramian, power = gramian + power @ gramian @ power.T, power @ power
    reach = np.sqrt(np.diag(gramian))
    state = np.where(reach > 0.0, reach, 1.0)
    return Units(state, float(np.linalg.norm(problem.plant.M * state, 2)) or 1.0)


def rescaled(problem: Problem, units: Units) -> Problem:
    """The same problem in the given units; w and y keep theirs."""
    plant, columns, rows = problem.plant, units.state, units.state[:, None]
    scaled = plant.model_copy(
        update={"A": plant.A * columns / rows, "B": plant.B / rows, "M": plant.M * columns / units.output}
    )
    nodes = tuple(node.model_copy(update={"C": node.C * columns}) for node in problem.nodes)
    return problem.model_copy(update={"plant": scaled, "nodes": nodes})
