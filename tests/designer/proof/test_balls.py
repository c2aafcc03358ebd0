"""Large matrices proved positive definite by a sparse Cholesky factor, and whatever floats say never a false one."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pytest
from flint import arb, arb_mat, ctx
from lies import LIES

from agent.contract.arrays import Array
from designer.proof import balls
from designer.proof.balls import blocks, by_cholesky, by_eigenvectors, exact, fronts, sign

ORDER = 60


@pytest.fixture(autouse=True)
def bits() -> Iterator[None]:
    with ctx.workprec(128):
        yield


def banded_with_arrow(order: int, seed: int) -> Array:
    """A graph as those of (17): every vertex joined with its neighbours, and with the first, which is joined with all.

    Its weighted Laplacian has integer entries, row sums 0 and, as the graph is connected, rank order - 1 exactly.
    """
    rng = np.random.default_rng(seed)
    weights = np.triu(rng.integers(1, 9, size=(order, order)), 1).astype(float)
    weights[1:, 4:] *= np.tri(order - 1, order - 4, 3).astype(bool)
    weights[rng.uniform(size=(order, order)) < 0.3] = 0.0
    weights[0, 1:] = rng.integers(1, 9, size=order - 1)
    weights += weights.T
    return np.asarray(np.diag(weights.sum(axis=1)) - weights)


def shifted(order: int, seed: int, epsilon: float) -> tuple[arb_mat, Array]:
    """Such a Laplacian with epsilon added to one diagonal entry: its determinant has the sign of epsilon, exactly."""
    laplacian = banded_with_arrow(order, seed)
    S, at = exact(laplacian), int(np.random.default_rng(seed).integers(order))
    S[at, at] = S[at, at] + arb(epsilon)
    assert S[at, at].is_exact()
    return S, laplacian.diagonal()


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(("power", "by"), [(-1, by_cholesky), (-20, by_cholesky), (-60, by_eigenvectors)])
def test_the_sign_of_sparse_matrices_is_the_exact_one(
    power: int, by: Callable[[arb_mat, Array], balls.Sign], seed: int
) -> None:
    """Far from singular, near, and nearer than floats resolve; Cholesky's least eigenvalue is that of eigenvectors."""
    positive, sizes = shifted(ORDER, seed, 2.0**power)
    found = by(positive, sizes)
    assert found.proved
    assert not found.refuted
    assert sign(positive, sizes).proved
    assert found.least == pytest.approx(by_eigenvectors(positive, sizes).least, rel=1e-2)
    negative = sign(shifted(ORDER, seed, -(2.0**power))[0], sizes)
    assert negative.refuted
    assert not negative.proved
    assert negative.least < 0.0


@pytest.mark.parametrize("seed", range(5))
def test_a_sparse_singular_matrix_has_neither_sign(seed: int) -> None:
    found = sign(*shifted(ORDER, seed, 0.0))
    assert not found.proved
    assert not found.refuted


def test_units_do_not_matter() -> None:
    """Rows and columns scaled by up to 1e12 either way are proved by Cholesky too, with the same least eigenvalue."""
    S, sizes = shifted(ORDER, 0, 0.5)
    units = np.exp2(2.0 * np.random.default_rng(0).integers(-20, 21, size=ORDER))
    scaled = exact(np.diag(units)) * S * exact(np.diag(units))
    found = by_cholesky(scaled, sizes * units**2)
    assert found.proved
    assert found.least == pytest.approx(by_cholesky(S, sizes).least, rel=1e-6)


@pytest.mark.parametrize("place", [(0, 0), (3, 4), (2, ORDER - 1)])
def test_radii_count_where_floats_see_a_zero_too(place: tuple[int, int]) -> None:
    """A ball that holds a matrix that is not positive definite is not proved, whichever entry is uncertain."""
    i, j = place
    for radius, proved in ((1e-3, True), (1.001, False)):
        S = balls.identity(ORDER)
        S[i, j] = S[j, i] = S[i, j] + arb(0, radius)
        assert by_cholesky(S, np.ones(ORDER)).proved is proved
        assert sign(S, np.ones(ORDER)).proved is proved


def believe(monkeypatch: pytest.MonkeyPatch, lie: str) -> None:
    """Floats that find every matrix positive definite, and give something else for its factor."""
    monkeypatch.setattr(np.linalg, "eigvalsh", lambda S: np.ones(len(S)))
    monkeypatch.setattr(np.linalg, "cholesky", LIES[lie])


@pytest.mark.parametrize("epsilon", [0.0, -(2.0**-60), -(2.0**-20), -1.0])
@pytest.mark.parametrize("lie", LIES)
def test_no_lie_of_floats_proves_what_is_false(lie: str, epsilon: float, monkeypatch: pytest.MonkeyPatch) -> None:
    S, sizes = shifted(ORDER, 1, epsilon)
    believe(monkeypatch, lie)
    assert not by_cholesky(S, sizes).proved


def without_off_diagonals(entries: balls.Entries, d: Array) -> bool:
    return all(entries[i, i] > 0 for i in range(len(d)))


def without_gershgorin(entries: balls.Entries, d: Array) -> bool:
    return True


@pytest.mark.parametrize("mutant", [without_off_diagonals, without_gershgorin])
def test_what_refuses_a_lie_is_that_the_rest_must_be_dominant(
    mutant: Callable[[balls.Entries, Array], bool], monkeypatch: pytest.MonkeyPatch
) -> None:
    S, sizes = shifted(ORDER, 1, -1.0)
    believe(monkeypatch, "nothing")
    monkeypatch.setattr(balls, "dominant", mutant)
    assert by_cholesky(S, sizes).proved


def test_what_refuses_a_wide_ball_is_its_radius(monkeypatch: pytest.MonkeyPatch) -> None:
    S = balls.identity(ORDER)
    S[2, 9] = S[9, 2] = arb(0, 1.001)
    assert not by_cholesky(S, np.ones(ORDER)).proved
    nonzero = balls.nonzero
    monkeypatch.setattr(balls, "nonzero", lambda matrix: nonzero(matrix.mid()))
    assert by_cholesky(S, np.ones(ORDER)).proved


def test_a_matrix_that_is_only_weakly_dominant_is_not_dominant() -> None:
    """Such a one may be singular, and this one is; with less beside the diagonal it is dominant in these weights."""
    d = np.array([1.0, 0.5])
    for beside, dominant in ((2.0, False), (-2.0, False), (1.999, True), (-1.999, True)):
        entries = balls.nonzero(exact(np.array([[1.0, beside], [beside, 4.0]])))
        assert balls.dominant(entries, d) is dominant
    assert not balls.dominant({}, np.ones(1))


@pytest.mark.parametrize("density", [0.0, 0.02, 0.2, 1.0])
def test_every_index_is_eliminated_once_and_the_factor_is_zero_elsewhere(density: float) -> None:
    """What fronts leave out of a Cholesky factor is exactly 0, so nothing of LL' is lost."""
    rng = np.random.default_rng(3)
    S = np.where(rng.uniform(size=(ORDER, ORDER)) < density, rng.normal(size=(ORDER, ORDER)), 0.0)
    S = S + S.T + 100.0 * np.eye(ORDER)
    found = fronts(S != 0.0)
    order = [k for pivots, _ in found for k in pivots]
    assert sorted(order) == list(range(ORDER))
    L = np.zeros_like(S)
    L[np.ix_(order, order)] = np.linalg.cholesky(S[np.ix_(order, order)])
    for pivots, border in found:
        L[np.ix_([*pivots, *border], pivots)] = 0.0
    assert not L.any()


@pytest.mark.parametrize("lower", [False, True])
def test_blocks_are_joined_by_an_entry_on_either_side(lower: bool) -> None:
    """As in a P that is stored as a triangle: x'Px sees its symmetric part."""
    joined = np.eye(4, dtype=bool)
    joined[0, 2] = True
    assert blocks(joined.T if lower else joined) == [[0, 2], [1], [3]]


def test_a_network_is_eliminated_node_by_node() -> None:
    """The work grows with the nodes, not with their square: as many entries for each node of 100 as of 400."""
    work = {
        n: sum((len(pivots) + len(border)) ** 2 for pivots, border in fronts(banded_with_arrow(n, 5) != 0.0))
        for n in (100, 400)
    }
    assert work[400] < 5 * work[100]
