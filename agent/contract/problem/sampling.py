"""A plant of continuous time, dx/dt = A_c x + B_c w, as it is at its samples, T apart.

A = exp(A_c T), and B is the integral of exp(A_c t) B_c from 0 to T: w is held between samples. In integers that stand
for fractions with many binary places, far more than a float64 has: so A and B are right to the last bit, and the same
on every machine.
"""

from __future__ import annotations

import math

from agent.contract.arrays import Array, read_only

LARGEST = 1000.0  # A_c T, by the sum of a row
_PLACES = 256
_PER_NORM = 3  # more for each unit of the norm: exp of it is so many binary digits, and squared ones round more

_Matrix = list[list[int]]


def sampled(A: Array, B: Array, period: float) -> tuple[Array, Array]:
    """A (nx, nx) and B (nx, nw) of x(k+1) = A x(k) + B w(k). Raises ValueError where A T is too large."""
    nx, nw = B.shape
    norm = max(math.fsum(abs(entry) for entry in row) for row in A.tolist()) * period
    if not norm <= LARGEST:
        raise ValueError(
            f"A_continuous times sample_time has rows that sum up to {norm:.3g}; up to {LARGEST:g} it is discretised: "
            "sample more often"
        )
    halvings = max(0, math.ceil(math.log2(norm)) + 1) if norm > 0.0 else 0
    places = _PLACES + math.ceil(_PER_NORM * norm)
    both = [[*A[i].tolist(), *B[i].tolist()] for i in range(nx)] + [[0.0] * (nx + nw)] * nw
    exponential = _exponential([[_fixed(entry, period, places - halvings) for entry in row] for row in both], places)
    for _ in range(halvings):
        exponential = _times(exponential, exponential, places)
    one = 1 << places
    try:
        found = [[entry / one for entry in row] for row in exponential[:nx]]
    except OverflowError:
        raise ValueError("exp(A_continuous sample_time) is beyond float64; sample more often") from None
    return read_only([row[:nx] for row in found]), read_only([row[nx:] for row in found])


def _fixed(entry: float, period: float, places: int) -> int:
    """entry times period, both taken as they stand, in units of 2^-places."""
    (p, q), (r, s) = entry.as_integer_ratio(), period.as_integer_ratio()
    return ((p * r) << places) // (q * s)


def _exponential(X: _Matrix, places: int) -> _Matrix:
    """The sum of X^k / k! until nothing is added."""
    n = len(X)
    term = [[(1 << places) * (i == j) for j in range(n)] for i in range(n)]
    total, k = [row[:] for row in term], 0
    while any(entry not in (0, -1) for row in term for entry in row):  # what is rounded down stays at -1
        k += 1
        term = [[entry // k for entry in row] for row in _times(term, X, places)]
        total = [[a + b for a, b in zip(*rows, strict=True)] for rows in zip(total, term, strict=True)]
    return total


def _times(X: _Matrix, Y: _Matrix, places: int) -> _Matrix:
    columns = list(zip(*Y, strict=True))
    return [[sum(map(int.__mul__, row, column)) >> places for column in columns] for row in X]
