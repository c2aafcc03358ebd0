"""Units in which the numbers of a problem and of its LMI are near 1, for the search and for the solvers."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from agent.contract.arrays import Array
from agent.contract.problem import Problem
from designer.model.error_model import ErrorModel

_DOUBLINGS = 20  # 2^20 terms of the sum of A^k B B' A'^k
_DAMPED = 0.95
_FEW = 8
_STEPS_OF_SCALE = 8


class Units(NamedTuple):
    """x = diag(state) x', e_i = error diag(state) e_i', and z = output z'."""

    state: Array  # (nx,)
    output: float
    error: float = 1.0  # only the decomposed LMI measures errors and states differently


def natural_units(problem: Problem) -> Units:
    """State units that a w of unit energy can reach and no more; the output unit that makes M near 1 in them.

    An unstable plant can be brought anywhere: its A is taken with less weight, as if its spectral radius were 0.95.
    A state keeps its unit where w cannot reach it, or so far that it overflows: rounding can do that near radius 1.
    n errors share what R has for one state, so Q_i is of the order R/n and delta of the order n. Networks of more than
    _FEW nodes have errors in larger units, so that Q_i and delta are those of _FEW: of 200 nodes the solver takes 24
    steps in place of 31.
    """
    radius = problem.plant.spectral_radius
    gramian, power = problem.plant.B @ problem.plant.B.T, problem.plant.A * (_DAMPED / radius if radius >= 1.0 else 1.0)
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(_DOUBLINGS):
            gramian, power = gramian + power @ gramian @ power.T, power @ power
        reach = np.sqrt(np.diag(gramian))
    state = np.where((reach > 0.0) & np.isfinite(reach), reach, 1.0)
    error = math.sqrt(max(problem.n / _FEW, 1.0))
    return Units(state, float(np.linalg.norm(problem.plant.M * state, 2)) or 1.0, error)


def natural_scale(model: ErrorModel) -> Array:
    """For each entry of eta a power of two, 1 over about what w of energy 1 makes of it within a few steps, (n_eta,).

    The errors of a state have its unit. A state that w does not reach has the largest of the others.
    """
    reach, moved, nx = np.zeros((model.modes, model.size)), model.B, model.H.shape[1] // len(model.rows)
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(_STEPS_OF_SCALE):
            reach += (moved**2).sum(axis=2)
            moved = model.A @ moved
    of_state = reach.reshape(-1, nx).max(axis=0)
    known = (of_state > 0.0) & np.isfinite(of_state)
    of_state = np.where(known, of_state, of_state[known].max(initial=0.0) or 1.0)
    return np.tile(np.exp2(np.round(-np.log2(of_state) / 2.0)), model.size // nx)


def rescaled(problem: Problem, units: Units) -> Problem:
    """The same problem in the given units; w and y keep theirs."""
    plant, columns, rows = problem.plant, units.state, units.state[:, None]
    scaled = plant.model_copy(
        update={"A": plant.A * columns / rows, "B": plant.B / rows, "M": plant.M * columns / units.output}
    )
    nodes = tuple(node.model_copy(update={"C": node.C * columns}) for node in problem.nodes)
    return problem.model_copy(update={"plant": scaled, "nodes": nodes})
