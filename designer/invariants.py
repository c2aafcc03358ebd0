"""Sets that the recursion at g does not leave, Y <= g P with a P of (17); and what it does not come back from.

A step at g = 1 is F(Y) = L(Y) + A'Y_bar B W^-1 B'Y_bar A, the largest over all policies w = Gamma eta of L_c(Y) -
Gamma'Gamma, L_c of the loop that Gamma closes; at other g it is g F(Y / g). (17) says F(P) < P. Where errors decay
slowly there is a P = F(P) > 0 in all that does so, and its policy is worst against whatever lies there: the border
between what dies out and what grows is known at once. docs/theory.md, section 3; all is found in floats.
"""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import numpy as np

from agent.contract.arrays import Array
from designer.decay import DENSE, Decay, Map, is_positive, packing
from designer.steered import Steered

_STRICT = 1e-3  # by this part of itself P stands below the largest multiple that satisfies (17)
_STRICT_WHERE_SLOW = 1e-6
SLOW = 0.98  # radius of L from which on errors decay slowly: one P would end the recursion late
_STEPS_OF_ERRORS = 300
_ROUNDS = 8
_FLOOR = 1e-6  # of I that is in every U, so that P > 0
_ALL_SLOW, _AS_SLOW = 0.99, (1.05, 3.0)  # |eigenvalues| of L that count as slow; 1 - |.| beside 1 - radius
_STEPS = 40  # of Newton's method, from above
_EXACT = 1e-11
_RANK = 1e-6  # of a covariance, beside its largest eigenvalue
_NEVER, _NOTHING = 1e-11, 1e-9  # of the largest covariance; of I
_FREE = 100.0  # times U
_BEYOND = 10.0  # times gP is far beyond it
_RESOLVED = 1e-9  # of the least eigenvalue
_GROWTH = 1e9  # that is followed: by 1e-8 of gP a Y is known to be beyond it


class Threshold(NamedTuple):
    """P = F(P), and what its policy lets grow: from any Y a step leads to Y+ - gP >= L_c(Y - gP)."""

    P: Array  # (modes, n, n)
    seen: Array  # (n, r): times this, Y is seen in natural units, along what w can reach
    right: Array  # (order, m): in natural units, as `packing` packs them, all Y that L_c makes grow
    left: Array  # (m, order): what there is of them in a Y
    powers: list[Array]  # (m, m): L_c of them, of 1, 2, 4, ... steps

    def passed(self, Y: Array, g: float) -> bool:
        """Whether Y grows far beyond gP in some direction, as far as floats tell; then no bound is below sqrt g."""
        if not np.isfinite(Y).all():
            return False
        pack, unpack = packing(len(Y), self.seen.shape[1])
        beyond, border = (self.seen.T @ X @ self.seen for X in (Y - g * self.P, g * self.P))
        there, border = self.left @ pack(beyond), np.abs(border).max()
        grown = (unpack(self.right @ (power @ there)) for power in self.powers)
        ends = [np.linalg.eigvalsh(X) for X in grown]
        return any(X.max() > max(_BEYOND * border, _RESOLVED * -X.min()) for X in ends)


class Outweighed(NamedTuple):
    """Where Y weighs what w alone steers by more than it costs, whatever errors there are; `strict` satisfies (17)."""

    steered: Steered
    strict: Array
    P: Array  # in whose invariant set the recursion ends early; (17) is nearly an equality for it

    def passed(self, Y: Array, g: float) -> bool:
        """Whether that is so, as far as floats tell; then no bound is below sqrt g."""
        return bool(np.isfinite(Y).all()) and self.steered.direction(Y, self.strict, g) is not None


class Invariants(NamedTuple):
    """Every P satisfies (17) strictly, as far as floats tell; none: the errors do not die out, or it is not known."""

    P: list[Array]
    thresholds: list[Threshold]  # empty where errors decay fast, or none was found
    of_x: Outweighed | None = None  # where x decays slowly


def invariants(S: Map, found: Decay, units: Array, peak: Array, steered: Steered | None = None) -> Invariants:
    """S(Y) is (modes, n + nw, n + nw), L its corner, peak M'M, units those of natural size.

    The first P is of Z. Where errors decay slowly there are more: of what is `steered`, which is all that is needed
    if the rest decays fast; and of other U: M'M, which suits errors that all move alike; and A'P_bar B W^-1 B'P_bar A,
    what the worst w adds at each threshold, that of most errors last; or where none is found, taken again and again,
    until P is as large as can be in the direction that lasts.
    """
    if found.total is None or found.rest is None or not found.dies_out:
        return Invariants([], [])
    modes, n = found.total.shape[:2]
    first = scaled(S, found.total, found.rest)
    if found.radius < SLOW:
        return Invariants([first], [])
    of_x = None
    if steered is not None and steered.known:
        of_x = Outweighed(steered, first, steered.P(first))
    if modes * n * (n + 1) // 2 > DENSE or (of_x is not None and not _lasts(S, modes, n, of_x.steered.size)):
        return Invariants([first], [], of_x)
    written = _Written(S, modes, units)
    thresholds = written.reached().thresholds(found.radius)
    largest = [written.grown(each.P, _FLOOR) for each in thresholds] or [written.by_rounds(first)]
    offered = [first, written.of(peak, _FLOOR), *largest]
    return Invariants([P for P in offered if P is not None], thresholds, of_x)


def _lasts(S: Map, modes: int, n: int, p: int) -> bool:
    """Whether errors last as well as the first p states, which none of them moves."""
    Y = np.zeros((modes, n, n))
    Y[:, p:, p:] = np.eye(n - p)
    for _ in range(_STEPS_OF_ERRORS):
        Y[:, p:, p:] = S(Y)[:, p:n, p:n]
    return not np.abs(Y).max() < SLOW**_STEPS_OF_ERRORS


def scaled(S: Map, Z: Array, rest: Array, strict: float = _STRICT) -> Array:
    """c Z with the largest c that (17) allows, less a part of it; rest = Z - L(Z) > 0.

    By Schur's complement I > c (B'Z_bar B + B'Z_bar A rest^-1 A'Z_bar B).
    """
    grown, n = S(Z), Z.shape[1]
    AB, BB = grown[:, :n, n:], grown[:, n:, n:]
    worst = float(np.linalg.eigvalsh(BB + AB.swapaxes(1, 2) @ np.linalg.solve(rest, AB)).max())
    return np.asarray(Z / (worst * (1.0 + strict)) if worst > 0.0 else Z)


class _Written:
    """S written out in natural units, so that L and every L_c are matrices; along some directions, or along all."""

    def __init__(self, S: Map, modes: int, units: Array, along: Array | None = None) -> None:
        self.along = np.eye(len(units)) if along is None else along  # (all, n), orthonormal
        self.S, self.modes, self.n, self.units = S, modes, self.along.shape[1], units
        self.pack, self.unpack = packing(modes, self.n)
        self.both, self.order = np.outer(units, units), modes * self.n * (self.n + 1) // 2
        self.S_of_units = np.array([self.natural(self.unpack(unit)) for unit in np.eye(self.order)])
        self.L = self.pack(self.S_of_units[..., : self.n, : self.n]).T

    def natural(self, Y: Array) -> Array:
        """S where Y and eta are in natural units."""
        grown = self.S(self.whole(Y))
        nw = grown.shape[1] - len(self.units)
        ends = np.zeros((grown.shape[1], self.n + nw))
        ends[: len(self.units), : self.n], ends[len(self.units) :, self.n :] = self.seen, np.eye(nw)
        return np.asarray(ends.T @ grown @ ends)

    @property
    def seen(self) -> Array:
        return self.along / self.units[:, None]

    def whole(self, Y: Array) -> Array:
        """In the units and along the states of S."""
        return np.asarray(self.along @ Y @ self.along.T * self.both)

    def reached(self) -> _Written:
        """The same along what w can reach from 0, where that is less: what is never reached may hardly decay."""
        if not self.never.any():
            return self
        sizes, directions = np.linalg.eigh(self.never)
        return _Written(self.S, self.modes, self.units, directions[:, sizes < 0.5])

    @cached_property
    def never(self) -> Array:
        """The projector onto the other directions, (n, n); 0 where no such Y stays 0 along those that are reached."""
        sizes, directions = np.linalg.eigh(self.unpack(self.inverse.T @ self._white).sum(axis=0))
        along = directions[:, sizes > _NEVER * sizes.max()]
        never, ends = np.eye(self.n) - along @ along.T, np.eye(self.S_of_units.shape[-1])
        ends[: self.n, : self.n] = along @ along.T
        led = ends @ self.natural(np.broadcast_to(never, (self.modes, self.n, self.n))) @ ends
        hidden = np.abs(led).max() < _NOTHING and along.shape[1] < self.n
        return np.asarray(never if hidden else 0.0 * never)

    @property
    def _white(self) -> Array:
        """What white w of one step makes of every unit matrix, (order,)."""
        return np.asarray(np.trace(self.S_of_units[..., self.n :, self.n :], axis1=2, axis2=3).sum(axis=1))

    @cached_property
    def inverse(self) -> Array:
        """(I - L)^-1."""
        return np.asarray(np.linalg.inv(np.eye(self.order) - self.L), dtype=np.float64)

    # P that satisfies (17)
    def of(self, U: Array, share: float) -> Array | None:
        """P of the Z with Z - L(Z) = U and so much of I beside it; and along what w never reaches, which is free."""
        n, most = self.n, float((U.diagonal(axis1=1, axis2=2) / self.units**2).max())
        beside = share * most * np.eye(n) + _FREE * most * self.never
        Z = self.unpack(self.inverse @ self.pack(U / self.both + beside)) * self.both
        rest = Z - self.S(Z)[:, :n, :n]
        return scaled(self.S, Z, rest, _STRICT_WHERE_SLOW) if is_positive(Z) and is_positive(rest) else None

    def grown(self, P: Array, share: float) -> Array | None:
        """`of` what the worst w adds to P in a step, A'P_bar B W^-1 B'P_bar A; None where W is singular to floats."""
        joint, n = self.S(P), self.n
        AB, W = joint[:, :n, n:], np.eye(joint.shape[1] - n) - joint[:, n:, n:]
        try:
            return self.of(np.asarray(AB @ np.linalg.solve(W, AB.swapaxes(1, 2))), share)
        except np.linalg.LinAlgError:
            return None

    def by_rounds(self, P: Array) -> Array:
        """The largest P along one direction, from any."""
        for k in range(2, 2 + _ROUNDS):
            following = self.grown(P, max(10.0**-k, _FLOOR))
            if following is None:
                break
            P = following
        return P

    # P = F(P)
    def thresholds(self, radius: float) -> list[Threshold]:
        """Of the slowest errors alone, of those nearly as slow, of all slow ones, as far as Newton's method finds them.

        Y that is beyond one of them grows, and Y below one dies out. Of few it tells the former early, of many the
        latter, for what is left out has to die out first.
        """
        values, vectors = np.linalg.eig(self.L)
        values_T, vectors_T = np.linalg.eig(self.L.T)
        found, known = [], 0
        for least in sorted({_ALL_SLOW, *(1.0 - share * (1.0 - radius) for share in _AS_SLOW)}, reverse=True):
            slow = np.abs(values) >= least
            if slow.sum() > known:
                known = slow.sum()
                P = self._above(_real(vectors[:, slow]), _real(vectors_T[:, np.abs(values_T) >= least]))
                found.append(None if P is None else self._grown(P, radius))
        return [each for each in found if each is not None]

    def _above(self, right: Array, left: Array) -> Array | None:
        """P = F(P), from one that is twice as large as the inverse of what white w makes of what decays slowly.

        Where losses do not touch that, P is this inverse, at the limit of radius 1.
        """
        eye, both_ways = np.eye(self.order), _inverse(left.T @ right)
        if both_ways is None:
            return None
        slow = self.unpack(left @ (both_ways.T @ (right.T @ (self.inverse.T @ self._white))))
        inverses = np.asarray(np.linalg.pinv(slow, rcond=_RANK, hermitian=True), dtype=np.float64)
        P = self.unpack(right @ (both_ways @ (left.T @ self.pack(inverses)))) * 2.0 / self.modes
        for _ in range(_STEPS):
            try:
                Gamma = self._worst(P)
                held = self._held(Gamma)
                following = self.unpack(np.asarray(np.linalg.solve(held - eye, self.pack(_square(Gamma))), dtype=float))
            except np.linalg.LinAlgError:
                return None
            change, P = float(np.abs(following - P).max()), following
            if not change > _EXACT * np.abs(P).max():
                return P if np.isfinite(P).all() else None
        return None

    def _worst(self, P: Array) -> Array:
        """W^-1 B'P_bar A, (modes, nw, n)."""
        S, n = self.natural(P), self.n
        return np.asarray(np.linalg.solve(np.eye(S.shape[1] - n) - S[:, n:, n:], S[:, n:, :n]))

    def _held(self, Gamma: Array) -> Array:
        """L_c."""
        n, S = self.n, self.S_of_units
        half = S[..., :n, n:] @ Gamma
        closed = S[..., :n, :n] + half + half.swapaxes(2, 3) + Gamma.swapaxes(1, 2) @ S[..., n:, n:] @ Gamma
        return np.asarray(self.pack(closed).T)

    def _grown(self, P: Array, radius: float) -> Threshold | None:
        """What grows under the policy of P; None where P is no border, or what neither grows nor decays is there."""
        n, S = self.n, self.natural(P)
        W = np.eye(S.shape[1] - n) - S[:, n:, n:]
        if np.linalg.eigvalsh(W).min() <= 0.0 or np.linalg.eigvalsh(P).min() < -_RANK * np.abs(P).max():
            return None
        L_c = self._held(self._worst(P))
        values, vectors = np.linalg.eig(L_c)
        values_T, vectors_T = np.linalg.eig(L_c.T)
        sizes, room = np.abs(values), (1.0 - radius) / 10.0
        if not (sizes > 1.0 + room).any() or ((sizes > 1.0 - room) & (sizes < 1.0 + room)).any():
            return None
        right, left = _real(vectors[:, sizes > 1.0]), _real(vectors_T[:, np.abs(values_T) > 1.0])
        both_ways = _inverse(left.T @ right)
        if both_ways is None:
            return None
        left = both_ways @ left.T
        powers, steps = [left @ L_c @ right], np.log(_GROWTH) / np.log(sizes.max())
        for _ in range(int(np.ceil(np.log2(max(steps, 1.0))))):
            powers.append(powers[-1] @ powers[-1])
        return Threshold(self.whole(P), self.seen, right, left, powers)


def _square(Gamma: Array) -> Array:
    return Gamma.swapaxes(1, 2) @ Gamma


def _real(vectors: Array) -> Array:
    """An orthonormal basis of what pairs of complex vectors span."""
    left, sizes, _ = np.linalg.svd(np.hstack([vectors.real, vectors.imag]), full_matrices=False)
    return np.asarray(left[:, sizes > _RANK])


def _inverse(X: Array) -> Array | None:
    try:
        return np.asarray(np.linalg.inv(X), dtype=np.float64)
    except np.linalg.LinAlgError:  # some are defective, so that floats find too few vectors, and not as many of both
        return None
