"""What gamma alone does not say: each node's own gain, and how both are told."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from networks import random_problem, real_networks

from designer import beyond_gamma as module
from designer.beyond_gamma import beyond_gamma, told
from designer.gain.exact import Operator, exact_gain, node_gains
from designer.model.error_model import error_model, link_gains
from designer.search.starts import ignoring, least_variance_gains


@pytest.mark.parametrize("kind", sorted(real_networks(7)))
def test_a_nodes_gain_is_that_of_its_rows_of_m(kind: str) -> None:
    """And of no other's; together they are no less than the gain of all."""
    problem = real_networks(7)[kind]
    model = error_model(problem, *least_variance_gains(problem))
    found = node_gains(model)
    assert found is not None
    for (low, high), M in zip(found, np.split(model.M, problem.n), strict=True):
        alone = exact_gain(replace(model, M=M))
        assert low <= alone.high
        assert alone.low <= high
        assert high == pytest.approx(low, rel=1e-4)
    assert exact_gain(model).low <= np.linalg.norm([high for _, high in found])


def test_it_is_told_node_by_node(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same facts as text and as JSON; of many nodes those with most noise."""
    problem = random_problem(2)
    facts = beyond_gamma(problem, *link_gains(problem, *least_variance_gains(problem))).document()
    json.dumps(facts, allow_nan=False)
    noise = facts["white_noise"]
    assert noise["mean_square"] == pytest.approx(sum(noise["nodes"].values()))
    assert len(told(facts)) == 1 + problem.n
    low, high = facts["node_gains"]["n1"]
    shown = float(told(facts)[2].split("exact gain ")[1].split(",")[0])
    assert high <= shown < 1.001 * low
    assert f"E|z - z^|^2 = {noise['nodes']['n1']:.6g}; computed" in told(facts)[2]
    monkeypatch.setattr(module, "_FEW", 1)
    worst = max(noise["nodes"], key=lambda name: noise["nodes"][name])
    assert f"node {worst}" in told(facts)[1]
    assert told(facts)[2:] == ["  and 2 nodes with less noise: --json has all"]


@pytest.mark.parametrize(
    ("low", "high", "said"),
    [
        (63.99, 64.0148, "64.02"),  # no digit that the other end denies
        (1.0, 1.0, "1"),
        (0.043824, 0.043828, "0.04383"),
        (0.5, 0.75, "between 0.5 and 0.75"),
        (0.123456, 2000001.0, "between 0.1234 and 2.001e+6"),
    ],
)
def test_no_more_digits_of_a_gain_are_told_than_are_known(low: float, high: float, said: str) -> None:
    problem = random_problem(2)
    facts = beyond_gamma(problem, *link_gains(problem, *least_variance_gains(problem))).document()
    facts["node_gains"]["n1"] = [low, high]
    assert f"node n1  exact gain {said}, E|z" in told(facts)[2]


def test_large_networks_and_errors_that_grow_go_without(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = random_problem(3)
    monkeypatch.setattr(module, "_FEW_STATES", 1)
    assert beyond_gamma(problem, *link_gains(problem, *least_variance_gains(problem))).gains is not None
    operator = Operator(error_model(problem, *least_variance_gains(problem)))
    numbers = problem.n * operator.MM.size  # as many are few enough only if errors decay at once
    monkeypatch.setattr(module, "_MOST_OF_NODES", 1.01 * numbers)
    small = beyond_gamma(problem, *link_gains(problem, *least_variance_gains(problem)))
    assert small.gains is None
    assert told(small.document())[-1].startswith("  the exact gain of each node is not sought: with more than")
    monkeypatch.setattr(module, "_MOST_OF_NOISE", 1)
    large = beyond_gamma(problem, *link_gains(problem, *least_variance_gains(problem)))
    assert large.noise is None
    assert told(large.document())[0].endswith(" is not sought of more than 1 states n nx, nor is each node's gain")
    monkeypatch.undo()
    K_bar, H_bar = ignoring(problem)
    grows = beyond_gamma(problem, *link_gains(problem, 3.0 * K_bar, H_bar))
    assert (grows.noise, grows.gains) == (None, None)
    assert told(grows.document()) == ["noise      what white w leaves in the steady state was not found"]
