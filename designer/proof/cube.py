"""S(Y) of every model of a cube from above, in floats with a bound on every rounding; docs/theory.md, section 13.

A cube: entries of A, B, C, D, M, each off by as much as it likes up to its radius d. Entry j is of row k and meets
column c of [eta; w]. With a_k = sum of variances (E_l C_l)'Y_bar u_lk and Q_kk' = sum of variances u_lk'Y_bar u_lk',
S(Y) of a model of the cube is

    S_0 + sum over j of delta_j (a_k v_c' + v_c a_k') + sum over j, j' of delta_j delta_j' Q_kk' v_c v_c''.

By Young, delta (a v' + v a') <= d (xi / alpha) a a' + d (alpha / xi) v v' for all xi, alpha > 0. The last sum is at
most r_c (sum of s) / s_c on the diagonal, r_c the sum of d d'|Q_kk'| over the entries of column c, for all s > 0: by
Cauchy, since Y >= 0.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from flint import ctx

from agent.contract.arrays import Array
from agent.contract.gains import LinkMatrices
from agent.contract.problem import Problem
from designer.proof.ball_model import BallModel, Truth
from designer.proof.balls import UNDECIDED, Sign
from designer.proof.by_floats import BITS, ByFloats
from designer.proof.deviations import Deviations, Entry
from designer.proof.float64 import TINY, UP, Bounded, U, product, raised, relative, symmetric, times, weights, within
from designer.proof.float_model import Enclosed, enclosed

_LEAST, _TINIEST = 1e-9, 2.0**-90  # of the largest, and at all: no weight of Young's or Cauchy's inequality is less


class Chosen(NamedTuple):
    """The weights of the inequalities, all > 0; any are right, and these lose little where [eta; w] is like X."""

    alpha: Array  # (..., k)
    xi: Array  # (..., m)
    s: Array  # (..., m)


def chosen(a: Array, Q: Array, radii: Array, X: Array) -> Chosen:
    """For a (..., m, k), Q (..., k, k), radii (k, m) and X (..., m, m), as far as floats tell."""
    xi = np.sqrt(np.abs(X.diagonal(axis1=-2, axis2=-1)))
    alpha = np.sqrt(np.abs(np.einsum("...ik,...ij,...jk->...k", a, X, a, optimize=True)))
    s = np.sqrt(np.einsum("kc,lc,...kl->...c", radii, radii, np.abs(Q), optimize=True)) * xi
    return Chosen(*(_positive(part) for part in (alpha, xi, s)))


def _positive(sizes: Array) -> Array:
    return np.asarray(np.maximum(sizes, _LEAST * sizes.max(axis=-1, keepdims=True, initial=0.0) + _TINIEST))


def cubed(S: Bounded, a: Array, a_off: Array, Q: Array, radii: Array, X: Array) -> Bounded:
    """Above S + sum of delta (a_k v_c' + v_c a_k') + sum of delta delta' Q v v', whatever the deltas.

    S (..., m, m). The entries of a (..., m, k) are off by a_off at most; Q (..., k, k) bounds those of Q from above.
    """
    by = chosen(a, Q, radii, X)
    tau = times(radii, by.xi) / by.alpha * UP
    r = np.einsum("kc,lc,...kl->...c", radii, radii, Q, optimize=True)
    spent = np.where(r > 0.0, by.s, 0.0).sum(axis=-1, keepdims=True)
    on = (times(radii.T, by.alpha) / by.xi + r * spent / by.s) * UP * UP + TINY
    grown, size = symmetric(product(a * tau[..., None, :], a.swapaxes(-1, -2))), np.abs(a)
    middle, i = S.middle + grown, np.arange(S.middle.shape[-1])
    middle[..., i, i] += on
    D = weights(middle.diagonal(axis1=-2, axis2=-1))
    of_size = times(size * tau[..., None, :], times(size.swapaxes(-1, -2), D)) + times(np.abs(S.middle), D) + on * D
    off = product(a_off, radii)  # of delta (a - what it is) v'
    rows = relative(len(radii) + 6) * of_size + times(off, D) + times(off.swapaxes(-1, -2), D)
    return Bounded(middle, (S.spread + rows / D) * UP + TINY)


class Cube(ByFloats):
    """`ByFloats` for the model in the middle; `joint` and `above` for all."""

    def __init__(
        self,
        problem: Problem,
        K: LinkMatrices,
        H: LinkMatrices,
        truth: Truth,
        entries: tuple[Entry, ...],
        T: Array | None = None,
    ) -> None:
        self.truth, self.T = truth, T
        if entries and T is not None:
            raise ValueError("an entry that is off is one of the matrices as they are, not of those that T makes")
        with ctx.workprec(BITS):
            balls = BallModel(problem, K, H, truth, T)
            self._begin(balls)
            self.deviations = Deviations(balls, problem, entries)
            self._left, self._right = self._terms(balls)
        modes, terms, n = self._right.middle.shape[:3]
        self._rounded = relative(modes + n + terms * n + 12)
        self.spreads = bool(self.deviations.keys)
        self.in_range = within(self._left.size, self._right.size, self.deviations.radii, self.deviations.of_M)

    def _terms(self, balls: BallModel) -> tuple[Enclosed, Enclosed]:
        """variance [E_l C_l, u_l], (modes, terms, n_eta, m + k), and u_l, (modes, terms, n_eta, k)."""
        every = [self.deviations.terms(s) for s in balls.modes]
        m, k = balls.size + balls.nw, len(self.deviations.keys)
        shape = len(every), max(map(len, every)), balls.size
        left, right = (Enclosed(*np.zeros((2, *shape, columns))) for columns in (m + k, k))
        for s, terms in enumerate(every):
            for number, term in enumerate(terms):
                for into, block, columns in (
                    (left, term.T * term.variance, term.columns),
                    (left, term.U * term.variance, [m + at for at in term.k]),
                    (right, term.U, term.k),
                ):
                    found = enclosed(block.entries(), len(term.rows), len(columns))
                    for whole, numbers in zip(into, found, strict=True):
                        whole[s, number][np.ix_(term.rows, columns)] = numbers
        return left, right

    def joint(self, Y: Array, X: Array) -> Bounded | None:
        """Above S(Y) of every model of the cube, for symmetric floats Y >= 0; X (modes, m, m) weighs what is lost."""
        S = super().joint(Y, X)
        if S is None or not self.in_range or not self.spreads:
            return S if self.in_range else None
        return self._cubed(S, Y, X)

    def weigh(self, Y: Array, X: Array) -> Array:
        S = super().weigh(Y, X)
        if not self.spreads:
            return S
        return self._cubed(Bounded(S, np.zeros(S.shape[:2])), Y, X).middle

    def _cubed(self, S: Bounded, Y: Array, X: Array) -> Bounded:
        return cubed(S, *self._moved(Y), self.deviations.radii, X)

    def _moved(self, Y: Array) -> tuple[Array, Array, Array]:
        """a, what it is off by, and a bound of |Q|."""
        m, (modes, terms, n, k) = self.model.order, self._right.middle.shape
        found = []
        for left, right, transition, of_Y in zip(
            self._left, self._right, self.model.transition, (Y, np.abs(Y)), strict=True
        ):
            Y_bar = product(transition, of_Y.reshape(modes, -1)).reshape(modes, 1, n, n)
            moved = product(Y_bar, right).reshape(modes, terms * n, k)
            found.append(product(left.reshape(modes, terms * n, m + k).swapaxes(1, 2), moved))
        middle, size = found[0], self._rounded * UP * found[1] + TINY
        return middle[:, :m], size[:, :m], (np.abs(middle[:, m:]) + size[:, m:]) * UP

    def decreasing(self, Z: Array) -> list[Sign]:
        """Not known: Z may be of any sign, and then a mean over the cube has no bound here."""
        return [UNDECIDED] * len(Z)

    def ended(self, X: Array) -> Array:
        n, modes, radii = self.model.size, self.model.modes, self.deviations.of_M
        peak = Bounded(*(np.tile(part, (modes,) + (1,) * part.ndim) for part in self.model.peak))
        if not radii.any():
            return raised(peak, up=True)
        with ctx.workprec(BITS):
            by_e, square = self.deviations.peak()
        a, off = np.zeros((2, modes, n, len(radii)))
        found = enclosed(by_e.entries(), by_e.nrows(), by_e.ncols())
        a[:, n - by_e.nrows() :], off[:, n - by_e.nrows() :] = found.middle, found.size * U * UP
        Q = np.tile(float(square.upper()) * UP * np.eye(len(radii)), (modes, 1, 1))
        return raised(cubed(peak, a, off, Q, radii, X[:, :n, :n]), up=True)
