"""The steady state under white noise: against simulated runs, by hand, and where there is none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_recordings import uncertified
from networks import random_problem, real_networks

from agent.contract.arrays import Array
from agent.contract.problem import Problem
from designer import decay
from designer.gain import noise
from designer.gain.noise import SteadyState, long_run, steady_state
from designer.model.error_model import StackedGains, error_model, link_gains
from designer.problems import find
from designer.search.starts import consensus_gains, ignoring, least_variance_gains
from designer.simulation import network_of, states

RUNS, STEPS, LAST = 600, 60, 20


def of(problem: Problem, gains: StackedGains) -> SteadyState:
    found = steady_state(error_model(problem, *gains), initial=problem.mode_index(problem.markov.initial))
    assert found is not None
    return found


def simulated(problem: Problem, gains: StackedGains) -> tuple[Array, Array]:
    """The mean of |weight (z - z_hat_i)|^2 over runs and the last steps, (n,), and the deviation of that mean."""
    document = problem.document() | {"disturbance": {"kind": "white", "deviation": 1.0}}
    file = uncertified(Problem.from_document(document), *link_gains(problem, *gains), method="given")
    network = network_of(file, steps=STEPS)
    squares = (
        np.array(
            [
                ((state.e.reshape(RUNS, problem.n, problem.nx) @ problem.plant.M.T) ** 2).sum(axis=2)
                for state in states(network, range(RUNS), steps=STEPS)
            ]
        )[-LAST:].mean(axis=0)
        * problem.weights**2
    )  # (runs, n)
    return squares.mean(axis=0), squares.std(axis=0) / np.sqrt(RUNS)


@pytest.mark.parametrize("kind", sorted(real_networks(4)))
def test_it_is_what_runs_come_to(kind: str) -> None:
    """Every node's mean square, within four deviations of the mean over runs, whatever real networks have."""
    problem = real_networks(4)[kind]
    gains = least_variance_gains(problem)
    mean, deviation = simulated(problem, gains)
    assert (np.abs(of(problem, gains).nodes - mean) < 4.0 * deviation).all()


def test_runs_would_show_what_losses_add() -> None:
    """So that the test above means something: without the variance of the losses it fails."""
    problem = random_problem(4)
    gains = least_variance_gains(problem)
    model = error_model(problem, *gains)
    mean, deviation = simulated(problem, gains)
    without = steady_state(replace(model, alpha=np.zeros_like(model.alpha)), initial=0)
    assert without is not None
    assert (np.abs(without.nodes - mean) > 4.0 * deviation).any()


@pytest.mark.parametrize(
    ("name", "gains", "known"),
    [
        ("zhu2020-lossy", least_variance_gains, 0.0275),
        ("zhu2020-lossy", consensus_gains, 0.0632),
        ("inverted-pendulum", least_variance_gains, 0.801),
    ],
)  # fmt: skip
def test_known_values(name: str, gains: object, known: float) -> None:
    """As an iteration of the covariance found them, which shares no solution with this."""
    assert callable(gains)
    problem = find(name)
    assert of(problem, gains(problem)).total == pytest.approx(known, rel=2e-3)


@pytest.mark.parametrize("a", [0.5, 0.999, 0.99999])
def test_by_hand_and_near_radius_one(a: float) -> None:
    """Who ignores all measurements has the variance of the plant, b^2 / (1 - a^2) for every node."""
    document = find("two-nodes").document()
    document["plant"] |= {"A": [[a]], "B": [[2.0] + [0.0] * (find("two-nodes").nw - 1)], "M": [[3.0]]}
    problem = Problem.from_document(document)
    found = of(problem, ignoring(problem))
    np.testing.assert_allclose(found.nodes, 36.0 / (1.0 - a * a), rtol=1e-9)
    assert found.error < noise.SETTLED


def test_large_networks_are_solved_without_a_matrix(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = random_problem(6)
    gains = least_variance_gains(problem)
    small = of(problem, gains)
    monkeypatch.setattr(decay, "DENSE", 1)
    large = of(problem, gains)
    np.testing.assert_allclose(large.nodes, small.nodes, rtol=1e-8)
    assert large.error < noise.SETTLED


def test_what_is_not_settled_is_not_stated(monkeypatch: pytest.MonkeyPatch) -> None:
    """The error is told from what is left of the equation, and it bounds the true one."""
    problem = random_problem(6)
    gains = least_variance_gains(problem)
    model, true = error_model(problem, *gains), of(problem, gains)
    exact = noise.solution
    monkeypatch.setattr(noise, "solution", lambda L, right: exact(L, right * (1.0 - 1e-3)))
    assert steady_state(model, initial=0) is None
    monkeypatch.setattr(noise, "SETTLED", 1.0)
    off = of(problem, gains)
    assert 0.99e-3 < 1.0 - off.total / true.total < off.error


def test_errors_that_grow_have_none() -> None:
    problem = random_problem(3)
    K_bar, H_bar = ignoring(problem)
    assert steady_state(error_model(problem, 3.0 * K_bar, H_bar), initial=0) is None


def test_how_often_a_chain_is_where() -> None:
    """With a period, with modes that are left for ever, and where it is caught depends on where it begins."""
    np.testing.assert_allclose(long_run(np.array([[0.0, 1.0], [1.0, 0.0]]), 0), [0.5, 0.5])
    chain = np.array([[0.0, 0.25, 0.75, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.9, 0.1], [0.0, 0.0, 0.3, 0.7]])
    np.testing.assert_allclose(long_run(chain, 0), [0.0, 0.25, 0.5625, 0.1875], atol=1e-12)
    np.testing.assert_allclose(long_run(chain, 1), [0.0, 1.0, 0.0, 0.0])


@pytest.mark.parametrize("seed", [1, 2, 3, 4])
def test_a_mean_square_below_0_is_no_answer(seed: int) -> None:
    """Where M cancels what moves alike, rounding is all that is left, of either sign."""
    document = random_problem(seed, n=2, nw=1, modes=1).document()
    document["plant"] |= {"A": [[0.5, 0.0], [0.0, 0.5]], "B": [[0.7], [0.7]], "M": [[1.0, -1.0000000001]]}
    problem = Problem.from_document(document)
    assert steady_state(error_model(problem, *consensus_gains(problem)), initial=0) is None
