"""What w steers alone: x, which no error, no loss and no mode moves; docs/theory.md, section 3.

To bring x to xi = G u takes u'G u = xi'G^-1 xi of sum |w|^2, and no less, G the sum of all A^j B B' A'^j, the
reachability Gramian. So with P_x = diag{G^-1, 0} all of (17) is true, with nothing to spare; and where the recursion at
g weighs x by more than g P_x, whatever the errors then are, w had better bring it there, so that no bound is below sqrt
g. Where only x decays slowly either is seen after the few steps in which errors die out. All is found in floats.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np

from agent.contract.arrays import Array

_DOUBLINGS = 60
_SETTLED = 1e-12  # of A^T
_HUGE = 1e100
SHARE = 1e-7  # of the P that is strict in that of `Steered.P`, and of the same in what errors weigh
_RANK = 1e-14
_STRICT = 1e-9  # of its diagonal, beside G


class Steered:
    """x+ = A x + B w, A (p, p), B (p, nw); the first p of n states."""

    def __init__(self, A: Array, B: Array) -> None:
        self._A = A
        self._G = summed(A, B @ B.T)

    @property
    def known(self) -> bool:
        """Whether A^k is seen to go to 0."""
        return self._G is not None

    @property
    def size(self) -> int:
        """p."""
        return len(self._A)

    def P(self, strict: Array) -> Array:
        """Nearly diag{G^-1, 0}, (modes, n, n), with as much of one that satisfies (17) strictly as makes it so, too."""
        p = self.size
        P = SHARE * strict
        P[:, :p, :p] += (1.0 - SHARE) * self._inverse
        return P

    def direction(self, Y: Array, strict: Array, g: float) -> Array | None:
        """u, (p,), for which Y weighs x = G u by more than g u'G u in every mode, whatever errors there are; or None.

        Errors that would make Y less cost something: E eta'P eta <= sum |w|^2 for `strict` = P of (17).
        """
        p, more = self.size, Y + SHARE * g * strict
        try:
            by_e = np.linalg.solve(more[:, p:, p:], more[:, p:, :p]) if Y.shape[1] > p else np.zeros((len(Y), 0, p))
            by_x = more[:, :p, :p] - more[:, :p, p:] @ by_e
            root, back = self._root
            weighed = root.T @ by_x @ root
            v = np.linalg.eigh(weighed.mean(axis=0))[1][:, -1]
        except np.linalg.LinAlgError:
            return None
        return back @ v if (np.einsum("i,sij,j->s", v, weighed, v) > g * (1.0 + SHARE)).all() else None

    @cached_property
    def _root(self) -> tuple[Array, Array]:
        """F with G = F F', (p, r), and X with G X = F."""
        assert self._G is not None
        scale = np.sqrt(np.where(self._G.diagonal() > 0.0, self._G.diagonal(), 1.0))
        sizes, vectors = np.linalg.eigh(self._G / np.outer(scale, scale))
        kept = sizes > _RANK * max(float(sizes.max()), 0.0)
        F = vectors[:, kept] * np.sqrt(sizes[kept])
        return scale[:, None] * F, (vectors[:, kept] / np.sqrt(sizes[kept])) / scale[:, None]

    @cached_property
    def _inverse(self) -> Array:
        """Of a little more than G, so that it is there."""
        assert self._G is not None
        G = self._G
        spread = np.where(G.diagonal() > 0.0, G.diagonal(), max(float(G.diagonal().max()), 1e-300))
        more = summed(self._A, np.diag(spread))
        assert more is not None
        slowness = float((spread / more.diagonal()).min())
        G = G + _STRICT * slowness * more
        scale = np.sqrt(G.diagonal())
        sizes, vectors = np.linalg.eigh(G / np.outer(scale, scale))
        inverse = (vectors / sizes) @ vectors.T / np.outer(scale, scale)
        return np.asarray((inverse + inverse.T) / 2.0)


def summed(A: Array, Q: Array) -> Array | None:
    """The sum of all A^j Q A'^j; None where A^j is not seen to go to 0."""
    total, power = Q, A
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(_DOUBLINGS):
            if np.abs(power).max(initial=0.0) < _SETTLED:
                return np.asarray((total + total.T) / 2.0)
            if not np.abs(power).max() < _HUGE:
                return None
            total, power = total + power @ total @ power.T, power @ power
    return None
