"""Matrices in ball arithmetic: each entry is a number and a radius, and the exact entry lies within (python-flint).

A float is a dyadic rational, so it enters with radius 0; every operation widens the radii by its own rounding. What
is said of a matrix here is therefore said of the exact one. `flint.ctx.prec` is the number of bits carried.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
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
Entries = dict[tuple[int, int], arb]  # by row and column; the others are exactly 0

_RESOLVED = 1e-12  # floats know an eigenvalue this far above 0, of a matrix with about 1 on its diagonal
_SMALL = 16  # up to this order eigenvectors are as fast
_FEW = 8  # a row is sparse if at most one in so many of its entries is filled


def exact(matrix: Array) -> arb_mat:
    """The floats of a matrix, each as it is."""
    balls, numbers = arb_mat(*matrix.shape), matrix.tolist()
    for i, j in np.argwhere(matrix).tolist():
        balls[i, j] = numbers[i][j]
    return balls


def floats(matrix: arb_mat) -> Array:
    """The midpoints, rounded."""
    return np.array([float(entry) for entry in matrix.entries()]).reshape(matrix.nrows(), matrix.ncols())


def diagonal(matrix: arb_mat) -> Array:
    """The midpoints of a square matrix on its diagonal, rounded."""
    return np.array([float(matrix[i, i]) for i in range(matrix.nrows())])


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

    What Cholesky does not prove is looked at by eigenvectors, which are slower and see further.
    """
    if S.nrows() > _SMALL:
        found = by_cholesky(S, sizes)
        if found.proved:
            return found
    joined = np.zeros((S.nrows(), S.nrows()), dtype=bool)
    for place in nonzero(S):
        joined[place] = True
    return of_blocks([by_eigenvectors(part(S, block, block), sizes[block]) for block in blocks(joined)])


def of_blocks(signs: list[Sign]) -> Sign:
    """The sign of a matrix that falls apart into blocks of these signs."""
    return Sign(
        proved=all(each.proved for each in signs),
        refuted=any(each.refuted for each in signs),
        least=min(each.least for each in signs),
    )


def by_cholesky(S: arb_mat, sizes: Array) -> Sign:
    """Proved, or undecided: S is positive definite if S - LL' is, whatever L is.

    Floats find L: the Cholesky factor of the scaled midpoints less half their least eigenvalue. So S - LL' is nearly
    that half, if floats resolve it, and balls prove it diagonally dominant. Where S is sparse, so is L.
    """
    entries, scale = nonzero(S), _scale(sizes)
    middle = np.zeros((S.nrows(), S.nrows()))
    for place, entry in entries.items():
        middle[place] = float(entry)
    with np.errstate(all="ignore"):  # what overflows is left undecided
        middle *= scale * scale[:, None]
    if not np.isfinite(middle).all():
        return UNDECIDED
    least = float(np.linalg.eigvalsh(middle)[0])
    if not least > _RESOLVED:
        return UNDECIDED
    found = fronts(middle != 0.0)
    order = [k for pivots, _ in found for k in pivots]
    reordered, L = np.ix_(order, order), np.zeros_like(middle)
    try:
        L[reordered] = np.linalg.cholesky((middle - 0.5 * least * np.eye(len(order)))[reordered])
    except np.linalg.LinAlgError:
        return UNDECIDED
    L = np.rint(L * 2.0**52) * 2.0**-52  # flint multiplies numbers of one exponent faster
    for pivots, border in found:  # the columns of L at these pivots, and their part of LL'
        rows = [*pivots, *border]
        columns = exact(L[np.ix_(rows, pivots)] / scale[rows, None])
        gram = (columns * columns.transpose()).entries()
        for place, entry in zip(product(rows, rows), gram, strict=True):
            entries[place] = entries.get(place, 0) - entry
    return Sign(proved=dominant(entries, scale), refuted=False, least=least)


def by_eigenvectors(S: arb_mat, sizes: Array) -> Sign:
    """The sign of one block.

    Floats find a congruence, balls prove: X holds the eigenvectors of the scaled midpoints, and G = X'SX is nearly
    diagonal. If G is positive definite, so is S: X is then regular, for Xv = 0 gives v'Gv = 0. If some G_ii < 0, that
    column x of X has x'Sx < 0.
    """
    scale = _scale(sizes)
    with np.errstate(all="ignore"):  # what overflows is left undecided
        middle = floats(S) * scale * scale[:, None]
    if not np.isfinite(middle).all():
        return UNDECIDED
    X = exact(scale[:, None] * np.linalg.eigh(middle)[1])
    G = X.transpose() * (S * X)
    on_diagonal = diagonal(G)
    least = float(on_diagonal.min())
    if not np.isfinite(on_diagonal).all():
        return UNDECIDED
    if not least > 0.0:
        return Sign(proved=False, refuted=any(G[i, i] < 0 for i in range(G.nrows())), least=least)
    return Sign(proved=dominant(nonzero(G), on_diagonal**-0.5), refuted=False, least=least)


def _scale(sizes: Array) -> Array:
    """What makes the sizes about 1 from both sides; powers of two scale exactly."""
    with np.errstate(all="ignore"):
        return np.asarray(np.exp2(np.round(-np.log2(np.where(sizes > 0.0, sizes, 1.0)) / 2.0)))


def dominant(entries: Entries, d: Array) -> bool:
    """Whether G_ii d_i > sum over j != i of |G_ij| d_j for every row i of a symmetric G; d > 0.

    Then diag(d) G diag(d) is strictly diagonally dominant, so G is positive definite by Gershgorin's theorem.
    """
    magnitudes, weights = arb_mat(len(d), len(d)), exact(d[:, None])
    for place, entry in entries.items():
        magnitudes[place] = abs(entry)
    sums = magnitudes * weights  # |G_ii| d_i is among the sum
    return all(2 * entries.get((i, i), 0) * weights[i, 0] > sums[i, 0] for i in range(len(d)))


def nonzero(matrix: arb_mat) -> Entries:
    """The entries that are not exactly 0, by row and column."""
    places = product(range(matrix.nrows()), range(matrix.ncols()))
    return {place: entry for place, entry in zip(places, matrix.entries(), strict=True) if not entry.is_zero()}


def fronts(joined: NDArray[np.bool_]) -> list[tuple[list[int], list[int]]]:
    """An order of elimination that keeps a Cholesky factor sparse: pivots, and what they are joined with of the rest.

    Those of least degree are next, and all that is left is last, as soon as its least degree is no longer small.
    """
    joined = joined | joined.T | np.eye(len(joined), dtype=bool)
    degree, left = joined.sum(axis=1), np.ones(len(joined), dtype=bool)
    found: list[tuple[list[int], list[int]]] = []
    while left.any():
        row = joined[np.where(left, degree, len(joined) + 1).argmin()].copy()
        if _FEW * row.sum() > left.sum():
            found.append((np.flatnonzero(left).tolist(), []))
            break
        near = np.flatnonzero(row)
        alike = (joined[near] == row).all(axis=1)
        pivots, border = near[alike], near[~alike]
        found.append((pivots.tolist(), border.tolist()))
        joined[np.ix_(border, border)] = True
        joined[:, pivots] = left[pivots] = False
        degree[border] = joined[border].sum(axis=1)
    return found


def blocks(joined: NDArray[np.bool_]) -> list[list[int]]:
    """The indices of a square matrix, in sets between which nothing is joined."""
    joined = joined | joined.T
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
