"""Whether what a linear system with chance holds dies out, and how fast: of the map L that its covariances follow.

L takes a family of symmetric matrices, one for each mode, to the mean of Y one step later; where Y rises, so does
L(Y). The errors are mean-square stable if and only if the powers of L decay, and then Z = U + L(U) + L^2(U) + ... is
the only solution of Z - L(Z) = U. For U > 0 that equation decides both ways (docs/theory.md, section 3):

* if Z > 0, L^k(Z) falls to 0, so the errors die out;
* if some v'Z(s)v < 0, then -Z <= L(-Z) <= L^2(-Z) <= ..., and E eta(k)'(-Z)eta(k) from eta(0) = v never falls below
  its start, which is above 0: these errors do not die out.

All that is found here is found in floats; what is claimed of it is proved in designer/proof.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from functools import cached_property, partial
from importlib.util import find_spec
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agent.contract.arrays import Array

Map = Callable[[Array], Array]

_TERMS = 300  # that are added one by one, which rounds least; what decays more slowly is solved for
DENSE = 1000  # unknowns up to which L is written out as a matrix
_FEW = 40  # and up to which its eigenvalues take no time
_TIGHT, _ROUGH = (1e-10, 60, 9), (1e-4, 10, 4)  # tolerance and restarts of Arnoldi's method, and digits then known
_TIGHT_UP_TO = 50_000  # unknowns: beyond, 60 restarts take more than a second, as one product may take 0.1 s
_DIGITS_OF_GROWTH = 2
_TRANSIENT = 100.0  # growth before decay beyond this: eigenvalues react to rounding, and Arnoldi's method most of all
_STEPS = 30  # in which it is looked for
_HUGE = 1e150
_EXACT = 1e-12
_BALANCED = 150  # states of the errors up to which other units are tried
_HANDED_ON, _NEAR = 0.1, 1e-4  # in these; by what decays or grows in a state by itself at least
_ROUNDED_AWAY = 1e10  # of I: Z beyond that has fewer digits than it takes to see what it is
_RANGE = 500.0  # of logarithms of weights
_REST = 0.25  # what is left of U may be off by, measured by U


class Rate(NamedTuple):
    """The spectral radius of L, and how many of its digits are known."""

    radius: float
    digits: int = 9


class Decay:
    """Z, (modes, n, n), with Z - L(Z) = rest > 0, or None where floats find none that surely has; and the radius."""

    def __init__(self, total: Array | None, rest: Array | None, rate: Callable[[], Rate]) -> None:
        self.total, self.rest, self._rate = total, rest, rate

    @cached_property
    def rate(self) -> Rate:
        """Of L: of large networks it takes several times as long as Z, so only who asks pays for it."""
        return self._rate()

    @property
    def radius(self) -> float:
        """Spectral radius of L."""
        return self.rate.radius

    @property
    def dies_out(self) -> bool:
        """As far as floats tell; that it is not so is not known from this alone."""
        return self.total is not None and is_positive(self.total)


def decay(L: Map, modes: int, units: Array, moves: NDArray[np.bool_] | None = None) -> Decay:
    """Of L on (modes, n, n); `units` (n,): powers of two in which the numbers are near 1, U = diag(units^2).

    `moves` (n, n): whether state j ever moves state i, as far as that is known; the radius is the better for it.
    """
    n, scaled = len(units), _in_units(L, units)
    rate = partial(spectral_radius, scaled, modes, n, moves)
    total, rest = _total(scaled, modes, n)
    if n <= _BALANCED and (total is None or not np.abs(total).max() < _ROUNDED_AWAY):
        others = units * balance(scaled, modes, n)
        again = _total(_in_units(L, others), modes, n)
        if again[0] is not None:
            units, (total, rest) = others, again
    both = np.outer(units, units)
    return Decay(None if total is None else total * both, None if rest is None else rest * both, rate)


def _in_units(L: Map, units: Array) -> Map:
    both = np.outer(units, units)

    def scaled(Y: Array) -> Array:
        X = L(Y * both) / both
        return np.asarray((X + X.swapaxes(1, 2)) / 2.0)

    return scaled


def balance(L: Map, modes: int, n: int) -> Array:
    """Units, powers of two, in which no state hands on more than it has to, (n,).

    In a line of states each of which hands on more than it got, Z grows without end along the line, and so does what
    rounding does to it. N says how the weight of each state alone goes over to others. In these units no entry of it
    off the diagonal is above the geometric mean of those on the worst cycle of several states, or where that is less,
    above a part of what decays or grows in a state by itself.
    """
    N = np.empty((n, n))  # N[j, i]: what of a weight 1 of state i state j has a step earlier
    for i in range(n):
        unit = np.zeros((modes, n, n))
        unit[:, i, i] = 1.0
        N[:, i] = L(unit).diagonal(axis1=1, axis2=2).max(axis=0)
    if not np.isfinite(N).all():
        return np.ones(n)
    own = float(np.abs(1.0 - N.diagonal()).min())
    np.fill_diagonal(N, 0.0)
    with np.errstate(divide="ignore"):
        onwards = np.log(np.maximum(N, 0.0))
    most = max(_largest_cycle_mean(onwards), np.log(_HANDED_ON * max(own, _NEAR) ** 2))
    while True:
        logs = np.zeros(n)
        for _ in range(n):
            logs = np.maximum(logs, (onwards - most + logs).max(axis=1))
        if logs.max() < _RANGE:
            return np.asarray(np.exp2(np.round((logs - logs.max()) / (2.0 * np.log(2.0)))))
        most += 1.0


def _largest_cycle_mean(onwards: Array) -> float:
    """The largest mean of `onwards` on a cycle, by Karp's theorem; -inf where there is none."""
    n = len(onwards)
    longest = np.full((n + 1, n), -np.inf)  # of all walks of so many steps that end there
    longest[0] = 0.0
    for k in range(n):
        longest[k + 1] = (onwards + longest[k]).max(axis=1)
    ends = np.isfinite(longest[n])
    if not ends.any():
        return -np.inf
    means = (longest[n, ends] - longest[:n, ends]) / (n - np.arange(n))[:, None]
    return float(means.min(axis=0).max())


def is_positive(Z: Array) -> bool:
    """Whether every Z (..., n, n) is positive definite, by Cholesky, in units in which its diagonal is 1."""
    sizes = np.sqrt(np.abs(Z.diagonal(axis1=-2, axis2=-1)))
    if not (np.isfinite(Z).all() and (sizes > 0.0).all()):
        return False
    try:
        np.linalg.cholesky(Z / sizes[..., :, None] / sizes[..., None, :])
    except np.linalg.LinAlgError:
        return False
    return True


def _total(L: Map, modes: int, n: int) -> tuple[Array | None, Array | None]:
    """Z and Z - L(Z) for U = I, which is in the middle of what is allowed for."""
    eye = np.broadcast_to(np.eye(n), (modes, n, n))
    total, term = eye.copy(), eye
    for _ in range(_TERMS):
        term = L(term)
        largest = float(np.abs(term).sum(axis=2).max())  # a bound on every eigenvalue
        if largest < 0.5:
            return total, eye - term
        if not largest < _HUGE:
            break
        total = total + term
    Z = solution(L, eye, enough=_REST / np.sqrt(modes * n))
    if Z is None or not np.isfinite(Z).all() or np.abs(Z).max() > _HUGE:
        return None, None
    rest = Z - L(Z)
    return (Z, rest) if np.abs(rest - eye).sum(axis=2).max() < 2.0 * _REST else (None, None)


def solution(L: Map, right: Array, *, enough: float = _EXACT) -> Array | None:
    """X of X - L(X) = right, (modes, n, n), symmetric; of what is too large to be solved at once to `enough` of it.

    None where there is none, or it is not found.
    """
    modes, n = right.shape[:2]
    pack, unpack = packing(modes, n)
    b, order = pack(right), modes * n * (n + 1) // 2
    if order <= DENSE:
        I_L = np.eye(order) - _matrix(L, modes, n)
        if not np.isfinite(I_L).all():
            return None
        try:
            x = np.linalg.solve(I_L, b)
            return unpack(x + np.linalg.solve(I_L, b - I_L @ x))
        except np.linalg.LinAlgError:
            return None
    from scipy.sparse.linalg import LinearOperator, gmres

    I_L = LinearOperator((order, order), matvec=lambda x: x - pack(L(unpack(x))), dtype=np.float64)
    x, _ = gmres(I_L, b, rtol=enough, restart=60, maxiter=5)
    return unpack(x)


@np.errstate(over="ignore", invalid="ignore")
def spectral_radius(L: Map, modes: int, n: int, moves: NDArray[np.bool_] | None = None) -> Rate:
    """Of L; by its eigenvalues, of large ones by Arnoldi's method. Infinite where L overflows.

    Where states move each other in one direction only, as nodes in a line, eigenvalues of the whole are very sensitive
    to rounding. Those of the parts in which all move all are as many as are needed: what of L takes a part to itself.
    """
    if moves is None or modes * n * (n + 1) // 2 <= _FEW or not find_spec("scipy"):
        return _radius(L, modes, n)
    from scipy.sparse.csgraph import connected_components

    number, of_state = connected_components(moves, connection="strong")

    def of_part(part: NDArray[np.intp]) -> Rate:
        at = np.ix_(np.arange(modes), part, part)

        def within(Y: Array) -> Array:
            whole = np.zeros((modes, n, n))
            whole[at] = Y
            return np.asarray(L(whole)[at])

        return _radius(within, modes, len(part))

    rates = [of_part(np.flatnonzero(of_state == k)) for k in range(number)]
    return Rate(max(rate.radius for rate in rates), min(rate.digits for rate in rates))


def _radius(L: Map, modes: int, n: int) -> Rate:
    pack, unpack = packing(modes, n)
    order = modes * n * (n + 1) // 2
    first = pack(L(np.broadcast_to(np.eye(n), (modes, n, n))))
    if not np.isfinite(first).all():
        return Rate(np.inf)
    rate = _by_arnoldi(L, modes, n, first) if order > _FEW and find_spec("scipy") else None
    if rate is not None and not _has_transient(L, modes, n, rate.radius):
        return rate
    if order > 2 * DENSE:
        return Rate(_growth(L, unpack(first)), _DIGITS_OF_GROWTH)
    M = _matrix(L, modes, n)
    return Rate(float(np.abs(np.linalg.eigvals(M)).max()) if np.isfinite(M).all() else np.inf)


def _by_arnoldi(L: Map, modes: int, n: int, first: Array) -> Rate | None:
    """From `first`, packed, as closely as a second allows; None where that finds nothing."""
    from scipy.sparse.linalg import ArpackError, LinearOperator, eigs

    pack, unpack = packing(modes, n)
    order = len(first)
    operator = LinearOperator((order, order), matvec=lambda y: pack(L(unpack(y))), dtype=np.float64)
    ways = [*([_TIGHT] if order <= _TIGHT_UP_TO else []), *([_ROUGH] if order > 2 * DENSE else [])]
    for tol, restarts, digits in ways:
        with suppress(ArpackError):
            found = eigs(operator, k=1, v0=first + 1e-30, tol=tol, maxiter=restarts, return_eigenvectors=False)
            return Rate(float(np.abs(found).max()), digits)
    return None


def _has_transient(L: Map, modes: int, n: int, radius: float) -> bool:
    """Whether what is held grows by much before it decays or grows as it will."""
    Y, log = np.broadcast_to(np.eye(n), (modes, n, n)), 0.0
    for _ in range(_STEPS):
        Y = L(Y)
        size = float(np.abs(Y).max())
        if not (size > 0.0 and radius > 0.0):
            return False
        Y, log = Y / size, log + float(np.log(size / radius))
        if log > np.log(_TRANSIENT):
            return True
    return False


def _growth(L: Map, Y: Array) -> float:
    """Growth per step over the second half of many, where nothing better is to be had."""
    logs = [0.0]
    for _ in range(_TERMS):
        Y = L(Y)
        size = float(np.abs(Y).max())
        if not size > 0.0:
            return 0.0
        Y, logs = Y / size, [*logs, logs[-1] + float(np.log(size))]
    half = len(logs) // 2
    return float(np.exp((logs[-1] - logs[half]) / (len(logs) - 1 - half)))


def packing(modes: int, n: int) -> tuple[Map, Map]:
    """From symmetric matrices (..., modes, n, n) to vectors, in which they have the same norm, and from one back."""
    rows, columns = np.triu_indices(n)
    weights = np.where(rows == columns, 1.0, np.sqrt(2.0))

    def pack(Y: Array) -> Array:
        return np.asarray((Y[..., rows, columns] * weights).reshape(*Y.shape[:-3], -1))

    def unpack(y: Array) -> Array:
        Y = np.empty((modes, n, n))
        Y[:, rows, columns] = Y[:, columns, rows] = y.reshape(modes, -1) / weights
        return Y

    return pack, unpack


def _matrix(L: Map, modes: int, n: int) -> Array:
    """L in these vectors, (order, order)."""
    pack, unpack = packing(modes, n)
    order = modes * n * (n + 1) // 2
    return np.array([pack(L(unpack(unit))) for unit in np.eye(order)]).T
