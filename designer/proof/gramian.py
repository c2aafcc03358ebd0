"""The sum of all A^j B B' A'^j in balls, but for a rest that is bounded: how far w brings a state."""

from __future__ import annotations

from typing import NamedTuple

from flint import arb, arb_mat

_DOUBLINGS = 80
_SETTLED = 1e-40  # of the square of A^T


class Gramian(NamedTuple):
    """G_T = the sum of the first T, and what no eigenvalue of the rest exceeds."""

    total: arb_mat
    rest: arb

    @classmethod
    def of(cls, A: arb_mat, B: arb_mat) -> Gramian | None:
        """None where A^T is not seen to go to 0; else A^k does.

        G = G_T + A^T G A'^T, so with q = |A^T|^2 < 1 (Frobenius) the rest is at most |G_T| q / (1 - q).
        """
        G, power = B * B.transpose(), A
        for _ in range(_DOUBLINGS):
            q = square(power)
            if q < _SETTLED:
                return cls(G, square(G).sqrt() * q / (1 - q))
            G, power = G + power * G * power.transpose(), power * power
            if not all(entry.is_finite() for entry in power.entries()):
                break
        return None


def square(matrix: arb_mat) -> arb:
    """Of Frobenius' norm, which is not below any other of these."""
    return sum((entry**2 for entry in matrix.entries()), arb(0))
