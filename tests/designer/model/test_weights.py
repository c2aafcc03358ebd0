"""`weight`: how much a node's error counts in z_tilde, and in everything that is said of it."""

from __future__ import annotations

import numpy as np
import pytest
from made_recordings import uncertified

from agent.contract.problem import Problem
from designer.beyond_gamma import beyond_gamma
from designer.gain.exact import exact_gain
from designer.model.error_model import error_model, link_gains
from designer.problems import find
from designer.proof.certificate import verify
from designer.search.starts import least_variance_gains
from designer.simulation import simulate
from designer.synthesis import design

LOSSY = find("zhu2020-lossy")


def weighing(**weights: float) -> Problem:
    return LOSSY.with_(node={name[1:]: {"weight": weight} for name, weight in weights.items()})


def test_twice_the_weight_of_all_is_twice_the_gain() -> None:
    gains = least_variance_gains(LOSSY)
    doubled = weighing(_1=2.0, _2=2.0, _3=2.0, _4=2.0)
    gain, twice = (exact_gain(error_model(problem, *gains)) for problem in (LOSSY, doubled))
    assert (twice.low, twice.high) == (2.0 * gain.low, 2.0 * gain.high)


def test_a_weight_of_1_is_none_and_changes_no_digest() -> None:
    assert weighing(_3=1.0).digest() == LOSSY.digest()
    assert weighing(_3=0.5).digest() != LOSSY.digest()


@pytest.mark.parametrize("method", ["exact", "theorem2", "decomposed"])
def test_of_a_node_that_counts_less_less_is_asked(method: str) -> None:
    """Node 3 is the bad one of the paper's network: the others are served better where it does not lead."""
    less = weighing(_3=0.1)
    gains, before = design(less, method=method), design(LOSSY, method=method)
    assert verify(gains).holds
    assert gains.certificate.gamma < before.certificate.gamma
    others = [
        np.array(found.gains)[[0, 1, 3], 1].max()
        for found in (beyond_gamma(LOSSY, file.K, file.H) for file in (gains, before))
        if found.gains is not None
    ]
    assert len(others) == 2
    assert others[0] < others[1]


def test_what_is_told_of_each_node_is_of_its_error_itself() -> None:
    K, H = link_gains(LOSSY, *least_variance_gains(LOSSY))
    plain, weighed = (beyond_gamma(problem, K, H).document() for problem in (LOSSY, weighing(_3=0.1)))
    for name in LOSSY.node_names:
        assert weighed["node_gains"][name] == pytest.approx(plain["node_gains"][name], rel=1e-4)
        assert weighed["white_noise"]["nodes"][name] == pytest.approx(plain["white_noise"]["nodes"][name], rel=1e-9)
    nodes = weighed["white_noise"]["nodes"]
    total = sum((0.1 if name == "3" else 1.0) ** 2 * noise for name, noise in nodes.items())
    assert weighed["white_noise"]["mean_square"] == pytest.approx(total, rel=1e-12)


def test_simulated_runs_count_it_too() -> None:
    K, H = link_gains(LOSSY, *least_variance_gains(LOSSY))
    noisy = {"kind": "white", "deviation": 1.0}
    plain, halved = (
        simulate(uncertified(problem.with_(disturbance=noisy), K, H, method="given"), runs=20, steps=30)
        for problem in (LOSSY, weighing(_1=0.5, _2=0.5, _3=0.5, _4=0.5))
    )
    np.testing.assert_allclose(halved.mean, plain.mean / 4.0, rtol=1e-12)
