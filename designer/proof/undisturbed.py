"""What eta(0) leaves of z_tilde where nothing disturbs it: at most, at every step; proved.

Y(k) = L^k(M'M) weighs eta(0) after k steps, and is followed as the recursion is, each time replaced by numbers that are
provably not below it. By (17) P > L(P), so from Y(k) < c P on none weighs it by more than c P does: there it ends.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple, Protocol

import numpy as np

from agent.contract.arrays import Array
from designer.patience import look
from designer.proof.float64 import TINY, UP, product, relative
from designer.proof.recursion import Arithmetic

_MOST_STEPS, _MOST_NUMBERS = 20_000, 8e9
_ROOM = 1e-3  # c beyond what floats find


class Starts(NamedTuple):
    """eta(0) = [T x; ...; T x] in mode s, for each x of `tried` (any, nx); T None: I."""

    s: int
    tried: Array
    T: Array | None
    by_size: bool = False  # and for every other x with |x_j| as large as in it

    @np.errstate(all="ignore")  # what is not finite is infinite
    def above(self, Y: Array) -> float:
        """Not below eta(0)'Y(s)eta(0), where Y (modes, n_eta, n_eta) has met one rounding."""
        nx = self.tried.shape[1]
        T, parts = np.eye(nx) if self.T is None else self.T, Y.shape[1] // nx
        weights, sizes = (
            product(product(T.T, Y_s.reshape(parts, nx, parts, nx).sum(axis=(0, 2))), T)
            for T, Y_s in ((T, Y[self.s]), (np.abs(T), np.abs(Y[self.s])))
        )
        x, size = self.tried, np.abs(self.tried)
        values = (product(x, np.abs(weights) if self.by_size else weights) * x).sum(axis=1)
        off = relative(parts**2 + 4 * nx + 4) * (product(size, sizes) * size).sum(axis=1)
        found = max(float((values + off * UP).max()), 0.0) * UP + TINY
        return found if math.isfinite(found) else math.inf


class Undisturbed(Arithmetic, Protocol):
    """One that knows the step without w."""

    def undisturbed(self, Y: Any) -> Any:
        """Not below L(Y); None: not proved."""


def largest(by: Undisturbed, P: Array, starts: Starts) -> float | None:
    """Above (eta(0)'Y(k)eta(0))^(1/2) at every k, for P with (17) in every mode; None: not proved.

    Where errors decay so slowly that the steps end before they are below the largest, c P counts too.
    """
    steps = min(_MOST_STEPS, int(_MOST_NUMBERS / (by.cost * len(P) * by.order**2)))
    inverse = _inverse_root(P)
    if inverse is None:
        return None
    of_P, Y, most, next_look = starts.above(P), by.start(up=True), 0.0, 0
    for step in range(steps + 1):
        look()
        Y_floats = by.floats(Y)
        most = max(most, starts.above(Y_floats))
        if step == steps or step >= next_look:
            root = _root(inverse, Y_floats)
            end = root**2 * of_P * UP
            if step == steps or end <= most:
                proved = math.isfinite(end) and all(each.proved for each in by.below(Y, P, root))
                return math.sqrt(max(most, end)) * UP if proved and math.isfinite(most) else None
            next_look = step + 1 + step // 16
        Y = by.undisturbed(Y)
        if Y is None:
            return None
    return None


def _inverse_root(P: Array) -> Array | None:
    """R with P^-1 = R'R in every mode."""
    try:
        return np.asarray(np.linalg.inv(np.linalg.cholesky((P + P.swapaxes(1, 2)) / 2.0)))
    except np.linalg.LinAlgError:
        return None


def _root(inverse: Array, Y: Array) -> float:
    """The root of a c with Y < c P, as far as floats tell."""
    sizes = inverse @ Y @ inverse.swapaxes(1, 2)
    if not np.isfinite(sizes).all():
        return math.inf
    return math.sqrt(float(np.linalg.norm(sizes, 2, axis=(1, 2)).max()) * (1.0 + _ROOM))
