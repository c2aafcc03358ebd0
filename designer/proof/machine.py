"""Whether this machine computes as the proof in floats assumes (docs/theory.md, section 4): a look, not a proof.

Sums and products of single numbers are held against rational ones. Matrices have integers for entries, so small that
every sum of products is exact in whatever order it is taken; scaled by powers of two it still is, unless numbers meet
that have nothing to do with each other, as they do in Strassen's method or where a row shares one exponent.
"""

from __future__ import annotations

from fractions import Fraction
from functools import cache
from operator import add, mul, sub, truediv
from typing import Any

import numpy as np

from agent.contract.arrays import Array
from designer.proof.float64 import U, product
from designer.proof.sparse import matrix

_LARGEST = 256  # order that is looked at: 0.05 s


@cache
@np.errstate(all="ignore")  # what overflows is a fault, and no warning
def fault(order: int) -> str | None:
    """What is not as assumed, in matrices of this order and in single numbers; None: nothing was found."""
    if not _rounds():
        return "an operation on two float64 numbers is off by more than one unit in the last place"
    order = min(order, _LARGEST)
    for name, computed, exact in _products(order):
        if not np.array_equal(computed, exact):
            return f"{name} of order {order} is not as exact as a sum of rounded products"
    return None


def _rounds() -> bool:
    a, b = np.random.default_rng(0).normal(size=(2, 50))
    steps = np.nextafter(a, np.inf) > a
    return bool(steps.all()) and all(
        abs(Fraction(float(found)) - exact) <= Fraction(U) * abs(exact)
        for operation in (add, sub, mul, truediv)
        for x, y, found in zip(a.tolist(), b.tolist(), operation(a, b), strict=True)
        for exact in [operation(Fraction(x), Fraction(y))]
    )


def _products(order: int) -> list[tuple[str, Array, Array]]:
    """Names, products as they are computed, and the exact ones."""
    rng = np.random.default_rng(order)
    whole = rng.integers(-(2**20), 2**20, size=(order, order))
    powers = np.ldexp(1.0, rng.integers(-60, 61, size=order))
    first = np.arange(order) < order // 2
    apart = np.where(first == first[:, None], whole, 0)
    far = np.ldexp(1.0, np.where(first, 60, -60))
    near = (np.arange(order) - np.arange(order)[:, None]) % order < 4  # so few terms that there may be more digits
    few = np.where(near, rng.integers(-(2**25), 2**25, size=(order, order)), 0)
    A, exact, exact_apart = whole.astype(np.float64), whole @ whole.T, (apart @ apart.T) * far * far[:, None]
    left, right, factor = A * powers, A.T / powers[:, None], apart * far
    found = [
        ("a matrix product", product(A, A.T), exact),
        ("a matrix product", product(left, right), exact),
        ("a matrix product", product(factor, factor.T), exact_apart),
        ("a matrix product", product(few.astype(np.float64), few.T.astype(np.float64)), few @ few.T),
        ("a matrix product", product(np.stack([left, left]), right), np.stack([exact, exact])),
        ("a matrix times a vector", product(left, right[:, 0]), exact[:, 0]),
        ("a sparse matrix product", product(_sparse(left), right), exact),
    ]
    return [(name, computed, np.asarray(truth, dtype=np.float64)) for name, computed, truth in found]


def _sparse(A: Array) -> Any:
    rows, columns = np.nonzero(A)
    return matrix(A[rows, columns], rows, columns, (len(A), len(A)))
