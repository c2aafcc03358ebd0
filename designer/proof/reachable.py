"""A problem seen from T, on [T x; T e; w], in fractions: of its states those that w can bring about, and no others.

Where w never moves some combination of the states, they stay within the span L of B, AB, A^2 B, ..., and so does every
best estimate. Weights that prove something strictly can only be weights there. With A L = L A', B = L B' and T L = I,
(17) and (18) on x = L x', e_i = L e_i' are those of A', B', C L and M L.
"""

from __future__ import annotations

from fractions import Fraction
from typing import Any, NamedTuple

import numpy as np
from flint import fmpq, fmpq_mat

from agent.contract.arrays import Array
from agent.contract.problem import Problem
from agent.contract.problem.parts import CONTINUOUS
from designer.coordinates import fractions


class Seen(NamedTuple):
    """A (r, r), B (r, nw), M (nz, r) and C of each node (ny, r), as arrays of fractions."""

    A: Any
    B: Any
    M: Any
    C: list[Any]

    @property
    def states(self) -> int:
        return len(self.A)


def reachable(problem: Problem) -> fmpq_mat:
    """A basis of what w can bring about, (nx, r), the identity at r of the states; (nx, 0) where w moves nothing."""
    A, found = rational(problem.plant.A), _basis(rational(problem.plant.B).transpose())
    while found.nrows() < problem.nx:
        moved = found * A.transpose()
        together = _basis(fmpq_mat(2 * found.nrows(), problem.nx, [*found.entries(), *moved.entries()]))
        if together.nrows() == found.nrows():
            break
        found = together
    return found.transpose()


def pivots(basis: fmpq_mat) -> Array:
    """T (r, nx) that picks the states at which the basis is the identity."""
    T = np.zeros((basis.ncols(), basis.nrows()))
    for k in range(basis.ncols()):
        T[k, next(j for j in range(basis.nrows()) if basis[j, k] != 0)] = 1.0
    return T


def on_reachable(problem: Problem) -> tuple[Problem | None, Array]:
    """The problem on states that say all that w brings about, rounded, and T (r, nx) that picks them; None: none."""
    basis = reachable(problem)
    if basis.ncols() == problem.nx or not basis.ncols():
        return (problem if basis.ncols() else None), np.eye(problem.nx)
    T = pivots(basis)
    seen = seen_from(problem, T)
    assert seen is not None
    matrices = {name: np.asarray(getattr(seen, name), dtype=np.float64) for name in ("A", "B", "M")}
    plant = problem.plant.model_copy(update={**dict.fromkeys(CONTINUOUS), **matrices, "initial_error": None})
    nodes = [
        node.model_copy(update={"C": np.asarray(C, dtype=np.float64)})
        for node, C in zip(problem.certain().nodes, seen.C, strict=True)
    ]
    return problem.certain().model_copy(update={"plant": plant, "nodes": tuple(nodes)}), T


def seen_from(problem: Problem, T: Array | None = None) -> Seen | None:
    """None: w moves nothing, or not all that it does is told apart from T. T None: from the states as they are."""
    basis = reachable(problem)
    T = pivots(basis) if T is None else T
    if not basis.ncols() or T.shape != (basis.ncols(), problem.nx):
        return None
    t, plant = rational(T), problem.plant
    try:
        L = basis * (t * basis).inv()
    except ZeroDivisionError:
        return None
    return Seen(
        _fractions(t * rational(plant.A) * L),
        _fractions(t * rational(plant.B)),
        _fractions(rational(plant.M) * L),
        [_fractions(rational(node.C) * L) for node in problem.nodes],
    )


def between(T: Array, other: Array) -> Array:
    """S (r, nx) with S T = `other`, T (nx, nx) regular, rounded; ZeroDivisionError where it is not."""
    return np.asarray(_fractions(rational(other) * rational(T).inv()), dtype=np.float64)


def rational(matrix: Any) -> fmpq_mat:
    """The floats or fractions of a matrix, each as it is."""
    rows, columns = np.shape(matrix)
    return fmpq_mat(rows, columns, [fmpq(f.numerator, f.denominator) for f in fractions(matrix).reshape(-1)])


def _basis(rows: fmpq_mat) -> fmpq_mat:
    """The reduced echelon form of some rows, without those that are 0."""
    reduced, rank = rows.rref()
    return fmpq_mat(rank, rows.ncols(), reduced.entries()[: rank * rows.ncols()])


def _fractions(matrix: fmpq_mat) -> Any:
    made = np.empty(matrix.nrows() * matrix.ncols(), dtype=object)
    made[:] = [Fraction(int(entry.p), int(entry.q)) for entry in matrix.entries()]
    return made.reshape(matrix.nrows(), matrix.ncols())
