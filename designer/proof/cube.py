"""S(Y) of every model of a cube from above, in floats with a bound on every rounding; docs/theory.md, section 13.

A cube: entries of A, B, C, D, M, each off by as much as it likes up to its radius d. Entry j is of row k and meets
column c of [eta; w]; what the entries of a row do together is p_k = sum of delta_kc [eta; w]_c. With a_k = sum of
variances (E_l C_l)'Y_bar u_lk and Q_kk' = sum of variances u_lk'Y_bar u_lk', S(Y) of a model of the cube is

    S_0 + sum over k of (a_k p_k' + p_k a_k') + sum over k, k' of Q_kk' p_k p_k',    p_k as a row over [eta; w].

By Cauchy p_k^2 <= e_k sum over c of (d_kc / xi_c) [eta; w]_c^2, e_k = sum of d_kc xi_c, for all xi > 0. So for Lambda
with diag(Lambda) - Q > 0 all of that is at most

    S_0 + sum over k of Lambda_k e_k diag(d_kc / xi_c) + a (diag(Lambda) - Q)^-1 a',

which is what the largest over any p costs beyond Lambda_k times that inequality.
"""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import numpy as np
from flint import ctx

from agent.contract.arrays import Array
from agent.contract.gains import LinkMatrices
from agent.contract.problem import Problem
from designer.decay import is_positive
from designer.proof.ball_model import BallModel, Truth
from designer.proof.balls import UNDECIDED, Sign
from designer.proof.by_floats import BITS, ByFloats
from designer.proof.deviations import Deviations, Entry, Term
from designer.proof.float64 import (
    TINY,
    UP,
    Bounded,
    U,
    bounded_below,
    product,
    quotient,
    raised,
    relative,
    symmetric,
    times,
    weights,
    within,
)
from designer.proof.float_model import Enclosed, enclosed

_LEAST, _TINIEST = 1e-9, 2.0**-90  # of the largest, and at all: no weight of the inequalities is less
_INSIDE = 1e-3  # of Lambda, by which diag(Lambda) - Q stays away from singular
_ROUNDS = 3  # of the search for Lambda: later ones gain nothing to speak of


class Chosen(NamedTuple):
    """The weights of the inequalities, all > 0; any are right, and these lose little where [eta; w] is like X."""

    xi: Array  # (..., m)
    Lambda: Array  # (..., k), diag(Lambda) - Q > 0

    def rest(self, Q: Array) -> Array:
        """diag(Lambda) - Q."""
        return np.asarray(self.Lambda[..., None] * np.eye(Q.shape[-1]) - Q)


def chosen(a: Array, Q: Array, radii: Array, X: Array) -> Chosen:
    """For a (..., m, k), Q (..., k, k) >= 0, radii (k, m) and X (..., m, m), as far as floats tell.

    What is added has in the trace with X sum Lambda_k e_k^2 + tr((diag(Lambda) - Q)^-1 a'Xa), e_k = sum of d_kc xi_c:
    least where e_k^2 = (N a'Xa N)_kk, N the inverse. What is right for a diagonal N is taken again and again.
    """
    xi = _positive(np.sqrt(np.abs(X.diagonal(axis1=-2, axis2=-1))))
    e = _positive(times(radii, xi))
    both = e[..., :, None] * e[..., None, :]
    q, G = Q * both, a.swapaxes(-1, -2) @ X @ a * both
    theta = _positive(np.sqrt(np.abs(G.diagonal(axis1=-2, axis2=-1))) + (1.0 + _INSIDE) * np.abs(q).sum(axis=-1))
    for _ in range(_ROUNDS):
        N = np.linalg.inv(theta[..., None] * np.eye(q.shape[-1]) - q)
        sizes = np.abs((N @ G @ N).diagonal(axis1=-2, axis2=-1))
        tried = theta + (np.sqrt(sizes) - 1.0) / N.diagonal(axis1=-2, axis2=-1)
        if not is_positive((1.0 - _INSIDE) * tried[..., None] * np.eye(q.shape[-1]) - q):
            break
        theta = tried
    return Chosen(xi, theta / e**2)


def _positive(sizes: Array) -> Array:
    return np.asarray(np.maximum(sizes, _LEAST * sizes.max(axis=-1, keepdims=True, initial=0.0) + _TINIEST))


def on_diagonal(by: Chosen, radii: Array) -> Array:
    """Above sum over k of Lambda_k e_k d_kc / xi_c, (..., m)."""
    e = times(radii, by.xi) * UP
    return np.asarray(times(radii.T, by.Lambda * e) / by.xi * UP * UP + TINY)


def cubed(S: Bounded, a: Array, a_off: Array, Q: Array, radii: Array, X: Array) -> Bounded | None:
    """Above S + sum of (a_k p_k' + p_k a_k') + sum of Q p p', whatever the deltas; None: not proved.

    S (..., m, m). The entries of a (..., m, k) are off by a_off at most; Q (..., k, k), symmetric floats, is not below
    what it stands for.
    """
    m, k = a.shape[-2:]
    by = chosen(a, Q, radii, X)
    E, i = weights(by.Lambda), np.arange(m)  # powers of two: units in which p is about 1
    W = by.rest(Q) * E[..., :, None] * E[..., None, :]
    W[..., np.arange(k), np.arange(k)] = np.nextafter(W.diagonal(axis1=-2, axis2=-1), -np.inf)
    J = np.zeros((*S.middle.shape[:-2], m + k, m + k))
    J[..., :m, :m], J[..., :m, m:] = S.middle, a * E[..., None, :]
    J[..., m:, :m] = J[..., :m, m:].swapaxes(-1, -2)
    J[..., i, i] = np.nextafter(J[..., i, i] + on_diagonal(by, radii), np.inf)
    known, ones = np.zeros(k), np.ones(k)
    signs, least = zip(*(bounded_below(Bounded(W_s, known), ones) for W_s in W), strict=True)
    grown = quotient(J, W, np.array(least)) if all(each.proved for each in signs) else None
    if grown is None:
        return None
    D = weights(grown.middle.diagonal(axis1=-2, axis2=-1))
    off = product(a_off, radii)  # of delta (a - what it is) v'
    rows = times(off, D) + times(off.swapaxes(-1, -2), D)
    return Bounded(grown.middle, (S.spread + grown.spread + rows / D) * UP + TINY)


def weighed(S: Array, a: Array, Q: Array, radii: Array, X: Array) -> Array:
    """About the same, not proved."""
    by, i = chosen(a, Q, radii, X), np.arange(S.shape[-1])
    found = S + a @ np.linalg.solve(by.rest(Q), a.swapaxes(-1, -2))
    found[..., i, i] += on_diagonal(by, radii)
    return np.asarray(found)


def joined(X: Array, D: Array, V: Array | float = 0.0) -> Array:
    """The mean of [v; p][v; p]' for p = D v with V beside it, where v has the mean X (modes, n, n) of v v'."""
    DX = D @ X
    return np.block([[X, DX.swapaxes(1, 2)], [DX, DX @ D.swapaxes(-1, -2) + V]])


class _Lifted(NamedTuple):
    """E_l C_l and u_l over rows of eta+ and columns of [eta; w; p], in floats."""

    variance: float
    rows: list[int]
    columns: list[int]
    block: Array


def _lifted(term: Term, m: int) -> _Lifted:
    T, U = (np.array([float(entry) for entry in part.entries()]) for part in (term.T, term.U))
    block = np.hstack([T.reshape(len(term.rows), -1), U.reshape(len(term.rows), -1)])
    return _Lifted(float(term.variance), term.rows, [*term.columns, *(m + k for k in term.k)], block)


class Parts(NamedTuple):
    """S(Y) of a model whose entries are off by D is S + a D + D'a' + D'Q D; about, and of every mode."""

    S: Array  # (modes, m, m)
    a: Array  # (modes, m, k)
    Q: Array  # (modes, k, k)

    def at(self, D: Array) -> Array:
        """For D (k, m)."""
        aD, D_T = self.a @ D, D.swapaxes(-1, -2)
        return np.asarray(self.S + aD + aD.swapaxes(-1, -2) + D_T @ self.Q @ D)

    def slope(self, D: Array, X: Array) -> Array:
        """Half the derivative of tr(X S(Y)) by D."""
        return np.asarray((self.a.swapaxes(-1, -2) + self.Q @ D) @ X)


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
        self.truth, self.T, self.entries = truth, T, entries
        if T is not None and any(entry.matrix != "D" for entry in entries):
            raise ValueError("an entry that is off is one of the matrices as they are, not of those that T makes")
        with ctx.workprec(BITS):
            balls = BallModel(problem, K, H, truth, T)
            self._begin(balls)
            self.deviations = Deviations(balls, problem, entries)
            self._left, self._right, self._lifted = self._terms(balls)
        modes, terms, n = self._right.middle.shape[:3]
        self._rounded = relative(modes + n + terms * n + 12)
        self.spreads = bool(self.deviations.keys)
        self.in_range = within(self._left.size, self._right.size, self.deviations.radii, self.deviations.of_M)

    def _terms(self, balls: BallModel) -> tuple[Enclosed, Enclosed, list[list[_Lifted]]]:
        """variance L_l with L_l = [E_l C_l, u_l], (modes, terms, n_eta, m + k), u_l, (.., k), and L_l in floats."""
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
        return left, right, [[_lifted(term, m) for term in terms] for terms in every]

    def joint(self, Y: Array, X: Array) -> Bounded | None:
        """Above S(Y) of every model of the cube, for symmetric floats Y >= 0; X (modes, m, m) weighs what is lost."""
        S = super().joint(Y, X)
        if S is None or not self.in_range or not self.spreads:
            return S if self.in_range else None
        return cubed(S, *self._moved(Y), self.deviations.radii, X)

    def weigh(self, Y: Array, X: Array) -> Array:
        S, a, Q = self.parts(Y)
        return weighed(S, a, Q, self.deviations.radii, X) if self.spreads else S

    def parts(self, Y: Array) -> Parts:
        """Not proved."""
        moved, m = self._times(self._left.middle, self._right.middle, self.model.transition.middle, Y), self.model.order
        return Parts(super().weigh(Y, Y), moved[:, :m], symmetric(moved[:, m:]))

    def carry(self, Y: Array, X: Array) -> Array:
        """What `weigh` makes of X: the mean of eta eta' one step later, by mode, where [eta; w] is like X.

        The deviations that cost most lead to p = (diag(Lambda) - Q)^-1 a'[eta; w]; not proved.
        """
        _, a, Q = self.parts(Y)
        by = chosen(a, Q, self.deviations.radii, X)
        return self.carried(X, np.asarray(np.linalg.solve(by.rest(Q), a.swapaxes(-1, -2)), dtype=np.float64))

    def carried(self, X: Array, D: Array) -> Array:
        """The same where p = D [eta; w], D (k, m), or one for each mode."""
        joint, found = joined(X, D), np.zeros((len(X), self.model.size, self.model.size))
        for of_mode, joint_s, terms in zip(found, joint, self._lifted, strict=True):
            for term in terms:
                moved = term.block @ joint_s[np.ix_(term.columns, term.columns)] @ term.block.T
                of_mode[np.ix_(term.rows, term.rows)] += term.variance * moved
        return symmetric((self.model.transition.middle.T @ found.reshape(len(X), -1)).reshape(found.shape))

    def _times(self, left: Array, right: Array, transition: Array, Y: Array) -> Array:
        """The sum of left_l'Y_bar right_l, (modes, m + k, k)."""
        modes, terms, n, k = right.shape
        Y_bar = product(transition, Y.reshape(modes, -1)).reshape(modes, 1, n, n)
        moved = product(Y_bar, right).reshape(modes, terms * n, k)
        return product(left.reshape(modes, terms * n, -1).swapaxes(1, 2), moved)

    def _moved(self, Y: Array) -> tuple[Array, Array, Array]:
        """a, what it is off by, and Q in floats that are not below it."""
        m, of_Y = self.model.order, (Y, np.abs(Y))
        every = zip(self._left, self._right, self.model.transition, of_Y, strict=True)
        middle, sizes = (self._times(*each) for each in every)
        size = self._rounded * UP * sizes + TINY
        Q, off = symmetric(middle[:, m:]), size[:, m:] + relative(1) * np.abs(middle[:, m:])
        D = weights(Q.diagonal(axis1=1, axis2=2))
        rows = times(off + off.swapaxes(1, 2), D)
        return middle[:, :m], size[:, :m], raised(Bounded(Q, rows / D * UP + TINY), up=True)

    def decreasing(self, Z: Array) -> list[Sign]:
        """Not known: Z may be of any sign, and then a mean over the cube has no bound here."""
        return [UNDECIDED] * len(Z)

    def ended(self, X: Array) -> Array:
        n, modes, radii = self.model.size, self.model.modes, self.deviations.of_M
        peak = Bounded(*(np.tile(part, (modes,) + (1,) * part.ndim) for part in self.model.peak))
        if not radii.any():
            return raised(peak, up=True)
        found, square = self._of_peak
        a, off = np.zeros((2, modes, n, len(radii)))
        a[:, -len(found.middle) :], off[:, -len(found.middle) :] = found.middle, found.size * U * UP
        Q = np.tile(square * np.eye(len(radii)), (modes, 1, 1))
        above = cubed(peak, a, off, Q, radii, X[:, :n, :n])
        return np.full_like(peak.middle, np.nan) if above is None else raised(above, up=True)

    @cached_property
    def _of_peak(self) -> tuple[Enclosed, float]:
        """a of M'M over the errors of all nodes, (n nx, nz), and a float above Q_kk."""
        with ctx.workprec(BITS):
            by_e, square = self.deviations.peak()
        return enclosed(by_e.entries(), by_e.nrows(), by_e.ncols()), float(square.upper()) * UP

    def peak_parts(self) -> Parts:
        """M'M of a model whose M is off by D (nz, n_eta) is S + a D + D'a' + D'Q D; about."""
        found, square = self._of_peak
        n, nz = self.model.size, found.middle.shape[1]
        return Parts(
            self.model.peak.middle,
            np.vstack([np.zeros((n - len(found.middle), nz)), found.middle]),
            square * np.eye(nz),
        )
