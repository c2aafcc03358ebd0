"""Where errors decay slowly: what is beyond a threshold grows, and what is below it dies out."""

from __future__ import annotations

import math

import numpy as np
import pytest

from agent.contract.problem import Problem
from designer.decay import decay
from designer.gain.exact import InvariantSet, Operator, exact_gain, recursion_holds, step
from designer.invariants import Threshold, invariants
from designer.model.error_model import error_model
from designer.search.starts import least_variance_gains


def oscillating(*modes: tuple[float, float], nodes: int, seed: int) -> Problem:
    """Plants that turn by an angle in each step and hardly decay, in random coordinates; hidden losses."""
    rng, nx = np.random.default_rng(seed), 2 * len(modes)
    A = np.zeros((nx, nx))
    for i, (radius, angle) in enumerate(modes):
        turn = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
        A[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = radius * np.array(turn)
    T = np.linalg.qr(rng.normal(size=(nx, nx)))[0] @ np.diag(rng.uniform(0.5, 2.0, nx))
    nw = 2 + (nodes if nodes > 2 else 0)
    plant = {"A": T @ A @ np.linalg.inv(T), "B": rng.normal(size=(nx, nw)), "M": rng.normal(size=(1, nx))}
    names = [f"n{i}" for i in range(nodes)]
    of_nodes = [
        {
            "name": name,
            "C": rng.normal(size=(1, nx)).tolist(),
            "D": rng.normal(size=(1, nw)).tolist(),
            "arrival_probability": float(rng.choice([0.5, 0.7, 0.9])),
        }
        for name in names
    ]
    adjacency = (rng.random((nodes, nodes)) < 0.5) * 1.0
    np.fill_diagonal(adjacency, 1.0)
    return Problem.from_document(
        {
            "name": "oscillating",
            "plant": {name: matrix.tolist() for name, matrix in plant.items()},
            "node": of_nodes,
            "topology": [{"name": "t", "adjacency": adjacency.tolist()}],
            "markov": {"transition": [[1.0]], "initial": "t"},
        }
    )


def known(problem: Problem) -> tuple[Operator, list[Threshold]]:
    operator = Operator(error_model(problem, *least_variance_gains(problem)))
    decays = decay(operator.corner, len(operator.MM), operator.units)
    return operator, invariants(operator.of, decays, operator.units, np.asarray(operator.MM)).thresholds


def passed(operator: Operator, threshold: Threshold, g: float, steps: int) -> bool:
    """Whether any Y of so many steps is beyond it."""
    Y = np.asarray(operator.MM)
    for _ in range(steps):
        taken = step(operator, Y, g)
        if taken is None or threshold.passed(taken.Y, g):
            return True
        Y = taken.Y
    return False


@pytest.mark.parametrize("modes", [[(0.999, 0.3)], [(0.999, 0.2), (0.999, 1.1)]])
def test_a_threshold_is_a_fixed_point_whose_policy_lets_grow_what_is_slow(modes: list[tuple[float, float]]) -> None:
    operator, thresholds = known(oscillating(*modes, nodes=2, seed=2))
    slow = 2 * len(modes)
    P, growth = thresholds[-1].P, np.abs(np.linalg.eigvals(thresholds[-1].powers[0]))
    taken = step(operator, P, 1.0)
    assert taken is not None
    assert np.allclose(taken.Y, P, atol=1e-8 * np.abs(P).max())
    assert len(growth) == slow * (slow + 1) // 2
    assert np.allclose(growth, 0.999**-2, atol=1e-6)


def test_a_threshold_tells_early_on_either_side_of_the_gain() -> None:
    """With hidden losses, and a network that hears; a sweep to the end of each agrees."""
    operator, thresholds = known(oscillating((0.999, 0.3), nodes=2, seed=2))
    gain = exact_gain(operator.model)
    first = gain.P
    assert first is not None
    assert gain.high <= gain.low * (1.0 + 1e-6)
    for g, holds in ((gain.low**2 * (1.0 - 1e-3), False), (gain.high**2 * (1.0 + 1e-3), True)):
        assert passed(operator, thresholds[0], g, 300) is not holds
        assert recursion_holds(operator, g, 20_000, invariant=InvariantSet(first)).holds is holds


def test_growth_at_first_is_not_growth_for_ever_where_errors_are_slow_and_noisy() -> None:
    """What is beyond in a direction that grows slowly may be overtaken: the other part has to be followed."""
    problem = oscillating((0.999, 0.2), (0.9995, 0.21), nodes=3, seed=14)
    operator, thresholds = known(problem)
    assert thresholds
    assert not any(passed(operator, threshold, 53.0**2, 300) for threshold in thresholds)


def test_what_decays_fast_has_no_threshold() -> None:
    assert not known(oscillating((0.9, 0.3), nodes=2, seed=2))[1]
