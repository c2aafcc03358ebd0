"""P(s) with (17) in all of a box: what ends the recursion; found in floats, and not proved here."""

from __future__ import annotations

import numpy as np

from agent.contract.arrays import Array
from designer.decay import decay, is_positive
from designer.gain.exact import Operator
from designer.invariants import scaled
from designer.proof.by_vertices import ByVertices, upper_bound

_BEYOND, _MOST_ROUNDS, _LOOKS = 1e8, 300, 5  # of the search for P
_MORE = (0.0, 0.1, 0.3, 0.6)  # growth beyond the mean of the corners, of which P is made
_OF_W = 1e-3  # of eta's part in the weights of P, in natural units: (17) holds for some multiple whatever it costs w


@np.errstate(all="ignore")  # what overflows is no P
def invariant(by: ByVertices, middle: Operator) -> tuple[Array, Array] | None:
    """P with (17) at every corner, as far as floats tell, and the weights that it takes; None: not found.

    That of a model in the middle of the box, or of more growth than it has; else what grows as the box may, in the
    long run of which the weights are the covariance.
    """
    n, modes = by.order, len(middle.MM)
    for more in () if any(corner.spreads for corner in by.corners) else _MORE:
        found = decay(lambda Y, more=more: (1.0 + more) * middle.corner(Y), modes, middle.units)  # type: ignore[misc]
        P = None if found.total is None or not found.dies_out else _scaled(by, found.total, by.mean)
        if P is not None:
            return P, by.mean
    U, V = (np.tile(np.diag(middle.units**power), (modes, 1, 1)) for power in (2.0, -2.0))
    Z, X = U, _settled(by.mean[:, :n, :n], middle)
    for rounds in range(1, _MOST_ROUNDS + 1):
        above = upper_bound(by.of(Z, X), X)[:, :n, :n]
        if rounds % _LOOKS == 0 and (P := _scaled(by, Z, X)) is not None:
            return P, X
        Z, X = U + above, _settled(V + by.carry(Z, X), middle)
        if not (Z.diagonal(axis1=1, axis2=2) < _BEYOND * middle.units**2).all():
            break
    return None


def _settled(X: Array, middle: Operator) -> Array:
    """The weights of [eta; w] from that of eta."""
    modes, n = X.shape[:2]
    size = float((X.diagonal(axis1=1, axis2=2) * middle.units**2).mean())
    joint = np.zeros((modes, n + middle.nw, n + middle.nw))
    joint[:, :n, :n], joint[:, n:, n:] = X / size, _OF_W * np.eye(middle.nw)
    return joint


def _scaled(by: ByVertices, Z: Array, X: Array) -> Array | None:
    """The largest multiple of Z that satisfies (17) at every corner; None: none does."""
    n, every = by.order, by.of(Z, X)
    rests = [Z - S[:, :n, :n] for S in every]
    if not all(is_positive(rest) for rest in rests):
        return None
    multiples = [scaled(lambda _, S=S: S, Z, rest) for S, rest in zip(every, rests, strict=True)]  # type: ignore[misc]
    return min(multiples, key=lambda P: float(np.trace(P, axis1=1, axis2=2).sum()))
