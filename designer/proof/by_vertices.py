"""The proof for a box of models, in float64 with a bound on every rounding; docs/theory.md, section 13.

S(Y) is affine in every beta_j, every rho_ij and every row of Pi, each alone, while the filters keep what they were
told. So for every model of the box S(Y)(s) is a mean of those at its corners, and Z above all of these is above it. A
step takes such a Z, which weights help to find and floats with bounds prove.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from agent.contract.arrays import Array
from agent.contract.errors import counted
from designer.proof.balls import UNDECIDED, Sign, of_blocks
from designer.proof.by_floats import square
from designer.proof.cube import Cube
from designer.proof.findings import Verdict, failure, found, margins, proved
from designer.proof.float64 import Bounded, bounded_below, difference, quotient, raised, sign, symmetric, weights
from designer.proof.recursion import Arithmetic, recursion

Indices = NDArray[np.int64]
Flags = NDArray[np.bool_]

_ABOVE = 1e-10  # of its own size Z stands above what floats find: more than they err by
_OUTWEIGHS = 4.0  # times what S(Y) may be off by in floats, Z stands above that too
_ROUNDED = 1e-6  # of the largest entry of Z: what is less may be rounding, and is not what Z lacks by itself
_LEAST = 1e-13  # of the largest eigenvalue of a weight


class Reached(NamedTuple):
    """Y after so many steps from the last."""

    steps: int
    Y: Any


class ByVertices:
    """`designer.proof.recursion.Arithmetic`, of all models with these corners. weights (T, modes, order, order) > 0.

    Each corner may itself be above many models (`designer.proof.cube`). `mean` (modes, order, order): the weight where
    something is said of P; without it the mean of all weights.
    """

    def __init__(self, corners: Sequence[Cube], weights: Array, mean: Array | None = None) -> None:
        self.corners, self.weights, first = corners, weights, corners[0]
        self.mean = np.asarray(weights.mean(axis=0)) if mean is None else mean
        self.order, self.cost = first.order, 3.0 * len(corners)
        self.name = f"{first.name}, at {counted(len(corners), 'corner')}"

    def inequality_17(self, P: Array) -> list[Sign]:
        """Not refuted: what is false of something above all models may be true of each."""
        P = symmetric(P)
        signs = [corner.inequality_17_of(P, corner.joint(P, self.mean)) for corner in self.corners]
        return [of_blocks(list(of_mode))._replace(refuted=False) for of_mode in zip(*signs, strict=True)]

    def inequality_18(self, P: Array, gamma: float) -> list[Sign]:
        return self.corners[0].inequality_18(P, gamma)

    def positive(self, P: Array) -> list[Sign]:
        return self.corners[0].positive(P)

    def decreasing(self, Z: Array) -> list[Sign]:
        signs = [corner.decreasing(Z) for corner in self.corners]
        return [of_blocks(list(of_mode)) for of_mode in zip(*signs, strict=True)]

    def start(self, *, up: bool) -> Reached:
        first = self.corners[0]
        return Reached(0, first.ended(self.mean) if up else first.start(up=False))

    @np.errstate(all="ignore")  # what is not finite decides nothing
    def step(self, Y: Reached, gamma: float, *, up: bool) -> tuple[list[Sign], Reached | None]:
        """Where not `up`: of the first corner, for what is false of one model is false of the box."""
        if not up:
            signs, following = self.corners[0].step(Y.Y, gamma, up=False)
            return signs, None if following is None else Reached(Y.steps + 1, following)
        undecided, n = [UNDECIDED] * len(Y.Y), self.order
        every = [S for corner in self.corners if (S := corner.joint(Y.Y, self.weight(Y.steps))) is not None]
        if len(every) < len(self.corners):
            return undecided, None
        Z = upper_bound(np.array([S.middle for S in every]), self.weight(Y.steps))
        i = np.arange(Z.shape[1])
        Z[:, i, i] += _OUTWEIGHS * np.max([S.spread for S in every], axis=0)
        if not (np.isfinite(Z).all() and self._is_above(Z, every)):
            return undecided, None
        nw = Z.shape[1] - n
        g, i, W = square(gamma, up=True), np.arange(nw), -Z[:, n:, n:]
        W[:, i, i] = np.nextafter(g - Z[:, n + i, n + i], -np.inf)
        known, sizes = np.zeros(nw), np.full(nw, g)
        signs, least = (
            list(part) for part in zip(*(bounded_below(Bounded(W_s, known), sizes) for W_s in W), strict=True)
        )
        if not all(each.proved for each in signs):
            return [each._replace(refuted=False) for each in signs], None
        grown = quotient(Z, W, np.array(least))
        return signs, None if grown is None else Reached(Y.steps + 1, raised(grown, up=True))

    def weight(self, steps: int) -> Array:
        """Of the step before which so many were taken; beyond all of them that of P, which the rest goes to."""
        return np.asarray(self.weights[steps]) if steps < len(self.weights) else self.mean

    def _is_above(self, Z: Array, every: Sequence[Bounded]) -> bool:
        """Whether Z - S > 0 is proved at every corner, in every mode."""
        sizes = Z.diagonal(axis1=1, axis2=2)
        return all(
            sign(Bounded(middle, spread), size).proved
            for rest in (difference(Z, S) for S in every)
            for middle, spread, size in zip(rest.middle, rest.spread, sizes, strict=True)
        )

    def below(self, Y: Reached, P: Array, gamma: float) -> list[Sign]:
        return self.corners[0].below(Y.Y, P, gamma)

    def floats(self, Y: Reached) -> Array:
        return np.asarray(Y.Y)

    def of(self, Y: Array, X: Array | None = None) -> Array:
        """The middle of S(Y) at every corner, (corners, modes, order, order)."""
        return np.array([corner.weigh(Y, self.mean if X is None else X) for corner in self.corners])

    def upper(self, Y: Array, steps: int) -> Array:
        """About what a step takes for Z: not proved."""
        return upper_bound(self.of(Y, self.weight(steps)), self.weight(steps))

    def carry(self, Y: Array, X: Array) -> Array:
        """What `upper` makes of X, as one of its corners or another does: `designer.proof.cube.Cube.carry`."""
        parts = shares(self.of(Y, X), X) if len(self.corners) > 1 else [X]
        return np.asarray(sum(corner.carry(Y, part) for corner, part in zip(self.corners, parts, strict=True)))


def upper_bound(S: Array, X: Array) -> Array:
    """Z(s) above every S[v](s), as far as floats tell, with tr(XZ) small; S (v, modes, m, m), X (modes, m, m) > 0.

    No least upper bound of matrices exists. From the S of the largest tr(XS) on, one after the other adds the part of
    it that is above Z: with X = FF', the positive part of F'(S - Z)F.
    """
    if len(S) == 1:
        Z, lacking = symmetric(S[0]), np.zeros(len(X))
        D = weights(Z.diagonal(axis1=1, axis2=2))
    else:
        d, X, S = _in_units(S, X)
        Z = symmetric(_folded(S, X).Z)
        sizes = Z.diagonal(axis1=1, axis2=2)
        D = weights(np.maximum(sizes, _ROUNDED * sizes.max(axis=1, keepdims=True)))
        lacking = -np.linalg.eigvalsh((Z - S) * D[:, :, None] * D[:, None, :])[..., 0].min(axis=0)
        Z, D = Z * d[:, :, None] * d[:, None, :], D / d
    i = np.arange(Z.shape[1])
    Z[:, i, i] += (np.maximum(lacking, 0.0) + _ABOVE)[:, None] / D**2
    return np.asarray(Z)


def _in_units(S: Array, X: Array) -> tuple[Array, Array, Array]:
    """Units in which X has about 1 on its diagonal, and X and S in them."""
    d = weights(X.diagonal(axis1=1, axis2=2))
    return d, X * d[:, :, None] * d[:, None, :], S / d[:, :, None] / d[:, None, :]


def shares(S: Array, X: Array) -> Array:
    """Which part of X each S[v] decides about in tr(XZ), (v, modes, m, m): their sum is about X."""
    d, X, S = _in_units(S, X)
    found, (_, F, order, folds), modes = np.zeros_like(S), _folded(S, X), np.arange(len(X))
    G = np.tile(np.eye(X.shape[1]), (len(X), 1, 1))
    for corner, (vectors, added) in zip(order[:0:-1], folds[::-1], strict=True):
        by_vectors, along = vectors.swapaxes(1, 2) @ G @ vectors, F @ vectors
        found[corner, modes] = along @ (by_vectors * (added[:, :, None] & added[:, None, :])) @ along.swapaxes(1, 2)
        G = vectors @ (by_vectors * ~(added[:, :, None] | added[:, None, :])) @ vectors.swapaxes(1, 2)
    found[order[0], modes] = F @ G @ F.swapaxes(1, 2)
    return np.asarray(found / d[:, :, None] / d[:, None, :])


class _Folded(NamedTuple):
    Z: Array
    F: Array  # X = FF'
    order: Indices  # (v, modes), in which the corners were added
    folds: list[tuple[Array, Flags]]  # eigenvectors of each F'(S - Z)F, and which of them were added


def _folded(S: Array, X: Array) -> _Folded:
    values, vectors = np.linalg.eigh(X)
    roots = np.sqrt(np.maximum(values, _LEAST * values[:, -1:]))
    F, inverse = vectors * roots[:, None, :], (vectors / roots[:, None, :]).swapaxes(1, 2)
    modes, order = np.arange(len(X)), np.argsort(-np.einsum("sij,vsij->vs", X, S), axis=0)
    folds: list[tuple[Array, Flags]] = []
    Z = S[order[0], modes]
    for corner in order[1:]:
        values, vectors = np.linalg.eigh(F.swapaxes(1, 2) @ (S[corner, modes] - Z) @ F)
        part = vectors.swapaxes(1, 2) @ inverse
        Z = Z + part.swapaxes(1, 2) @ (np.maximum(values, 0.0)[:, :, None] * part)
        folds.append((vectors, values > 0.0))
    return _Folded(Z, F, order.astype(np.int64), folds)


def prove(by: Arithmetic, modes: tuple[str, ...], gamma: float, P: Array) -> Verdict:
    """(17) and P > 0 at every corner, and the recursion: gamma bounds the gain of every model of the box."""
    findings = found("(17)", modes, by.inequality_17(P)) + found("P > 0", modes, by.positive(P))
    if proved(findings):
        findings += recursion(by, modes, gamma, P)
    why = failure(findings, by.name)
    return Verdict(why is None, gamma, by.name, why, margins(findings))
