"""Units in which the numbers of a problem and of its LMI are near 1, for the search and for the solvers."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agent.contract.arrays import Array
from agent.contract.gains import LinkMatrices
from agent.contract.problem import Problem
from agent.contract.problem.parts import CONTINUOUS
from designer.coordinates import Coordinates, filled, of_all_states, reached, shown
from designer.model.error_model import ErrorModel

_FEW = 8
_MOST = 2.0**30  # times 2^-53: by so much of itself z may move as gains are rounded
_STEPS_OF_SCALE = 8
_BITS = 36  # of 53: what decimals and units leave of rounding is a few units of the last


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

    The errors of a state have its unit.
    """
    reach, moved, nx = np.zeros((model.modes, model.size)), model.B, model.H.shape[1] // len(model.rows)
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(_STEPS_OF_SCALE):
            reach += (moved**2).sum(axis=2)
            moved = model.A @ moved
    of_state = reach.reshape(-1, nx).max(axis=0)
    units = of_all_states(
        of_state, lambda: np.abs(model.A).max(axis=0).reshape(-1, nx, model.size // nx, nx).max(axis=(0, 2))
    )
    return np.tile(1.0 / _power(units), model.size // nx)


class Measures(NamedTuple):
    """Units of the states, of the measurements of every node, and of z."""

    state: Array  # (nx,)
    y: list[Array]  # (ny_j,) each
    output: float


class NaturalUnits:
    """The problem with states, measurements and z in units in which they are near 1: the same one whatever its own are.

    Whoever measures states or measurements, each, or all of w or of z, in other units changes no number of `problem`
    by more than roundings. So each is rounded to _BITS, and nothing is left of those: not a bit of what is found here
    depends on the units, whether they are powers of two or any others, but where a number is within a few 2^-53 of the
    middle between two that it may be rounded to. From the problem that was given this one differs by its roundings: its
    gains are gains of that one, and whatever is claimed of them is to be proved there.

    Where `exactly`, nothing is rounded: units are powers of two, and `problem` is the one that was given, number by
    number. That is so where M cancels, as z would not bear it. There it may be the problem in other `coordinates`, and
    to get there takes a rounding; 2^-53 `magnified` (nx, nx) is how far, in its natural unit, z moves as an entry of
    K_ij that is 1 here is rounded on the way back.
    """

    def __init__(
        self, problem: Problem, coordinates: Coordinates | None = None, *, exactly: bool | None = None
    ) -> None:
        self.coordinates, self.magnified, self.given = coordinates, None, problem
        self.exactly = coordinates is not None or (Coordinates.of(problem) is not None if exactly is None else exactly)
        there = problem if coordinates is None else coordinates.problem
        common, rounded = None, there
        if not self.exactly:
            common = common_units(there)
            rounded = _rounded(_measured_in(there, common))
        near = _near_1(rounded)
        self.names, self.problem = problem.node_names, _measured_in(rounded, near)
        self.state, self.y, self.output = near if common is None else _times(common, near)
        if coordinates is not None:
            self.magnified = _magnified(coordinates, natural_units(problem).state, self.state)

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

    def rounded_there(self, K: LinkMatrices, H: LinkMatrices) -> tuple[LinkMatrices, LinkMatrices]:
        """The same, rounded as `problem` is: the same numbers, whatever units the gains were told in."""
        K, H = self.there(K, H)
        if self.exactly:
            return K, H
        K, H = _each(rounded, K), _each(rounded, H)
        return (_closed(self.problem, K) if self.problem.unbiased else K), H

    def back(self, K: LinkMatrices, H: LinkMatrices) -> tuple[LinkMatrices, LinkMatrices]:
        """Gains of `problem`, in the units of the problem that was given."""
        rows, y = self.state[:, None], dict(zip(self.names, self.y, strict=True))
        x = dict.fromkeys(self.names, self.state)
        K, H = _divided(K, rows, x), _divided(H, rows, y)
        if self.coordinates is not None:
            return self.coordinates.back(K, H)
        return (K if self.exactly or not self.given.unbiased else _closed(self.given, K)), H

    def P_back(self, P: Array) -> Array:
        """P (..., n_eta, n_eta) of `problem`, for the problem that was given, or for it in the other coordinates."""
        units = np.tile(self.state, P.shape[-1] // len(self.state))
        return np.asarray(P / (units[:, None] * units))

    def V_back(self, V: Array) -> Array:
        """Weights V (..., n_eta + nw, n_eta + nw) of [eta; w] likewise."""
        nw = self.given.nw
        units = np.concatenate([np.tile(self.state, (V.shape[-1] - nw) // len(self.state)), np.ones(nw)])
        return np.asarray(V * units[:, None] * units)


def common_units(problem: Problem) -> Measures:
    """Units that change as those of x, y, z and w do, but for rounding: they are made of sums without a minus.

    The unit of a state is the sum of all |A|^k |B| that reaches it, each half as heavy as the one before. A state that
    w does not reach has what moves other states and measurements by their units; one that moves none is nobody's
    concern, and keeps its unit.
    """
    A, nodes = np.abs(problem.plant.A), problem.nodes
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        state = moved = np.abs(problem.plant.B).sum(axis=1)
        for _ in range(problem.nx + _STEPS_OF_SCALE):
            moved = A @ moved / 2.0
            state = state + moved
        rows = [(node.C, node.D) for node in nodes]
        state = filled(
            state,
            lambda units: shown(A, units) + sum(shown(np.abs(C), _lengths(C * units, D)) for C, D in rows),
        )
    state = _or_1(state)
    y = [_or_1(_lengths(node.C * state, node.D)) for node in nodes]
    return Measures(state, y, float(_or_1(np.array(np.linalg.norm(problem.plant.M * state)))))


def _near_1(problem: Problem) -> Measures:
    """Powers of two, in which what w of unit energy can do is near 1."""
    state = _power(natural_units(problem).state)
    y = [_power(_lengths(node.C * state, node.D)) for node in problem.nodes]
    return Measures(state, y, float(_power(np.array(np.linalg.norm(problem.plant.M * state, 2)))))


def _lengths(C: Array, D: Array) -> Array:
    """Of the rows of [C D]."""
    return np.asarray(np.hypot(np.linalg.norm(C, axis=1), np.linalg.norm(D, axis=1)))


def _or_1(sizes: Array) -> Array:
    return np.where((sizes > 0.0) & np.isfinite(sizes), sizes, 1.0)


def _times(first: Measures, then: Measures) -> Measures:
    """Units, and units in these."""
    y = [first_j * then_j for first_j, then_j in zip(first.y, then.y, strict=True)]
    return Measures(first.state * then.state, y, first.output * then.output)


def _measured_in(problem: Problem, units: Measures) -> Problem:
    """The same problem in these units."""
    scaled = rescaled(problem, Units(units.state, units.output))
    nodes = [
        node.model_copy(update={"C": node.C / y[:, None], "D": node.D / y[:, None]})
        for node, y in zip(scaled.nodes, units.y, strict=True)
    ]
    return scaled.model_copy(update={"nodes": tuple(nodes)})


def _rounded(problem: Problem) -> Problem:
    """With matrices of _BITS bits."""
    plant = problem.plant
    nodes = [node.model_copy(update={"C": rounded(node.C), "D": rounded(node.D)}) for node in problem.nodes]
    matrices = {name: rounded(getattr(plant, name)) for name in ("A", "B", "M")}
    return problem.model_copy(update={"plant": plant.model_copy(update=matrices), "nodes": tuple(nodes)})


def rounded(numbers: Array) -> Array:
    """To _BITS bits each."""
    mantissas, exponents = np.frexp(numbers)
    return np.asarray(np.ldexp(np.rint(np.ldexp(mantissas, _BITS)), exponents - _BITS))


def _closed(problem: Problem, K: LinkMatrices) -> LinkMatrices:
    """With a_ii K_ii = A - sum over j != i of a_ij K_ij."""
    A, closed = problem.plant.A, {}
    for topology in problem.topologies:
        closed[topology.name] = {name: dict(row) for name, row in K[topology.name].items()}
        for own, weights, i in zip(problem.node_names, topology.adjacency, range(problem.n), strict=True):
            row = closed[topology.name][own]
            others = [weights[problem.node_names.index(j)] * K_ij for j, K_ij in row.items() if j != own]
            row[own] = (A - sum(others)) / weights[i]
    return closed


def _magnified(coordinates: Coordinates, given: Array, state: Array) -> Array:
    """`NaturalUnits.magnified`; `given` and `state`: natural units among the states and in these coordinates.

    Back among the states an entry that makes much of what cancels is large, and moves z as a rounding of it does.
    """
    columns = np.abs(coordinates.inverse.astype(np.float64)).T / given  # of T^-1
    left, right = state * columns.max(axis=1), (np.abs(coordinates.T) * given).max(axis=1) / state
    return np.asarray(np.outer(left, right) * right.max())


def _each(change: Callable[[Array], Array], gains: LinkMatrices) -> LinkMatrices:
    return {
        mode: {i: {j: change(G) for j, G in heard.items()} for i, heard in of_mode.items()}
        for mode, of_mode in gains.items()
    }


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
