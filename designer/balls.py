"""Matrices in ball arithmetic: each entry is a number and a radius, and the exact entry lies within (python-flint).

A float is a dyadic rational, so it enters with radius 0; every operation widens the radii by its own rounding. What
is said of a matrix here is therefore said of the exact one. `flint.ctx.prec` is the number of bits carried.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from flint import arb, arb_mat
from numpy.typing import NDArray

from agent.contract.arrays import Array


class Sign(NamedTuple):
    """Whether a symmetric matrix is positive definite: proved, proved false, or neither."""

    proved: bool
    refuted: bool
    least: float  # its least eigenvalue after scaling, computed; a proved sign does not rest on it


UNDECIDED = Sign(proved=False, refuted=False, least=0.0)


def exact(matrix: Array) -> arb_mat:
    """The floats of a matrix, each as it is."""
    rows, columns = matrix.shape
    return arb_mat(rows, columns, [arb(entry) for entry in matrix.ravel().tolist()])


def floats(matrix: arb_mat) -> Array:
    """The midpoints, rounded."""
    return np.array([float(entry) for entry in matrix.entries()]).reshape(matrix.nrows(), matrix.ncols())


def identity(order: int) -> arb_mat:
    return exact(np.eye(order))


def part(matrix: arb_mat, rows: Sequence[int], columns: Sequence[int]) -> arb_mat:
    """The entries at these rows and columns."""
    return arb_mat(len(rows), len(columns), [matrix[i, j] for i in rows for j in columns])


def add(matrix: arb_mat, rows: Sequence[int], columns: Sequence[int], block: arb_mat) -> None:
    """Add a block to the entries at these rows and columns, in place."""
    for k, i in enumerate(rows):
        for m, j in enumerate(columns):
            matrix[i, j] = matrix[i, j] + block[k, m]


def sign(S: arb_mat, sizes: Array) -> Sign:
    """Whether the exact symmetric matrix within S is positive definite; sizes: what its diagonal is measured by.

    Where S falls apart into blocks, as (18) does by nodes, each is looked at by itself.
    """
    found = blocks(S)
    if len(found) == 1:
        return _sign(S, sizes)
    signs = [_sign(part(S, block, block), sizes[block]) for block in found]
    return Sign(
        proved=all(each.proved for each in signs),
        refuted=any(each.refuted for each in signs),
        least=min(each.least for each in signs),
    )


def filled(matrix: arb_mat) -> NDArray[np.bool_]:
    """Which entries are not exactly 0."""
    return np.array([not entry.is_zero() for entry in matrix.entries()]).reshape(matrix.nrows(), matrix.ncols())


def blocks(S: arb_mat) -> list[list[int]]:
    """The indices of a square matrix, in sets between which every entry is exactly 0."""
    joined = filled(S)
    joined |= joined.T
    left, found = np.ones(len(joined), dtype=bool), []
    while left.any():
        block = np.zeros(len(joined), dtype=bool)
        reached = left & (np.cumsum(left) == 1)  # the first of those left
        while reached.any():
            block |= reached
            reached = joined[reached].any(axis=0) & ~block
        left &= ~block
        found.append(np.flatnonzero(block).tolist())
    return found


def _sign(S: arb_mat, sizes: Array) -> Sign:
    """The sign of one block.

    Floats find a congruence, balls prove: X holds the eigenvectors of the scaled midpoints, and G = X'SX is nearly
    diagonal. If there are d > 0 with G_ii d_i > sum over j != i of |G_ij| d_j for every i, then diag(d) G diag(d) is
    strictly diagonally dominant, so G is positive definite by Gershgorin's theorem. X is then regular, for Xv = 0
    gives v'Gv = 0; so S is positive definite too. If some G_ii < 0, that column x of X has x'Sx < 0.
    """
    with np.errstate(all="ignore"):  # what overflows is left undecided
        scale = np.exp2(np.round(-np.log2(np.where(sizes > 0.0, sizes, 1.0)) / 2.0))  # powers of two scale exactly
        middle = floats(S) * scale * scale[:, None]
    if not np.isfinite(middle).all():
        return UNDECIDED
    X = exact(scale[:, None] * np.linalg.eigh(middle)[1])
    G = X.transpose() * (S * X)
    order = G.nrows()
    diagonal = [G[i, i] for i in range(order)]
    least = min(float(entry) for entry in diagonal)
    if not np.isfinite(least):
        return UNDECIDED
    if not least > 0.0:
        return Sign(proved=False, refuted=any(entry < 0 for entry in diagonal), least=least)
    d = exact(np.array([[float(entry) ** -0.5] for entry in diagonal]))
    rows = arb_mat(order, order, [abs(entry) for entry in G.entries()]) * d  # |G_ii| d_i is among the sum
    dominant = all(2 * G[i, i] * d[i, 0] > rows[i, 0] for i in range(order))
    return Sign(proved=dominant, refuted=False, least=least)


def above(Y: arb_mat) -> arb_mat:
    """A symmetric matrix of numbers, with radius 0, that is not below the exact symmetric matrix within Y.

    The radii are replaced by their row sums on the diagonal, which outweigh them by Gershgorin's theorem.
    """
    Y = (Y + Y.transpose()) * arb(0.5)
    middle = Y.mid()
    radii = (Y - middle) * exact(np.ones((Y.nrows(), 1)))
    for i in range(Y.nrows()):
        middle[i, i] = (middle[i, i] + radii[i, 0].abs_upper()).upper()
    return middle


def below(Y: arb_mat) -> arb_mat:
    """A symmetric matrix of numbers that is not above the exact symmetric matrix within Y."""
    return -above(-Y)
