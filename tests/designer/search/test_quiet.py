"""The curve between peak and noise: what is asked for is kept, as proved, and both ends are those that are known."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from networks import random_problem

from agent.contract.errors import InputError
from agent.contract.gains import Gains
from agent.contract.problem import Problem
from designer.gain.noise import steady_state
from designer.model.error_model import StackedGains, error_model, stacked_gains
from designer.model.units import NaturalUnits
from designer.patience import Budget
from designer.problems import find
from designer.proof.certificate import verify
from designer.search import quiet
from designer.search.barrier import Barrier
from designer.search.descent import Progress
from designer.search.quiet import quieter
from designer.search.starts import least_variance_gains
from designer.synthesis import design

SLACKS = (0.005, 0.05, 1.0)


def noise_of(problem: Problem, gains: StackedGains) -> float:
    found = steady_state(error_model(problem, *gains), initial=problem.mode_index(problem.markov.initial))
    assert found is not None
    return found.total


@pytest.fixture(scope="module")
def pendulum() -> Gains:
    """An unstable plant, seen losses, lossy links, unbiased gains."""
    return design(find("inverted-pendulum"))


def test_gamma_as_proved_stays_within_the_slack_and_the_noise_falls(pendulum: Gains) -> None:
    gains = design(find("inverted-pendulum"), peak_slack=0.05)
    assert verify(gains).holds
    assert pendulum.certificate.gamma < gains.certificate.gamma <= 1.05 * pendulum.certificate.gamma
    noises = [noise_of(each.problem, stacked_gains(each)) for each in (gains, pendulum)]
    assert noises[0] < 0.6 * noises[1]
    assert gains.method == "exact, peak slack 5 %"
    assert f"from {noises[1]:.6g} to {noises[0]:.6g}" in gains.solver.status, "as computed in the problem's own units"


def test_the_more_slack_the_less_noise_down_to_below_gains_of_least_variance(pendulum: Gains) -> None:
    problem, gamma = pendulum.problem, pendulum.certificate.gamma
    found = [quieter(problem, stacked_gains(pendulum), (1.0 + slack) * gamma).gains for slack in SLACKS]
    assert all(more.noise < less.noise for less, more in pairwise(found))
    assert all(each.gamma <= (1.0 + slack) * gamma for slack, each in zip(SLACKS, found, strict=True))
    assert found[-1].noise <= noise_of(problem, least_variance_gains(problem))


def test_no_slack_is_the_design_by_exact(pendulum: Gains) -> None:
    gains = design(find("inverted-pendulum"), peak_slack=0.0)
    assert gains.method == "exact"
    assert gains.certificate == pendulum.certificate


def test_the_noise_of_a_long_horizon_is_that_of_the_steady_state() -> None:
    for seed in (1, 2):
        problem = random_problem(seed)
        gains = least_variance_gains(problem)
        barrier = Barrier(problem, 400)
        assert barrier.noise_of(barrier.entries.pack(*gains)) == pytest.approx(noise_of(problem, gains), rel=1e-9)


def test_a_horizon_that_does_not_see_the_noise_is_made_longer(monkeypatch: pytest.MonkeyPatch) -> None:
    """Errors that decay slowly: what 2 steps show is not what is asked for."""
    monkeypatch.setattr(quiet, "_HORIZON", 2)
    problem = NaturalUnits(find("zhu2020-lossy")).problem
    start = least_variance_gains(problem)
    horizons: set[int] = set()
    found = quieter(problem, start, 10.0, progress=lambda at: horizons.add(at.horizon))
    assert min(horizons) == 2
    assert max(horizons) > 2
    assert found.gains.noise < noise_of(problem, start)


@pytest.mark.parametrize("reason", ["interrupted", "out of time"])
def test_a_search_that_is_stopped_keeps_what_it_has(pendulum: Gains, reason: str) -> None:
    steps: list[Progress] = []
    budget = Budget(50.0 if reason == "out of time" else math.inf, clock=lambda: float(len(steps)))

    def stop(at: Progress) -> None:
        steps.append(at)
        if reason == "interrupted" and at.mu < 1e-2:
            raise KeyboardInterrupt

    gamma = 1.05 * pendulum.certificate.gamma
    found = quieter(pendulum.problem, stacked_gains(pendulum), gamma, budget=budget, progress=stop)
    assert found.ended == reason
    assert found.gains.gamma <= gamma
    assert found.gains.noise <= found.start.noise
    assert np.isfinite(found.gains.K_bar).all()


def test_ctrl_c_before_it_begins_ends_it_too() -> None:
    """Pressed in the search for the least gamma: no other one follows."""
    steps: list[Progress] = []

    def stop(at: Progress) -> None:
        if at.phase is None:
            steps.append(at)
            raise KeyboardInterrupt

    gains = design(find("two-nodes"), peak_slack=0.05, progress=stop)
    assert len(steps) == gains.solver.iterations == 1
    assert gains.solver.status.startswith("interrupted; E|z~|^2 under white w from ")


@pytest.mark.parametrize(
    ("method", "slack", "says"),
    [("theorem2", 0.1, "method theorem2 has none"), ("exact", -0.1, "0 or more"), ("exact", float("inf"), "0 or more")],
)
def test_a_slack_that_cannot_be_meant_is_refused(method: str, slack: float, says: str) -> None:
    with pytest.raises(InputError, match=says):
        design(find("zhu2020-lossy"), method=method, peak_slack=slack)
