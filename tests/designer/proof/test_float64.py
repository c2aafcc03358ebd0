"""Signs, bounds and steps in float64 against fractions, whatever LAPACK finds, and whatever products may err."""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
import rational
from lies import LIES, cholesky
from products import Product, honest, worst
from rational import Exact, positive_definite

from agent.contract.arrays import Array
from designer.proof import float64
from designer.proof.by_floats import square
from designer.proof.float64 import (
    LARGEST,
    TINY,
    Bounded,
    U,
    bounded_below,
    difference,
    quotient,
    raised,
    relative,
    sign,
)


def known(matrix: Array) -> Bounded:
    return Bounded(matrix, np.zeros(matrix.shape[:-1]))


def holds(S: Bounded, exact: Exact) -> bool:
    """Whether -diag(spread) <= exact - middle <= diag(spread)."""
    off, room = rational.plus(exact, rational.exact(S.middle), -1), rational.diagonal(S.spread)
    return all(positive_definite(rational.plus(room, off, side)) for side in (1, -1))


PRODUCTS = {"numpy": honest, **{f"worst {seed}": worst(seed) for seed in range(3)}}
every_product = pytest.mark.parametrize("product", PRODUCTS.values(), ids=PRODUCTS)


# signs
def laplacian(order: int, seed: int) -> Array:
    """Weighted and connected: integers, row sums 0, rank order - 1 exactly."""
    rng = np.random.default_rng(seed)
    weight = np.triu(np.where(rng.uniform(size=(order, order)) < 0.3, rng.integers(1, 9, (order, order)), 0), 1)
    weight[np.arange(order - 1), np.arange(1, order)] = 3
    weight = weight + weight.T
    return np.asarray(np.diag(weight.sum(axis=1)) - weight, dtype=np.float64)


@every_product
@pytest.mark.parametrize("order", [2, 9, 60])
def test_the_sign_of_a_nearly_singular_matrix_is_the_exact_one_or_none(
    order: int, product: Product, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A Laplacian with epsilon on its diagonal has a determinant of the sign of epsilon."""
    monkeypatch.setattr(float64, "product", product)
    for seed in range(3):
        S = laplacian(order, seed)
        at = int(np.random.default_rng(seed).integers(order))
        for power in range(1, 46):
            for side in (-1, 1):
                shifted = S.copy()
                shifted[at, at] += side * 2.0**-power
                assert Fraction(shifted[at, at]) - Fraction(S[at, at]) == side * Fraction(2) ** -power
                found = sign(known(shifted), S.diagonal())
                assert found.proved in (False, side > 0)
                assert found.refuted in (False, side < 0)
                assert found.proved or found.refuted or power > 25
        assert sign(known(S), S.diagonal())[:2] == (False, False)


def nearly_singular(rng: np.random.Generator) -> Array:
    """VV' rounded, the last row of V a combination of the others but for 1 to 1e-9; the last entry off a little."""
    order = int(rng.integers(2, 7))
    V = rng.integers(-9, 10, size=(order, order)).astype(float)
    V[-1] = rng.integers(-2, 3, size=order - 1) @ V[:-1] + rng.normal(size=order) * 2.0 ** -rng.integers(0, 31)
    S = V @ V.T * np.exp2(rng.integers(-20, 21, size=1))
    S[-1, -1] *= 1.0 + rng.choice([-1.0, 0.0, 1.0]) * 2.0 ** -rng.integers(2, 52)
    units = np.exp2(rng.integers(-15, 16, size=order))
    return np.asarray(float64.symmetric(S) * units * units[:, None])


@every_product
def test_no_sign_of_hundreds_of_matrices_is_wrong(product: Product, monkeypatch: pytest.MonkeyPatch) -> None:
    """Against elimination in fractions, with a spread and without; every answer occurs."""
    monkeypatch.setattr(float64, "product", product)
    rng, answers = np.random.default_rng(0), set()
    for number in range(300):
        S = nearly_singular(rng)
        spread = S.diagonal() * 2.0 ** -rng.integers(10, 60) if number % 3 else np.zeros(len(S))
        found = sign(Bounded(S, spread), S.diagonal())
        lower, upper = (rational.plus(rational.exact(S), rational.diagonal(spread), side) for side in (-1, 1))
        assert positive_definite(lower) or not found.proved
        assert not found.refuted or not positive_definite(upper)
        answers.add((found.proved, found.refuted, positive_definite(lower)))
    assert answers >= {(True, False, True), (False, True, False), (False, False, False)}


def test_a_lower_bound_is_below_the_least_eigenvalue() -> None:
    """S - least I is positive definite still, in units up to 1e9 apart; where nothing is proved it is 0."""
    rng = np.random.default_rng(1)
    for _ in range(100):
        S = nearly_singular(rng)
        found, least = bounded_below(known(S), S.diagonal())
        assert (least > 0.0) is found.proved
        if least:
            assert positive_definite(rational.plus(rational.exact(S), rational.diagonal(np.full(len(S), least)), -1))


eigh = np.linalg.eigh


@pytest.mark.parametrize("epsilon", [0.0, -(2.0**-40), -(2.0**-20), -1.0])
@pytest.mark.parametrize("lie", LIES)
def test_no_lie_of_lapack_proves_what_is_false(lie: str, epsilon: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever the least eigenvalue is said to be, and whatever stands for the factor."""
    S = laplacian(20, 1)
    S[3, 3] += epsilon
    monkeypatch.setattr(np.linalg, "cholesky", LIES[lie])
    for least in (1.0, 1e-9, 1e9):
        monkeypatch.setattr(np.linalg, "eigvalsh", lambda S, least=least: np.full(len(S), least))
        assert not sign(known(S), S.diagonal()).proved


@pytest.mark.parametrize("lie", LIES)
def test_no_lie_of_lapack_refutes_what_is_true(lie: str, monkeypatch: pytest.MonkeyPatch) -> None:
    S = laplacian(20, 1) + np.eye(20)
    monkeypatch.setattr(np.linalg, "eigvalsh", lambda S: np.full(len(S), -1.0))
    monkeypatch.setattr(np.linalg, "eigh", lambda S: (None, LIES[lie](S)))
    assert not sign(known(S), S.diagonal()).refuted


# the checker has teeth: with a part of it left out, what is false is proved
def convenient(A: Any, B: Any) -> Array:
    """A product that is off as much as it may, on the diagonal, to the side where Q - LL' gains by it."""
    computed = honest(A, B)
    if computed.shape != (ORDER, ORDER):
        return computed
    return np.asarray(computed - 0.9 * ORDER * U * honest(np.abs(A), np.abs(B)) * np.eye(ORDER))


ORDER = 60


@pytest.mark.parametrize("part", ["dominance", "spread", "rounding"])
def test_what_refuses_is_dominance_after_spread_and_rounding(part: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A factor that is a lie, a spread too wide, a product that errs as it may."""
    S = laplacian(ORDER, 1)
    S[3, 3] -= {"dominance": 1.0, "spread": -1.0, "rounding": 2.0**-48}[part]
    false = Bounded(S, 1.001 * S.diagonal()) if part == "spread" else known(S)
    if part != "spread":
        monkeypatch.setattr(np.linalg, "eigvalsh", lambda S: np.ones(len(S)))
        monkeypatch.setattr(np.linalg, "cholesky", lambda S: cholesky(S + (0.5 + 2.0**-48) * np.eye(len(S))))
    if part == "dominance":
        monkeypatch.setattr(np.linalg, "cholesky", LIES["nothing"])
    if part == "rounding":
        monkeypatch.setattr(float64, "product", convenient)
    assert not sign(false, S.diagonal()).proved
    if part == "dominance":
        monkeypatch.setattr(float64, "_floor", lambda Q, shift, least: least)
    if part == "rounding":
        monkeypatch.setattr(float64, "relative", lambda roundings: 0.0)
    assert sign(known(S) if part == "spread" else false, S.diagonal()).proved


# steps
def random_joint(rng: np.random.Generator, n: int, nw: int) -> Array:
    """(2, n + nw, n + nw), positive definite, in units up to 1e3 apart."""
    V = rng.normal(size=(2, n + nw, n + nw)) * np.exp2(rng.integers(-5, 6, size=(2, n + nw, 1)))
    return float64.symmetric(V @ V.swapaxes(1, 2))


def exact_quotient(J: Array, W: Array) -> Exact:
    n, all_of_it = len(J) - len(W), rational.exact(J)
    J_12 = rational.block(all_of_it, range(n), range(n, len(J)))
    grown = rational.times(J_12, rational.solved(rational.exact(W), rational.transposed(J_12)))
    return rational.plus(rational.block(all_of_it, range(n), range(n)), grown)


solve = np.linalg.solve
SOLVERS: dict[str, Callable[[Array, Array], Array]] = {
    "LAPACK": np.linalg.solve,
    "rough": lambda W, C: solve(W, C) * (1.0 + 1e-4 * np.random.default_rng(0).normal(size=C.shape)),
    "nothing": lambda W, C: np.zeros_like(C),
    "wrong": lambda W, C: -3.0 * C,
}


@every_product
@pytest.mark.parametrize("solver", SOLVERS)
def test_a_step_is_between_its_bounds(solver: str, product: Product, monkeypatch: pytest.MonkeyPatch) -> None:
    """J_11 + J_12 W^-1 J_21, whoever solved for it, and its raised and lowered floats on their sides of it."""
    monkeypatch.setattr(float64, "product", product)
    monkeypatch.setattr(np.linalg, "solve", SOLVERS[solver])
    rng = np.random.default_rng(0)
    for nw in (1, 2, 5):
        J = random_joint(rng, 3, nw)
        W = J[:, 3:, 3:] + 0.1 * np.eye(nw)
        least = np.array([bounded_below(known(W_s), W_s.diagonal())[1] for W_s in W])
        found = quotient(J, W, least)
        assert found is not None
        for s, exact in enumerate(map(exact_quotient, J, W)):
            assert holds(Bounded(found.middle[s], found.spread[s]), exact)
            upper, lower = (rational.exact(raised(found, up=up)[s]) for up in (True, False))
            assert positive_definite(rational.plus(upper, exact, -1))
            assert positive_definite(rational.plus(exact, lower, -1))


def test_a_step_without_its_rounding_is_not_between_its_bounds(monkeypatch: pytest.MonkeyPatch) -> None:
    """So that the test above means something: nothing but the bound of what solving left over is not enough."""
    monkeypatch.setattr(float64, "product", worst(0))
    J = random_joint(np.random.default_rng(1), 3, 1)
    W = J[:, 3:, 3:] + 0.1
    monkeypatch.setattr(float64, "relative", lambda roundings: 0.0)
    found = quotient(J, W, W[:, 0, 0])
    assert found is not None
    assert not holds(Bounded(found.middle[0], found.spread[0]), exact_quotient(J[0], W[0]))


def test_a_difference_is_between_its_bounds() -> None:
    """Also where it cancels, and where what is subtracted from was rounded twice."""
    rng = np.random.default_rng(2)
    for _ in range(20):
        P, B = (float64.symmetric(rng.normal(size=(4, 4))) for _ in range(2))
        g = float(rng.uniform(0.1, 10.0))
        B = g * P + 1e-9 * B if rng.uniform() < 0.5 else B
        found = difference(g * P, known(B))
        exact_gP = [[Fraction(g) * entry for entry in row] for row in rational.exact(P)]
        assert holds(found, rational.plus(exact_gP, rational.exact(B), -1))


@pytest.mark.parametrize("gamma", [1.0, 0.1, 1e-150, 1e150, 0.24532648287057810, 3.0 - 2.0**-51])
def test_a_square_is_rounded_to_its_side(gamma: float) -> None:
    exact, below, above = Fraction(gamma) ** 2, square(gamma, up=True), square(gamma, up=False)
    assert Fraction(below) <= exact <= Fraction(above)
    assert above <= np.nextafter(below, np.inf)


# range
@pytest.mark.filterwarnings("ignore:invalid value")
@pytest.mark.parametrize("scale", [2.0**101, 2.0**-101, np.inf, np.nan])
def test_out_of_range_nothing_is_decided(scale: float) -> None:
    """Above 2^100 and below 2^-100, where overflow and underflow are no longer outweighed; and what is no number."""
    for S in (np.eye(3), -np.eye(3)):
        assert sign(known(np.where(S != 0.0, S * scale, 0.0)), np.full(3, scale)) == float64.UNDECIDED
    J = np.eye(3)[None]
    assert quotient(J, scale * np.eye(1)[None], np.ones(1)) is None or scale == 2.0**-101
    assert quotient(J, np.eye(1)[None], np.array([scale])) is None or scale in (2.0**101, np.inf)


def test_what_may_have_been_flushed_is_outweighed() -> None:
    """A spread holds 2^-500 in the units of the matrix, and a matrix smaller than that has no sign."""
    tiny = np.diag([1.0, 2.0**-480])
    assert difference(tiny, known(np.zeros((2, 2)))).spread.min() >= TINY
    for size, proved in ((1.0, True), (2.0**-60, True), (2.0**-99, True)):
        assert sign(known(size * np.eye(2)), np.full(2, size)).proved is proved
    assert relative(LARGEST_TERMS) < 0.01
    assert float64.within(np.full(2, LARGEST))
    assert not float64.within(np.full(2, 1.01 * LARGEST))


LARGEST_TERMS = 10**6
