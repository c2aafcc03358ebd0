"""Units in which the numbers of a problem and of its LMI are near 1, for the search and for the solvers."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agent.contract.arrays import Array
from agent.contract.gains import LinkMatrices
from agent.contract.problem import Problem
from agent.contract.problem.parts import CONTINUOUS
from designer.coordinates import Coordinates, reached
from designer.model.error_model import ErrorModel

_FEW = 8
_MOST = 2.0**30  # times 2^-53: by so much of itself z may move as gains are rounded
_STEPS_OF_SCALE = 8


class Units(NamedTuple):
    """x = diag(state) x', e_i = error diag(state) e_i', and z = output z'."""

    state: Array  # (nx,)
    output: float
    error: float = 1.0  # only the decomposed LMI measures errors and states differently


def natural_units(problem: Problem) -> Units:
    """State units that a w of unit energy can reach and no more; the output unit that makes M near 1 in them.

    As `reached` has it, for an unstable plant too. A state keeps its unit where w cannot reach it, or so far that it
    overflows: rounding can do that near radius 1.
    n errors share what R has for one state, so Q_i is of the order R/n and delta of the order n. Networks of more than
    _FEW nodes have errors in larger units, so that Q_i and delta are those of _FEW: of 200 nodes the solver takes 24
    steps in place of 31.
    """
    with np.errstate(invalid="ignore"):
        reach = np.sqrt(np.diag(reached(problem)))
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
    return np.tile(1.0 / _power(np.sqrt(of_state)), model.size // nx)


class NaturalUnits:
    """The problem with states, measurements and z in powers of two of their units, in which they are near 1.

    So it is the same problem, number by number, and gains go to and fro without rounding: whatever is found in these
    units does not depend, by a single bit, on the powers of two that somebody measures in. Where M cancels, that is so
    of the problem in other `coordinates`, and to get there takes a rounding; 2^-53 `magnified` (nx, nx) is how far, in
    its natural unit, z moves as an entry of K_ij that is 1 here is rounded on the way back.
    """

    def __init__(self, problem: Problem, coordinates: Coordinates | None = None) -> None:
        self.coordinates, self.magnified = coordinates, None
        given, problem = problem, problem if coordinates is None else coordinates.problem
        self.state = _power(natural_units(problem).state)
        self.y = [
            _power(np.hypot(np.linalg.norm(node.C * self.state, axis=1), np.linalg.norm(node.D, axis=1)))
            for node in problem.nodes
        ]
        self.output = float(_power(np.array(np.linalg.norm(problem.plant.M * self.state, 2))))
        scaled = rescaled(problem, Units(self.state, self.output))
        nodes = [
            node.model_copy(update={"C": node.C / y[:, None], "D": node.D / y[:, None]})
            for node, y in zip(scaled.nodes, self.y, strict=True)
        ]
        self.names, self.problem = problem.node_names, scaled.model_copy(update={"nodes": tuple(nodes)})
        if coordinates is not None:
            self.magnified = _magnified(coordinates, natural_units(given).state, self.state)

    @property
    def held(self) -> NDArray[np.bool_] | None:
        """Entries (nx, nx) of K_ij that a search holds at 0, as no file could hold them if they were near 1."""
        return None if self.magnified is None else self.magnified > _MOST

    def there(self, K: LinkMatrices, H: LinkMatrices) -> tuple[LinkMatrices, LinkMatrices]:
        """Gains of the problem that was given, in the units of `problem`."""
        if self.coordinates is not None:
            K, H = self.coordinates.there(K, H)
        rows, y = 1.0 / self.state[:, None], {name: 1.0 / y for name, y in zip(self.names, self.y, strict=True)}
        x = dict.fromkeys(self.names, 1.0 / self.state)
        return _divided(K, rows, x), _divided(H, rows, y)

    def back(self, K: LinkMatrices, H: LinkMatrices) -> tuple[LinkMatrices, LinkMatrices]:
        """Gains of `problem`, in the units of the problem that was given."""
        rows, y = self.state[:, None], dict(zip(self.names, self.y, strict=True))
        x = dict.fromkeys(self.names, self.state)
        K, H = _divided(K, rows, x), _divided(H, rows, y)
        return (K, H) if self.coordinates is None else self.coordinates.back(K, H)


def _magnified(coordinates: Coordinates, given: Array, state: Array) -> Array:
    """`NaturalUnits.magnified`; `given` and `state`: natural units among the states and in these coordinates.

    Back among the states an entry that makes much of what cancels is large, and moves z as a rounding of it does.
    """
    columns = np.abs(coordinates.inverse.astype(np.float64)).T / given  # of T^-1
    left, right = state * columns.max(axis=1), (np.abs(coordinates.T) * given).max(axis=1) / state
    return np.asarray(np.outer(left, right) * right.max())


def _divided(gains: LinkMatrices, rows: Array, by: dict[str, Array]) -> LinkMatrices:
    """Every matrix times `rows`, and over what the node that it hears measures in."""
    return {
        mode: {i: {j: G * rows / by[j] for j, G in heard.items()} for i, heard in of_mode.items()}
        for mode, of_mode in gains.items()
    }


def _power(sizes: Array) -> Array:
    """The powers of two that are not above; exactly, so that twice as much has twice the power."""
    return np.asarray(np.ldexp(1.0, np.frexp(np.where(sizes > 0.0, sizes, 1.0))[1] - 1))


def rescaled(problem: Problem, units: Units) -> Problem:
    """The same problem in the given units, without tolerances; w and y keep their units."""
    problem = problem.certain()
    plant, columns, rows = problem.plant, units.state, units.state[:, None]
    scaled = plant.model_copy(
        update={
            **dict.fromkeys(CONTINUOUS),
            "A": plant.A * columns / rows,
            "B": plant.B / rows,
            "M": plant.M * columns / units.output,
            "initial_error": None if plant.initial_error is None else plant.initial_error / columns,
        }
    )
    nodes = tuple(node.model_copy(update={"C": node.C * columns}) for node in problem.nodes)
    return problem.model_copy(update={"plant": scaled, "nodes": nodes})
