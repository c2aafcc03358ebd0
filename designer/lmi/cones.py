"""Linear matrix inequalities as cone data: minimise q'u subject to b - A u in a product of semidefinite cones.

A matrix stands in b - A u as the vector of its upper triangle, column by column, with the off-diagonal entries
times sqrt(2), so that inner products stay. An unknown matrix is an integer array: where its entries stand in u.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from agent.contract.arrays import Array

Indices = NDArray[np.int64]


class Cones(NamedTuple):
    """The constraints: b - A u, cut into pieces, holds the upper triangle of a matrix of each order."""

    A: scipy.sparse.csc_matrix  # (sum of the triangles, unknowns)
    b: Array
    orders: list[int]

    def piece(self, z: Array, number: int) -> Array:
        """The matrix of one inequality, (order, order), out of a vector like b."""
        sizes = [order * (order + 1) // 2 for order in self.orders]
        first, order = sum(sizes[:number]), self.orders[number]
        return _matrix(z[first : first + sizes[number]], order)

    def without(self, dropped: dict[int, Indices]) -> Cones:
        """With nothing asked of these rows and columns of the inequalities of these numbers: in `piece` they are 0."""
        A, b = self.A.tolil(), self.b.copy()
        first = 0
        for number, order in enumerate(self.orders):
            columns, rows = np.tril_indices(order)
            at = dropped.get(number, np.zeros(0, dtype=np.int64))
            left_out = np.flatnonzero(np.isin(rows, at) | np.isin(columns, at))
            for k in left_out:
                A.rows[first + k], A.data[first + k] = [], []
                b[first + k] = float(rows[k] == columns[k])
            first += order * (order + 1) // 2
        return Cones(scipy.sparse.csc_matrix(A), b, self.orders)


class Assembly:
    """Hands out unknowns and inequalities; `cones` puts the inequalities together."""

    def __init__(self) -> None:
        self.unknowns = 0
        self._inequalities: list[Inequality] = []

    def unknown(self, rows: int, columns: int) -> Indices:
        """An unknown matrix, (rows, columns)."""
        first, self.unknowns = self.unknowns, self.unknowns + rows * columns
        return np.arange(first, self.unknowns).reshape(rows, columns)

    def symmetric(self, order: int) -> Indices:
        """An unknown symmetric matrix, (order, order)."""
        first, self.unknowns = self.unknowns, self.unknowns + order * (order + 1) // 2
        i = np.arange(order)
        return first + _triangle(np.minimum.outer(i, i), np.maximum.outer(i, i))

    def inequality(self) -> Inequality:
        """A new inequality, of order 0 until rows are appended to it."""
        self._inequalities.append(Inequality(len(self._inequalities)))
        return self._inequalities[-1]

    def cones(self) -> Cones:
        """All inequalities, one below the other."""
        orders = [each.order for each in self._inequalities]
        firsts = np.cumsum([0, *(order * (order + 1) // 2 for order in orders)])
        b = np.zeros(firsts[-1])
        rows, unknowns, values = [], [], []
        for first, each in zip(firsts, self._inequalities, strict=False):
            for at, number in each.numbers:
                np.add.at(b, first + at, number)
            for at, unknown, coefficient in each.terms:
                rows.append(first + at)
                unknowns.append(unknown)
                values.append(-coefficient)
        triplets = np.concatenate(values), (np.concatenate(rows), np.concatenate(unknowns))
        return Cones(scipy.sparse.csc_matrix(triplets, shape=(len(b), self.unknowns)), b, orders)


class Inequality:
    """A symmetric matrix, affine in the unknowns, that has to be positive semidefinite.

    Only the upper triangle is kept: a block that stands off the diagonal is added once, above it, and a block
    that stands on the diagonal is added whole.
    """

    def __init__(self, number: int = 0) -> None:
        self.number = number  # counted from the first of its assembly
        self.order = 0
        self.terms: list[tuple[Indices, Indices, Array]] = []  # places in the triangle, unknowns, coefficients
        self.numbers: list[tuple[Indices, Array]] = []  # places in the triangle, numbers

    def append(self, size: int) -> Indices:
        """More rows and columns, zero so far, after those that are there; returns where they are."""
        first, self.order = self.order, self.order + size
        return np.arange(first, self.order)

    def add(
        self,
        rows: Indices,
        columns: Indices,
        V: Indices,
        *,
        factor: float = 1.0,
        left: Array | None = None,
        right: Array | None = None,
    ) -> None:
        """Add factor left V right, for an unknown V; what is not given is the identity."""
        if left is None and right is None:
            a, b = np.indices(V.shape).reshape(2, -1)
            self._keep(rows[a], columns[b], np.full(V.size, factor), V.ravel())
            return
        left = np.eye(V.shape[0]) if left is None else left
        right = np.eye(V.shape[1]) if right is None else right
        coefficient = factor * left[:, None, :, None] * right.T[None, :, None, :]  # [a, b, k, l]: of V_kl in entry ab
        a, b, k, l = np.nonzero(coefficient)  # noqa: E741
        self._keep(rows[a], columns[b], coefficient[a, b, k, l], V[k, l])

    def add_number(self, rows: Indices, columns: Indices, matrix: Array) -> None:
        """Add a matrix that is known."""
        a, b = np.nonzero(matrix)
        self._keep(rows[a], columns[b], matrix[a, b], None)

    def value(self, u: Array) -> Array:
        """The matrix for the unknowns u, (order, order)."""
        upper = np.zeros(self.order * (self.order + 1) // 2)
        for at, number in self.numbers:
            np.add.at(upper, at, number)
        for at, unknown, coefficient in self.terms:
            np.add.at(upper, at, coefficient * u[unknown])
        return _matrix(upper, self.order)

    def _keep(self, rows: Indices, columns: Indices, values: Array, unknowns: Indices | None) -> None:
        upper = rows <= columns
        at = _triangle(rows[upper], columns[upper])
        values = np.where(rows < columns, math.sqrt(2.0), 1.0)[upper] * values[upper]
        if unknowns is None:
            self.numbers.append((at, values))
        else:
            self.terms.append((at, unknowns[upper], values))


def _matrix(upper: Array, order: int) -> Array:
    """The symmetric matrix of which this is the upper triangle, its off-diagonal entries times sqrt(2)."""
    columns, rows = np.tril_indices(order)
    matrix = np.zeros((order, order))
    matrix[rows, columns] = matrix[columns, rows] = upper / np.where(rows < columns, math.sqrt(2.0), 1.0)
    return matrix


def _triangle(rows: Indices, columns: Indices) -> Indices:
    """Where entries with rows <= columns stand in the upper triangle, column by column."""
    return np.asarray(rows + columns * (columns + 1) // 2)
