"""Products with [A B] and with the losses, without most of their zeros: a node of a large network hears few others.

Rows of [A B] that share most of their columns form a group, and what is multiplied are full blocks, one for each
group, in all modes at once. A small network is one group. Losses act through their cores H_a'Y_bar H_b, where a and b
are lost together, and these need few entries of Y_bar.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from agent.contract.arrays import Array
from designer.model.error_model import ErrorModel, Indices

_SMALL = 60  # rows of [A B] up to which one group is fastest
_SPARSE = 1 / 3  # of the entries; where more are not 0, one group is fastest too
_ROWS = 16  # of a group
_WIDE = 1 / 4  # of the entries: a row that has more is in a group with its like

Where = Indices | slice


class Group(NamedTuple):
    """Rows, and the columns in which any of them has a number, in any mode."""

    rows: Where
    columns: Where


class Pattern:
    """Where [A B], H and R may have numbers, as far as `model` shows it; the same for all gains of a problem."""

    def __init__(self, model: ErrorModel) -> None:
        filled = np.asarray((np.concatenate([model.A, model.B], axis=2) != 0.0).any(axis=0))
        self.rows, self.columns = _groups(filled), _groups(filled.T)
        modes, p, size, both = model.modes, model.plant_states, model.size, model.size + model.nw
        self.lossy = np.flatnonzero(model.alpha[model.owner] > 0.0)  # measurements that may be lost
        owner = model.owner[self.lossy]
        self.a, self.b = np.nonzero(owner[:, None] == owner)  # pairs that are lost together
        self.first = np.searchsorted(self.a, np.arange(len(self.lossy)))  # of the pairs (a, b) of each a
        mode = np.arange(modes)[:, None, None, None]
        self.H_rows = _kept(model.H[:, :, self.lossy].swapaxes(1, 2))  # (modes, lossy, r)
        rows, columns = p + self.H_rows, _kept(model.R[self.lossy])
        self.R_columns = columns  # (lossy, c)
        self.in_Y = _Places((mode * size + rows[:, self.a, :, None]) * size + rows[:, self.b, None, :])
        self.in_S = _Places((mode * both + columns[self.a, :, None]) * both + columns[self.b, None, :])


class _Places:
    """Entries of a stack of matrices, some more than once."""

    def __init__(self, at: Indices) -> None:
        self.at = at
        self.once, self.which = np.unique(at, return_inverse=True)
        self.which = self.which.reshape(-1)

    def take(self, X: Array) -> Array:
        """What stands there, in the shape of `at`."""
        return np.asarray(X.reshape(-1)[self.at])

    def add(self, X: Array, terms: Array) -> None:
        """In place, to a contiguous X."""
        X.reshape(-1)[self.once] += np.bincount(self.which, terms.reshape(-1), minlength=len(self.once))


def _groups(filled: NDArray[np.bool_]) -> list[Group]:
    everything = [Group(slice(None), slice(None))]
    if len(filled) <= _SMALL or filled.mean() > _SPARSE:
        return everything
    try:
        from scipy import sparse  # takes 0.2 s to import
    except ModuleNotFoundError:
        return everything

    wide = filled.mean(axis=1) > _WIDE
    narrow = np.flatnonzero(~wide)
    shared: Any = sparse.csr_array(filled[narrow][:, filled.mean(axis=0) <= _WIDE].astype(np.float64))
    order = narrow[banded_order(shared @ shared.T)]
    parts = [np.sort(order[k : k + _ROWS]) for k in range(0, len(order), _ROWS)]
    parts += [np.flatnonzero(wide)] if wide.any() else []
    return [Group(_where(rows), _where(np.flatnonzero(filled[rows].any(axis=0)))) for rows in parts]


def banded_order(linked: Any) -> Indices:
    """An order in which what is linked, by a symmetric matrix, is not far apart: reverse Cuthill-McKee."""
    from scipy.sparse import csr_matrix  # takes 0.2 s to import
    from scipy.sparse.csgraph import reverse_cuthill_mckee

    return np.asarray(reverse_cuthill_mckee(csr_matrix(linked), symmetric_mode=True))


def _where(at: Indices) -> Where:
    """A slice where that is possible: no copies."""
    return slice(int(at[0]), int(at[-1]) + 1) if len(at) and at[-1] - at[0] == len(at) - 1 else at


def _kept(X: Array) -> Indices:
    """Where rows are not 0, (..., c), where the fullest row has c entries; other rows are filled up."""
    most = int(np.count_nonzero(X, axis=-1).max(initial=0))
    return np.argsort(X == 0.0, axis=-1, kind="stable")[..., :most]


def _block(X: Array, group: Group) -> Array:
    return np.ascontiguousarray(X[:, group.rows][:, :, group.columns])


class Products:
    """The matrices of one error model, in the blocks of a pattern."""

    def __init__(self, model: ErrorModel, pattern: Pattern) -> None:
        self.pattern, self.modes, self.size, self.both = pattern, model.modes, model.size, model.size + model.nw
        self.p = model.plant_states
        AB = np.concatenate([model.A, model.B], axis=2)
        AB_T = AB.swapaxes(1, 2)
        self._rows = [_block(AB, group) for group in pattern.rows]
        self._columns = [_block(AB_T, group) for group in pattern.columns]
        lossy, a, b = pattern.lossy, pattern.a, pattern.b
        self.roots = np.sqrt(model.alpha[model.owner[lossy]])
        H = model.H[:, :, lossy].swapaxes(1, 2) * self.roots[:, None]  # sqrt(alpha_i) H, (modes, lossy, n nx)
        self._H = np.take_along_axis(H, pattern.H_rows, axis=-1)
        R = np.take_along_axis(model.R[lossy], pattern.R_columns, axis=-1)
        self._HH = self._H[:, a, :, None] * self._H[:, b, None, :]  # (modes, pairs, r, r)
        self._RR = R[a, :, None] * R[b, None, :]  # (pairs, c, c)

    def joint(self, Y_bar: Array) -> Array:
        """[A B]'Y_bar[A B] + sum of R_a'(H_a'Y_bar H_b)R_b over the pairs, (modes, n_eta + nw, n_eta + nw)."""
        half = np.empty((self.modes, self.both, self.size))
        S = np.empty((self.modes, self.both, self.both))
        for group, AB_T in zip(self.pattern.columns, self._columns, strict=True):
            half[:, group.rows] = AB_T @ Y_bar[:, group.columns]
        for group, AB_T in zip(self.pattern.columns, self._columns, strict=True):
            S[:, group.rows] = AB_T @ half[:, :, group.columns].swapaxes(1, 2)
        if len(self.pattern.lossy):
            G = np.einsum("spij,spij->sp", self.pattern.in_Y.take(Y_bar), self._HH)
            self.pattern.in_S.add(S, G[:, :, None, None] * self._RR)
        return S

    def carry(self, joint: Array, collected: Collected | None = None, Y_bar: Array | None = None) -> Array:
        """The adjoint of `joint`: the covariance of eta one step later, (modes, n_eta, n_eta), from that of [eta; w].

        Adds to `collected` the derivative of trace(joint S(Y_bar)), if asked.
        """
        F, X = np.empty((self.modes, self.size, self.both)), np.empty((self.modes, self.size, self.size))
        for group, AB in zip(self.pattern.rows, self._rows, strict=True):
            F[:, group.rows] = AB @ joint[:, group.columns]
        for k, (group, AB) in enumerate(zip(self.pattern.rows, self._rows, strict=True)):
            part = F[:, :, group.columns]
            X[:, group.rows] = AB @ part.swapaxes(1, 2)
            if collected is not None and Y_bar is not None:
                collected.blocks[k] += Y_bar[:, group.rows] @ part
        if len(self.pattern.lossy):
            lost = np.einsum("spij,pij->sp", self.pattern.in_S.take(joint), self._RR)
            self.pattern.in_Y.add(X, lost[:, :, None, None] * self._HH)
            if collected is not None and Y_bar is not None:
                by_H = self.pattern.in_Y.take(Y_bar) @ self._H[:, self.pattern.b, :, None]
                collected.H += np.add.reduceat(by_H[..., 0] * lost[:, :, None], self.pattern.first, axis=1)
        return X


class Collected:
    """Half of the derivatives by [A B] and by H, where they may have numbers, summed over the steps."""

    def __init__(self, products: Products) -> None:
        self._products = products
        self.blocks = [np.zeros_like(block) for block in products._rows]
        self.H = np.zeros_like(products._H)

    def full(self, model: ErrorModel) -> tuple[Array, Array]:
        """By the rows of e in [A B], (modes, n nx, n_eta + nw), and by H, (modes, n nx, sum ny)."""
        products, pattern = self._products, self._products.pattern
        by_AB = np.zeros((products.modes, products.size, products.both))
        for group, block in zip(pattern.rows, self.blocks, strict=True):
            part = by_AB[:, group.rows]
            part[:, :, group.columns] = block
            by_AB[:, group.rows] = part
        by_lossy = np.zeros((products.modes, len(pattern.lossy), model.H.shape[1]))
        np.put_along_axis(by_lossy, pattern.H_rows, self.H * products.roots[:, None], axis=-1)
        by_H = np.zeros_like(model.H)
        by_H[:, :, pattern.lossy] = 2.0 * by_lossy.swapaxes(1, 2)
        return 2.0 * by_AB[:, products.p :], by_H
