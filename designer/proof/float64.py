"""Symmetric matrices in float64 with a bound on every rounding: what is said of one here is true of the exact one.

docs/theory.md, section 4, derives the bounds and says what is assumed of the machine; `fault` looks whether its
products keep to it. Nothing is assumed of LAPACK: it finds factors and eigenvectors, which are multiplied out here.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from agent.contract.arrays import Array
from designer.proof.balls import UNDECIDED, Sign

U = 2.0**-52  # no operation errs by more, relative to its result: to nearest, or in any other direction
UP = 1.0 + 2.0**-30  # outweighs the rounding of sums of products of numbers >= 0, if a term meets at most 2^21
LARGEST = 2.0**100  # of all that is multiplied
TINY = 2.0**-500  # outweighs all that underflows, gradually or flushed, of such numbers
_RESOLVED = 1e-15  # of a matrix with about 1 on its diagonal: below that nothing is tried


class Bounded(NamedTuple):
    """A symmetric matrix that is not known exactly: -diag(spread) <= exact - middle <= diag(spread), as forms."""

    middle: Array  # (..., n, n), symmetric
    spread: Array  # (..., n)


def relative(roundings: int) -> float:
    """A bound of (1 + U)^k - 1, which is what k roundings do at most, for k up to 2^40."""
    return 1.01 * roundings * U


def within(*arrays: Array) -> bool:
    """Whether nothing in them is beyond LARGEST, or no number."""
    return all(bool((np.abs(array) <= LARGEST).all()) for array in arrays)


def weights(sizes: Array) -> Array:
    """Powers of two, about 1 / sqrt |size| and within 2^50 of each other: what scales a matrix to about 1, exactly."""
    sizes = np.where(np.isfinite(sizes), np.abs(sizes), 0.0)
    top = sizes.max(axis=-1, keepdims=True, initial=0.0)
    sizes = np.maximum(sizes, np.where(top > 0.0, 2.0**-100 * top, 1.0))
    return np.asarray(np.ldexp(1.0, np.rint(-0.5 * np.log2(sizes)).astype(np.int64)))


def symmetric(S: Array) -> Array:
    """(S + S') / 2: one rounding."""
    return np.asarray((S + S.swapaxes(-1, -2)) * 0.5)


def product(A: Any, B: Any) -> Array:
    """A B, A dense or sparse. All products of a proof are taken here: what is assumed of them is in docs/theory.md."""
    return np.asarray(A @ B)


def times(A: Array, x: Array) -> Array:
    """A x for matrices (..., m, n) and vectors (..., n)."""
    return product(A, x[..., None])[..., 0]


def raised(S: Bounded, *, up: bool) -> Array:
    """Floats that are not below the exact matrix, as forms; or, where not `up`, not above it."""
    out, i = S.middle.copy(), np.arange(S.middle.shape[-1])
    shift, end = (S.spread, np.inf) if up else (-S.spread, -np.inf)
    out[..., i, i] = np.nextafter(out[..., i, i] + shift, end)
    return out


def difference(A: Array, B: Bounded) -> Bounded:
    """A - B for symmetric floats A, which may have met two roundings each."""
    D = weights(A.diagonal(axis1=-2, axis2=-1))
    rounded = relative(3) * times(np.abs(A) + np.abs(B.middle), D) / D
    return Bounded(A - B.middle, (B.spread + rounded) * UP + TINY)


def quotient(J: Array, W: Array, least: Array) -> Bounded | None:
    """J_11 + J_12 W^-1 J_21, (modes, n, n), for symmetric J (modes, n + nw, n + nw) and W (modes, nw, nw) >= least I.

    With Z about W^-1 J_21 and R = J_21 - W Z it is J_11 + J_12 Z + Z'R + R'W^-1 R. None: out of range.
    """
    n, nw = J.shape[-1] - W.shape[-1], W.shape[-1]
    J_11, J_12, J_21 = J[..., :n, :n], J[..., :n, n:], J[..., n:, :n]
    try:
        Z: Array = np.asarray(np.linalg.solve(W, J_21), dtype=np.float64)
    except np.linalg.LinAlgError:
        return None
    if not within(J, W, Z, np.reciprocal(least)):
        return None
    D = weights(J_11.diagonal(axis1=-2, axis2=-1))
    size_J, size_Z, size_Z_T = np.abs(J_12), np.abs(Z), np.abs(Z.swapaxes(-1, -2))
    size_R = np.abs(J_21 - product(W, Z)) + relative(nw + 2) * (np.abs(J_21) + product(np.abs(W), size_Z))
    Z_D, R_D = times(size_Z, D), times(size_R, D)
    J_Z_D = 0.5 * (times(size_J, Z_D) + times(size_Z_T, times(np.abs(J_21), D)))
    rounded = relative(nw + 2) * (times(np.abs(J_11), D) + J_Z_D)
    left = 0.5 * times(size_Z_T, R_D) + times(size_R.swapaxes(-1, -2), 0.5 * Z_D + R_D / least[:, None])
    return Bounded(symmetric(J_11 + product(J_12, Z)), (rounded + left) / D * UP + TINY)


def sign(S: Bounded, sizes: Array) -> Sign:
    """Whether the exact matrix is positive definite; sizes: what its diagonal is measured by."""
    return bounded_below(S, sizes)[0]


@np.errstate(all="ignore")  # what is not finite decides nothing
def bounded_below(S: Bounded, sizes: Array) -> tuple[Sign, float]:
    """The sign of the exact matrix, and a proved lower bound of its least eigenvalue: 0 where none is proved."""
    if not within(S.middle, S.spread, sizes, 1.0 / np.abs(sizes).max(initial=0.0)):
        return UNDECIDED, 0.0
    D = weights(sizes)
    Q, shift = S.middle * D * D[:, None], S.spread * D * D + TINY  # exact, but for underflow
    try:
        least = float(np.linalg.eigvalsh(Q)[0]) if len(Q) > 1 else float(Q[0, 0])
        floor = _floor(Q, shift, least) if least > _RESOLVED else 0.0
        refuted = least < 0.0 and _negative(Q, shift)
    except np.linalg.LinAlgError:
        return UNDECIDED, 0.0
    return Sign(proved=floor > 0.0, refuted=refuted, least=least), floor / float(D.max()) ** 2


def _floor(Q: Array, shift: Array, least: float) -> float:
    """A bound below the eigenvalues of all matrices within Q -+ diag(shift): by Gershgorin, of Q - LL' for some L."""
    order = len(Q)
    L = np.linalg.cholesky(Q - np.diag(shift + 0.5 * least))
    rest, size = Q - product(L, L.T), np.abs(L)
    if not within(rest, size):
        return 0.0
    on = rest.diagonal().copy()
    np.fill_diagonal(rest, 0.0)
    rounded = relative(order + 2) * (np.abs(Q).sum(axis=1) + product(size, size.sum(axis=0)))
    off = (np.abs(rest).sum(axis=1) + rounded + shift) * UP + TINY
    return max(float(np.nextafter(on - off, -np.inf).min()), 0.0)


def _negative(Q: Array, shift: Array) -> bool:
    """Whether some x is proved to have x'Xx < 0 for all matrices X within Q -+ diag(shift)."""
    x = np.linalg.eigh(Q)[1][:, 0]
    size = np.abs(x)
    rounded = relative(2 * len(x) + 2) * float(product(size, product(np.abs(Q), size)))
    above = float(product(x, product(Q, x)))
    return within(x) and above < -((rounded + float(product(shift * size, size))) * UP + TINY)
