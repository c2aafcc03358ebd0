"""An initial error: what it adds to the guarantee, against simulated runs, moments, and by hand."""

from __future__ import annotations

import math
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from made_recordings import uncertified

from agent.contract.gains import Gains
from agent.contract.problem import Problem
from agent.roles.plant import SimulatedPlant
from designer.cli import main
from designer.ledger.account import account
from designer.model.error_model import error_model, initial_eta, link_gains, realised
from designer.problems import find
from designer.search.starts import least_variance_gains
from designer.simulation import network_of, simulate, states
from designer.single_run import single_run
from designer.start import from_start, left_by_start, told, value_of
from designer.synthesis import design

PENDULUM, LOSSY = find("inverted-pendulum"), find("zhu2020-lossy")


def begun(problem: Problem, *error: float) -> Problem:
    return problem.with_(name="begun", plant={"initial_error": list(error)}, disturbance={"kind": "none"})


@pytest.fixture(scope="module")
def gains() -> Gains:
    """Two states, seen losses, lossy links, an unstable plant."""
    return design(begun(PENDULUM, 0.1, 0.3))


def test_what_is_left_of_it_is_what_moments_of_all_outcomes_leave(gains: Gains) -> None:
    """At each corner second moments are carried forward, in one mode after the other; the largest is what is said."""
    problem, largest = gains.problem, 0.0
    network = network_of(gains, steps=25)
    said = left_by_start(problem, gains.K, gains.H)
    assert said is not None
    for sign in (1.0, -1.0):
        corner = problem.with_(plant={"initial_error": [0.1, sign * 0.3]})
        file = uncertified(corner, gains.K, gains.H, method="given")
        squares = [
            ((state.e.reshape(4000, -1, problem.nx) @ network.M.T) ** 2).sum(axis=(1, 2)).mean()
            for state in states(network_of(file, steps=25), range(4000), steps=25)
        ]
        largest = max(largest, max(squares))
    assert math.sqrt(largest) == pytest.approx(said, rel=0.05)


def test_where_a_corner_is_worse_than_the_given_one_it_counts() -> None:
    """x_1 + x_2 is watched by nobody, so [1, 1] leaves more than [1, -1]: both are within |x_j| <= 1."""
    problem = Problem.from_arrays(
        "sums",
        A=[[0.5, 0.0], [0.0, 0.5]],
        B=[[0.1], [0.1]],
        M=[[1.0, 1.0]],
        C={"a": [[1.0, -1.0]]},
        D={"a": [[0.1]]},
        adjacency={"on": [[1.0]]},
    ).with_(plant={"initial_error": [1.0, -1.0]})
    K, H = {"on": {"a": {"a": np.diag([0.5, 0.5])}}}, {"on": {"a": {"a": np.zeros((2, 1))}}}
    assert left_by_start(problem, K, H) == pytest.approx(2.0, rel=1e-8)
    P = np.array([[[1.0, 0.25, 0.0, 0.0], [0.25, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]])
    assert value_of(problem, P) == math.nextafter(4.5, math.inf)


def test_the_bound_of_17_and_18_holds_for_the_mean_over_runs(gains: Gains) -> None:
    """From the worst corner, and it is proved; the bound of Minkowski, by the smaller gamma, holds too."""
    start = from_start(gains.problem, gains.K, gains.H)
    assert start is not None
    assert start.alone is not None
    assert start.gamma_P is not None
    assert start.V is not None
    ensemble = simulate(gains, runs=200, steps=20)
    assert ensemble.start == start.alone
    assert ensemble.refuted_at is None
    assert ensemble.mean.max() <= start.gamma_P**2 * start.V
    assert ensemble.mean.max() <= ensemble.bound.max() * (1.0 + 1e-12)
    assert "proved by (17) and (18)" in "\n".join(told(start.document()))


def test_a_bound_that_forgets_the_start_is_refuted(gains: Gains) -> None:
    """Nothing disturbs the plant, so without the start the bound would be 0."""
    ensemble = simulate(gains, runs=50, steps=5)
    assert (ensemble.least > 0.0).any()
    assert ensemble.energy.max() == 0.0


def test_simulate_calls_the_bound_what_it_is(gains: Gains, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """With a start it is not gamma^2 energy, and the root of mean over energy is no gain."""
    path = tmp_path / "gains.json"
    impulse = gains.problem.with_(disturbance={"kind": "impulse"})
    for problem, start in ((impulse, True), (impulse.with_(plant={"initial_error": None}), False)):
        uncertified(problem, gains.K, gains.H, method="given").save(path, force=True)
        assert main(["simulate", str(path), "--runs", "20", "--steps", "5", "--processes", "1"]) == 0
        said = capsys.readouterr().out
        assert ("(gamma sqrt(energy) + start)^2" in said) is start
        assert ("gamma^2 energy" in said) is not start
        assert ("the root of mean over energy" in said) is not start


def test_the_value_of_the_start_is_exact(gains: Gains) -> None:
    known = single_run(gains)
    assert known is not None
    P = known.P
    problem, s = gains.problem, gains.problem.mode_index(gains.problem.markov.initial)
    for sign in (1, -1):
        eta = np.tile([Fraction(0.1), sign * Fraction(0.3)], problem.n + (1 if problem.plant_states else 0))
        exact = sum(
            a * b * Fraction(float(p)) for a, row in zip(eta, P[s], strict=True) for b, p in zip(eta, row, strict=True)
        )
        assert exact <= Fraction(value_of(problem, P))


def test_the_plant_begins_there_and_the_model_with_it() -> None:
    problem = begun(LOSSY, *[0.5] * LOSSY.nx)
    state, _ = SimulatedPlant(problem, seed=0).advance(0)
    assert state.x == problem.initial_error.tolist()
    K_bar, H_bar = least_variance_gains(problem)
    eta = initial_eta(problem)
    following = realised(error_model(problem, K_bar, H_bar), 0, np.ones(problem.n)) @ np.append(eta, 0.0)
    assert following[: problem.nx] == pytest.approx(problem.plant.A @ problem.initial_error)


def test_the_ledger_owes_what_the_start_leaves(gains: Gains) -> None:
    """At first all of it, later nothing."""
    whole = account(gains, steps=1, faults={})
    (owed,) = whole.last.owed
    assert owed.what == "the initial error"
    corner = math.sqrt(sum(weight**2 for weight in gains.problem.weights)) * abs(gains.problem.plant.M @ [0.1, 0.3])[0]
    assert owed.size == pytest.approx(corner, rel=1e-9)
    assert account(gains, steps=400, faults={}).last.owed == ()


def test_a_problem_without_one_says_nothing_of_it() -> None:
    K, H = link_gains(LOSSY, *least_variance_gains(LOSSY))
    assert from_start(LOSSY, K, H) is None
    assert told(None) == []
    assert begun(LOSSY, *[0.0] * LOSSY.nx).plant.initial_error is None
