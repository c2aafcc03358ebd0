"""Gains to start from: their sparsity, that they are unbiased, and that no node has a better choice."""

from __future__ import annotations

import numpy as np
import pytest
from networks import random_problem, real_networks

from agent.contract.arrays import Array
from designer.gain.exact import Operator
from designer.model.error_model import error_model
from designer.search.entries import Entries
from designer.search.starts import consensus_gains, least_variance_gains


def test_consensus_gains_leave_the_estimates_unbiased() -> None:
    """Every row of K_bar shares out A."""
    problem = random_problem(5)
    K_bar, _ = consensus_gains(problem, weight=0.3)
    ones = np.tile(np.eye(problem.nx), (problem.n, 1))
    np.testing.assert_allclose(K_bar @ ones, np.tile(problem.plant.A, (2, problem.n, 1)), atol=1e-14)


@pytest.mark.parametrize("kind", sorted(real_networks(4)))
def test_both_starts_keep_to_the_entries_and_are_unbiased_where_asked(kind: str) -> None:
    """Nothing is lost by packing them, weights other than 1 included, and the file takes them."""
    problem = real_networks(4)[kind]
    entries, ones = Entries(problem), np.tile(np.eye(problem.nx), (problem.n, 1))
    for K_bar, H_bar in (consensus_gains(problem, weight=0.3), least_variance_gains(problem)):
        for stacked, back in zip((K_bar, H_bar), entries.unpack(entries.pack(K_bar, H_bar)), strict=True):
            np.testing.assert_allclose(stacked, back, atol=1e-12)
        if problem.unbiased:
            np.testing.assert_allclose(K_bar @ ones, np.tile(problem.plant.A, (2, problem.n, 1)), atol=1e-12)


@pytest.mark.parametrize("kind", sorted(real_networks(5)))
def test_gains_of_least_variance_leave_each_node_no_better_choice(kind: str) -> None:
    """E|e_i|^2 of every node under white w, where it has settled, rises with any change of that node's own gains."""
    problem = real_networks(5)[kind]
    K_bar, H_bar = least_variance_gains(problem)
    entries, rng = Entries(problem), np.random.default_rng(0)
    v = entries.pack(K_bar, H_bar)
    operator, X = Operator(error_model(problem, K_bar, H_bar)), None
    nx, p, w = problem.nx, operator.p, np.eye(problem.nw)
    occupied = np.linalg.matrix_power(problem.markov.transition, 10_000)[0]
    joint = np.zeros((2, operator.size + operator.nw, operator.size + operator.nw))
    joint[:, operator.size :, operator.size :] = occupied[:, None, None] * w
    for _ in range(400):
        X = operator.carry(joint)
        joint[:, : operator.size, : operator.size] = X

    def variances(gains: tuple[Array, Array]) -> Array:
        X = Operator(error_model(problem, *gains)).carry(joint).sum(axis=0)
        return np.diag(X)[p:].reshape(problem.n, nx).sum(axis=1)

    least = variances((K_bar, H_bar))
    for _ in range(10):
        other = variances(entries.unpack(v + 0.1 * rng.normal(size=len(v))))
        assert (other > least * (1.0 - 1e-3)).all()
