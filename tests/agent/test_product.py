"""Sums in a stated order: those of a plain loop, to the last bit."""

from __future__ import annotations

import warnings

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from agent.contract.arrays import Array
from agent.product import product


def looped(matrix: Array, vector: Array) -> list[float]:
    """Each row from left to right, every product and every sum rounded once."""
    total = []
    for row in matrix.tolist():
        value = row[0] * vector.tolist()[0]
        for a, b in zip(row[1:], vector.tolist()[1:], strict=True):
            value += a * b
        total.append(value)
    return total


@given(st.integers(0, 1000), st.integers(1, 7), st.integers(1, 40))
def test_a_product_is_the_loop_bit_for_bit(seed: int, rows: int, columns: int) -> None:
    rng = np.random.default_rng(seed)
    matrix = rng.normal(size=(rows, columns)) * 10.0 ** rng.integers(-12, 12, (rows, columns))
    vector = rng.normal(size=columns)
    assert product(matrix, vector).tolist() == looped(matrix, vector)


def test_the_order_is_seen() -> None:
    """1 + 2^-53 + 2^-53 is 1 from left to right, and more in any other order."""
    assert product(np.ones((1, 3)), np.array([1.0, 2.0**-53, 2.0**-53])).tolist() == [1.0]
    assert product(np.ones((1, 3)), np.array([2.0**-53, 2.0**-53, 1.0])).tolist() == [1.0 + 2.0**-52]


def test_a_product_is_never_fused_with_a_sum() -> None:
    """The square of 1 + 2^-30 is rounded before 1 is taken from it."""
    x = 1.0 + 2.0**-30
    assert product(np.array([[1.0, x]]), np.array([-1.0, x])).tolist() == [2.0**-29]


def test_overflow_is_a_number_and_no_warning() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = product(np.array([[1e308, -1e308], [1e308, 0.0]]), np.array([10.0, 10.0]))
    assert np.isnan(found[0])
    assert found[1] == np.inf
