"""Rows of our own are what scipy's sparse matrices are, and a proof by them is held to the same machine."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from places import GOLDEN
from scipy import sparse as theirs

from agent.contract.arrays import Array
from agent.contract.gains import Gains
from designer.proof import float_model, machine
from designer.proof.prover import FLOATS, Prover
from designer.proof.sparse import Rows, matrix


@pytest.fixture(autouse=True)
def anew() -> Iterator[None]:
    machine.fault.cache_clear()
    yield
    machine.fault.cache_clear()


def both(seed: int, shape: tuple[int, int], share: float) -> tuple[Rows, Any]:
    """Ours and theirs, of whole numbers, of which every sum is exact; some rows are empty, the last one too."""
    rng = np.random.default_rng(seed)
    filled = rng.random(shape) < share
    filled[[0, -1]] = False
    rows, columns = (places[order] for order in [rng.permutation(filled.sum())] for places in np.nonzero(filled))
    entries = rng.integers(1, 100, len(rows)).astype(float)
    return Rows.of(entries, rows, columns, shape), theirs.csr_array((entries, (rows, columns)), shape=shape)


@pytest.mark.parametrize("share", [0.0, 0.2, 1.0])
def test_they_multiply_alike(share: float) -> None:
    ours, scipys = both(1, (7, 5), share)
    at = np.array([6, 2, 2, 0, 3])
    rng = np.random.default_rng(2)
    for mine, other in ((ours, scipys), (ours.T.tocsr(), scipys.T.tocsr()), (ours[at], scipys[at])):
        assert (mine.nnz, mine.indptr.tolist()) == (other.nnz, other.indptr.tolist())
        for width in ((), (1,), (4,)):
            X = rng.integers(-50, 50, (other.shape[1], *width)).astype(float)
            assert np.array_equal(mine @ X, other @ X)


def certified(gamma: float) -> tuple[bool, Array]:
    """Whether this is proved of the golden gains, by a P that is found here; and P."""
    gains = Gains.load(GOLDEN / "zhu2020-lossy.gains.json")
    prover = Prover(gains.problem, gains.K, gains.H, makes=FLOATS)
    assert prover.P is not None
    return prover.exact(gamma).holds, prover.P


def test_a_proof_needs_no_scipy(monkeypatch: pytest.MonkeyPatch) -> None:
    """It comes to the same, whatever the order of the sums, and not to more."""
    with_scipy = certified(0.33)
    for module in (float_model, machine):
        monkeypatch.setattr(module, "matrix", Rows.of)
    machine.fault.cache_clear()
    without = certified(0.33)
    assert with_scipy[0]
    assert without[0]
    assert not certified(0.31)[0]
    assert without[1] == pytest.approx(with_scipy[1], rel=1e-9)


def test_rows_that_do_not_add_up_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    class Forgetful(Rows):
        def __matmul__(self, X: Array) -> Array:
            return super().__matmul__(X) - self.data[0] * X[self.indices[0]] * 1e-12

    monkeypatch.setattr(machine, "matrix", Forgetful.of)
    assert machine.fault(10) == "a sparse matrix product of order 10 is not as exact as a sum of rounded products"


def test_scipy_is_taken_where_it_is() -> None:
    assert isinstance(matrix(np.ones(1), np.zeros(1, int), np.zeros(1, int), (1, 1)), theirs.csr_array)
