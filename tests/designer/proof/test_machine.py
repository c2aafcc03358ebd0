"""Machines that do not compute as the proof in floats assumes are found, and those that do in another order are not."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from networks import random_problem

from agent.contract.arrays import Array
from designer.model.error_model import error_model, link_gains, stacked_links
from designer.proof import float64, machine
from designer.proof.prover import FLOATS, Prover
from designer.search.starts import consensus_gains

honest = float64.product
Product = Callable[[Any, Any], Array]


@pytest.fixture(autouse=True)
def anew() -> Iterator[None]:
    machine.fault.cache_clear()
    yield
    machine.fault.cache_clear()


def backwards(A: Any, B: Any) -> Array:
    """The terms of every sum in the opposite order."""
    dense = A if isinstance(A, np.ndarray) else A.toarray()
    return honest(np.ascontiguousarray(dense[..., ::-1]), np.ascontiguousarray(B[::-1]))


def one_by_one(A: Any, B: Any) -> Array:
    """Term after term, nothing blocked."""
    dense = A if isinstance(A, np.ndarray) else A.toarray()
    columns = B if B.ndim > 1 else B[:, None]
    total = np.zeros((*dense.shape[:-1], columns.shape[-1]))
    for k in range(len(B)):
        total = total + dense[..., k, None] * columns[k]
    return total if B.ndim > 1 else total[..., 0]


def single_precision(A: Any, B: Any) -> Array:
    return honest(A.astype(np.float32), B.astype(np.float32)).astype(np.float64)


def split_into_halves(A: Any, B: Any) -> Array:
    """Two numbers of 24 bits for each of 53, the product of the lower two left out."""
    high = [X.astype(np.float32).astype(np.float64) for X in (A, B)]
    low = [X - X_high for X, X_high in zip((A, B), high, strict=True)]
    return honest(high[0], high[1]) + honest(high[0], low[1]) + honest(low[0], high[1])


def one_exponent_for_a_row(A: Any, B: Any) -> Array:
    """Fixed point: what is 2^60 below the largest of its row is lost."""
    dense = A if isinstance(A, np.ndarray) else A.toarray()
    largest = np.abs(dense).max(axis=-1, keepdims=True)
    unit = np.exp2(np.floor(np.log2(np.where(largest > 0.0, largest, 1.0))) - 60)
    return honest(np.rint(dense / unit) * unit, B)


def strassen(A: Any, B: Any) -> Array:
    """Seven products of halves in place of eight: entries meet that have nothing to do with each other."""
    n = A.shape[-1]
    if not isinstance(A, np.ndarray) or A.ndim > 2 or A.shape != B.shape or n % 2:
        return honest(A, B)
    h = n // 2
    a, b, c, d = A[:h, :h], A[:h, h:], A[h:, :h], A[h:, h:]
    e, f, g, k = B[:h, :h], B[:h, h:], B[h:, :h], B[h:, h:]
    m = [
        honest(x, y)
        for x, y in ((a + d, e + k), (c + d, e), (a, f - k), (d, g - e), (a + b, k), (c - a, e + f), (b - d, g + k))
    ]
    top = np.hstack([m[0] + m[3] - m[4] + m[6], m[2] + m[4]])
    return np.vstack([top, np.hstack([m[1] + m[3], m[0] - m[1] + m[2] + m[5]])])


def only_sparse(A: Any, B: Any) -> Array:
    return honest(A, B) if isinstance(A, np.ndarray) else single_precision(A, B)


def only_vectors(A: Any, B: Any) -> Array:
    return honest(A, B) if B.ndim > 1 else single_precision(A, B)


def only_its_own_transpose(A: Any, B: Any) -> Array:
    """As if the routine for AA' were another one."""
    return single_precision(A, B) if isinstance(A, np.ndarray) and B.base is A else honest(A, B)


@pytest.mark.parametrize("order", [1, 2, 3, 8, 61, 150, 500])
@pytest.mark.parametrize("product", [honest, backwards, one_by_one])
def test_an_honest_machine_has_no_fault(product: Product, order: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """In whatever order it sums."""
    monkeypatch.setattr(machine, "product", product)
    assert machine.fault(order) is None


@pytest.mark.parametrize("order", [8, 42, 150])
@pytest.mark.parametrize(
    "product",
    [
        single_precision,
        split_into_halves,
        one_exponent_for_a_row,
        strassen,
        only_sparse,
        only_vectors,
        only_its_own_transpose,
    ],
)
def test_a_product_that_is_less_exact_is_found(product: Product, order: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine, "product", product)
    assert f"of order {order} is not as exact as a sum of rounded products" in str(machine.fault(order))


def test_an_operation_that_is_less_exact_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """By two units in the last place, in one operation of four, and nextafter that stands still."""

    def rough(a: Any, b: Any) -> Any:
        return a * b if isinstance(a, Fraction) else (a * b) * (1.0 + 2.0**-51)

    with monkeypatch.context() as patched:
        patched.setattr(machine, "mul", rough)
        assert "an operation on two float64 numbers" in str(machine.fault(4))
    machine.fault.cache_clear()
    assert machine.fault(4) is None
    machine.fault.cache_clear()
    monkeypatch.setattr(np, "nextafter", lambda a, b: a)
    assert "an operation on two float64 numbers" in str(machine.fault(4))


def test_on_a_machine_with_a_fault_balls_are_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is decided in floats there, true or false; where there is nobody else to ask, it says why."""
    problem = random_problem(3)
    gains = consensus_gains(problem, weight=0.2)
    K, H = link_gains(problem, *gains)
    P = Prover(problem, K, H).P
    assert P is not None
    assert error_model(problem, *stacked_links(problem, K, H)).size == P.shape[1]
    monkeypatch.setattr(machine, "product", single_precision)
    machine.fault.cache_clear()
    for gamma, holds in ((3.0, True), (1e-3, False)):
        verdict = Prover(problem, K, H, P=P).exact(gamma)
        assert verdict.holds is holds
        assert "ball arithmetic of 128 bits" in verdict.arithmetic
        floats = Prover(problem, K, H, P=P, makes=FLOATS)
        for verdict in (floats.exact(gamma), floats.theorem1(gamma)):
            assert not verdict.holds
            assert "it is not proved" in str(verdict.failure)
            assert "float64, which is not used on this machine because a matrix product" in str(verdict.failure)
    assert not any(sign.proved or sign.refuted for sign in FLOATS[0](problem, K, H).positive(P))
