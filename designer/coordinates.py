"""Coordinates of the states in which nothing cancels in M: docs/theory.md, section 6.

Where z = x_1 - 1.000001 x_2, and w moves x_1 and x_2 alike, z is small, and M'M and all else that is a square loses
twice the digits that cancel. So z itself is taken for a state, in the place of one that it is made of: x' = T x, where
T is the identity with rows of M in it. With e_i' = T e_i, T K_ij T^-1 and T H_ij it is the same network, with the same
z, and a row of M is a row of the identity. T is made of floats of the problem as they stand, its inverse of fractions,
and all that is carried over is rounded once.
"""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from agent.contract.arrays import Array
from agent.contract.gains import LinkMatrices
from agent.contract.problem import Problem
from agent.contract.problem.parts import CONTINUOUS

_CANCELS = 2.0**-7  # z that w makes smaller than this part of what it is made of: its square has lost 14 bits
_DOUBLINGS = 20  # 2^20 terms of the sum of A^k B B' A'^k
_DAMPED = 0.95


def reached(problem: Problem) -> Array:
    """The sum of all A^k B B' A'^k, (nx, nx): how far a w of unit energy brings the states, no further.

    An unstable plant can be brought anywhere: its A is taken with less weight, as if its spectral radius were 0.95.
    Near radius 1 rounding can make it overflow.
    """
    radius = problem.plant.spectral_radius
    gramian, power = problem.plant.B @ problem.plant.B.T, problem.plant.A * (_DAMPED / radius if radius >= 1.0 else 1.0)
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(_DOUBLINGS):
            gramian, power = gramian + power @ gramian @ power.T, power @ power
    return np.asarray(gramian)


def of_all_states(reach: Array, moves: Callable[[], Array]) -> Array:
    """Units of states by the square of what w makes of them, (nx,), and by the largest |a_ij|, (nx, nx), for the rest.

    A state that w does not reach has what moves the others by theirs; one that moves none of them has the largest.
    """
    known = (reach > 0.0) & np.isfinite(reach)
    units = np.sqrt(np.where(known, reach, 0.0))
    if not known.all():
        rows = moves()
        units = filled(units, lambda units: shown(rows, units))
    return np.where(units > 0.0, units, units.max() or 1.0)


def filled(units: Array, by: Callable[[Array], Array]) -> Array:
    """Where they are 0 the inverse of what is shown of a state in those that are not, as far as it is shown by any."""
    for _ in units:
        more = by(units)
        units = np.where((units > 0.0) | (more == 0.0), units, 1.0 / np.where(more == 0.0, 1.0, more))
    return units


def shown(rows: Array, units: Array) -> Array:
    """The sum of all rows, each in its unit, but for those without one."""
    return np.asarray((rows[units > 0.0] / units[units > 0.0, None]).sum(axis=0))


class Coordinates:
    """x' = T x, T (nx, nx) regular; `inverse` is that of T, in fractions."""

    def __init__(self, problem: Problem, T: Array, inverse: Any) -> None:
        self._given, self.T, self.inverse = problem.certain(), T, inverse

    @classmethod
    def of(cls, problem: Problem) -> Coordinates | None:
        """In which no row of M cancels any more; None where none does, or nothing helps."""
        found, there, taken = None, problem, np.zeros(problem.nx, dtype=bool)
        T, inverse = np.eye(problem.nx), fractions(np.eye(problem.nx))
        while (row := _cancelling(there, taken)) is not None:
            r, j = row
            m, undone = (fractions(problem.plant.M) @ inverse)[r], fractions(np.eye(problem.nx))
            undone[j], T[j], taken[j] = -m / m[j], problem.plant.M[r], True
            undone[j, j] = 1 / m[j]
            inverse = inverse @ undone
            found = cls(problem, T.copy(), inverse)
            there = found.problem
        return found

    @cached_property
    def problem(self) -> Problem:
        """The problem in these coordinates, without tolerances and initial error: each entry rounded once."""
        given, T, plant = self._given, fractions(self.T), self._given.plant
        moved: dict[str, Array | None] = {
            "A": _floats(T @ fractions(plant.A) @ self.inverse),
            "B": _floats(T @ fractions(plant.B)),
            "M": _floats(fractions(plant.M) @ self.inverse),
        }
        moved |= {**dict.fromkeys(CONTINUOUS), "initial_error": None}
        nodes = [node.model_copy(update={"C": _floats(fractions(node.C) @ self.inverse)}) for node in given.nodes]
        return given.model_copy(update={"plant": plant.model_copy(update=moved), "nodes": tuple(nodes)})

    def states(self, x: Array) -> Array:
        """T x of every row of x, (any, nx), rounded."""
        return _floats(fractions(x) @ fractions(self.T).T)

    def there(self, K: LinkMatrices, H: LinkMatrices) -> tuple[LinkMatrices, LinkMatrices]:
        """Gains of the problem that was given, for `problem`; where they are unbiased K_ii is what the others leave."""
        if self._given.unbiased:
            K = self._closed(K)
        T = fractions(self.T)
        return _turned(K, T, self.inverse), _turned(H, T, None)

    def back(self, K: LinkMatrices, H: LinkMatrices) -> tuple[LinkMatrices, LinkMatrices]:
        """Gains of `problem`, for the problem that was given."""
        return _turned(K, self.inverse, fractions(self.T)), _turned(H, self.inverse, None)

    def _closed(self, K: LinkMatrices) -> Any:
        """K with a_ii K_ii = A - sum over j != i of a_ij K_ij, in fractions."""
        given, names, A = self._given, self._given.node_names, fractions(self._given.plant.A)
        closed: dict[str, dict[str, dict[str, Any]]] = {}
        for s, topology in enumerate(given.topologies):
            a, closed[topology.name] = fractions(topology.adjacency), {}
            for i, receiver in enumerate(names):
                row = {names[j]: fractions(K[topology.name][receiver][names[j]]) for j in given.neighbours(s, i)}
                others = [a[i, j] * row[names[j]] for j in given.neighbours(s, i) if j != i]
                closed[topology.name][receiver] = {**row, receiver: (A - sum(others)) / a[i, i]}
        return closed


class There(NamedTuple):
    """A problem and gains for it in which M does not cancel, of [T x; T e]; T None: as they were given."""

    problem: Problem
    K: LinkMatrices
    H: LinkMatrices
    T: Array | None

    @classmethod
    def of(cls, problem: Problem, K: LinkMatrices, H: LinkMatrices) -> There:
        coordinates = Coordinates.of(problem)
        if coordinates is None:
            return cls(problem, K, H, None)
        return cls(coordinates.problem, *coordinates.there(K, H), coordinates.T)


def _cancelling(problem: Problem, taken: Any) -> tuple[int, int] | None:
    """A row of M that cancels, and the largest of what it is made of that is not yet `taken`, (nx,), for another."""
    spread, M = reached(problem), problem.plant.M
    with np.errstate(over="ignore", invalid="ignore"):  # of numbers near the ends of float64 nothing is said
        parts = np.abs(M) * np.sqrt(np.diag(spread))
        sizes = np.sqrt(np.maximum(np.einsum("ri,ij,rj->r", M, spread, M), 0.0))
    if not (np.isfinite(parts).all() and np.isfinite(sizes).all()):
        return None
    parts_left = np.where(taken, 0.0, parts)
    for r in np.flatnonzero(sizes < _CANCELS * parts.sum(axis=1)):
        if parts_left[r].any():
            return int(r), int(parts_left[r].argmax())
    return None


def fractions(matrix: Any) -> Any:
    """The floats as they are, an array of fractions; fractions as they are."""
    made = np.empty(np.shape(matrix), dtype=object)
    made.reshape(-1)[:] = [Fraction(entry) for entry in np.asarray(matrix).reshape(-1).tolist()]
    return made


def _floats(matrix: Any) -> Array:
    return np.asarray(matrix, dtype=np.float64)


def _turned(gains: Any, left: Any, right: Any) -> LinkMatrices:
    """left G right of every matrix, or left G, rounded."""
    return {
        mode: {
            i: {
                j: _floats(left @ fractions(G) if right is None else left @ fractions(G) @ right)
                for j, G in row.items()
            }
            for i, row in of_mode.items()
        }
        for mode, of_mode in gains.items()
    }
