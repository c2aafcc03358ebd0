"""The lower end of what decays slowly: many steps at once, by a w = Gamma eta that is held; never above the truth."""

from __future__ import annotations

import math

import numpy as np
import pytest
from flint import arb_mat, ctx
from networks import random_gains, random_problem, real_network

from agent.contract.problem import Problem
from designer.gain.exact import Operator, exact_gain, step
from designer.model.error_model import error_model, link_gains
from designer.proof import balls
from designer.proof.by_balls import ByBalls
from designer.proof.held_policies import Held, HeldPolicies
from designer.proof.prover import Prover
from designer.search.exact_design import confirmed, lower_end
from designer.search.starts import ignoring, least_variance_gains


def scalar(radius: float) -> Problem:
    """One state that two nodes do not look at: gamma^2 = 2 / (1 - radius^2)."""
    node = {"C": [[1.0]], "D": [[1.0]], "arrival_probability": 0.9}
    return Problem.from_document(
        {
            "name": "scalar",
            "plant": {"A": [[radius]], "B": [[1.0]], "M": [[1.0]]},
            "node": [{"name": name, **node} for name in "ab"],
            "topology": [{"name": "t", "hears": {}}],
            "markov": {"transition": [[1.0]], "initial": "t"},
        }
    )


def turning(*modes: tuple[float, float]) -> tuple[Problem, float]:
    """States that turn by an angle in each step and that two nodes do not look at; and the gain, of the gramian."""
    A, k = np.zeros((2 * len(modes), 2 * len(modes))), np.arange(2 * len(modes))
    for i, (radius, angle) in enumerate(modes):
        turn = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
        A[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = radius * np.array(turn)
    B, M = np.stack([1.0 + 0.3 * k, 1.0 - 0.5 * k], axis=1), (1.0 - 0.7 * k)[None]
    powers, gramian = A, B @ B.T
    for _ in range(30):
        gramian, powers = gramian + powers @ gramian @ powers.T, powers @ powers
    document = scalar(0.5).document() | {"plant": {"A": A.tolist(), "B": B.tolist(), "M": M.tolist()}}
    node = {"C": [(0.0 * k).tolist()], "D": [[1.0, 0.0]], "arrival_probability": 0.9}
    document["node"] = [{"name": name, **node} for name in "ab"]
    return Problem.from_document(document), math.sqrt(2.0 * float((M @ gramian @ M.T).item()))


@pytest.mark.parametrize("radius", [0.999, 0.99999, 0.9999999])
def test_what_is_known_by_hand_is_proved_at_any_radius(radius: float) -> None:
    problem = scalar(radius)
    prover, true = Prover(problem, *link_gains(problem, *ignoring(problem))), math.sqrt(2.0 / (1.0 - radius**2))
    assert prover.at_least(true * (1.0 - 3e-6)) is not None
    assert prover.at_least_by_leaps(true * (1.0 + 1e-6)) is None


def test_the_interval_of_a_slow_network_is_narrow() -> None:
    """A fast-sampled plant, hidden losses: both ends are proved."""
    document = random_problem(11, modes=1, n=2).document()
    A = np.array(document["plant"]["A"])
    document["plant"]["A"] = (A * 0.9999 / np.abs(np.linalg.eigvals(A)).max()).tolist()
    problem = Problem.from_document(document)
    K, H = link_gains(problem, *least_variance_gains(problem))
    gain = exact_gain(error_model(problem, *least_variance_gains(problem)))
    verdict, low = confirmed(problem, K, H, gain.high), lower_end(problem, K, H, gain)
    assert verdict.holds
    assert verdict.gamma * (1.0 - 1e-5) < low <= gain.high


@pytest.mark.parametrize("of", [[(0.9999, 0.01)], [(0.99999, 1.5)], [(0.999, 0.2), (0.999, 1.1)]])
def test_what_oscillates_slowly_is_proved_at_any_radius(of: list[tuple[float, float]]) -> None:
    """By a policy that is worst in every phase; of two at once too, though one step of w cannot move both as it likes.

    Nothing is proved of more than the gain.
    """
    problem, true = turning(*of)
    prover = Prover(problem, *link_gains(problem, *ignoring(problem)))
    assert prover.at_least_by_leaps(true * (1.0 - 1e-5)) is not None
    assert prover.at_least_by_leaps(true * (1.0 + 1e-6)) is None


@pytest.mark.parametrize("like", [False, True])
@pytest.mark.parametrize("steps", [1, 2, 64, 256])
def test_a_leap_is_below_as_many_steps(steps: int, like: bool) -> None:
    """And is what the policies lead to, step by step; for lossy links, seen losses and two modes; against any P."""
    problem = real_network(random_problem(11, n=2), seen=["n1"], delivery=0.7)
    K_bar, H_bar = random_gains(problem, seed=1)
    K_bar, H_bar = 0.4 * K_bar, 0.4 * H_bar
    operator, by = (
        Operator(error_model(problem, K_bar, H_bar)),
        ByBalls(problem, *link_gains(problem, K_bar, H_bar), bits=128),
    )
    gamma, n = 1.01 * exact_gain(operator.model).high, operator.size
    Y = by.start(up=False)
    for _ in range(3):
        Y = by.step(Y, gamma, up=False)[1] or Y
    true = np.array([balls.floats(Y_s) for Y_s in Y])
    other = 2.0 * true / gamma**2 if like else None
    leapt = by.leap(Y, gamma, steps, other)
    taken = step(operator, true if other is None else other, gamma**2 if other is None else 1.0)
    assert leapt is not None
    assert taken is not None
    held, Gamma = true, taken.Gamma
    for _ in range(steps):
        taken = step(operator, true, gamma**2)
        assert taken is not None
        true, S = taken.Y, operator.of(held)
        cross = S[:, :n, n:] @ Gamma
        held = (
            S[:, :n, :n]
            + cross
            + cross.swapaxes(1, 2)
            + Gamma.swapaxes(1, 2) @ (S[:, n:, n:] - gamma**2 * np.eye(operator.nw)) @ Gamma
        )
    found = np.array([balls.floats(Y_s) for Y_s in leapt])
    assert found == pytest.approx(held, rel=1e-9, abs=1e-9 * np.abs(held).max())
    assert np.linalg.eigvalsh(true - found).min() > -1e-9 * np.abs(true).max()


def test_a_disturbance_that_costs_nothing_would_prove_too_much(monkeypatch: pytest.MonkeyPatch) -> None:
    """So it is what w costs that keeps a leap below the truth."""
    problem = scalar(0.9999)
    prover, true = Prover(problem, *link_gains(problem, *ignoring(problem))), math.sqrt(2.0 / (1.0 - 0.9999**2))
    assert prover.at_least_by_leaps(1.01 * true) is None
    held = HeldPolicies.held

    def free(self: HeldPolicies, policies: list[arb_mat], gamma: float) -> Held:
        return held(self, policies, 0.0)

    monkeypatch.setattr(HeldPolicies, "held", free)
    assert prover.at_least_by_leaps(1.01 * true) is not None


def test_what_grows_too_far_for_floats_proves_nothing() -> None:
    """Its worst w is no number."""
    problem = scalar(0.9999)
    by = ByBalls(problem, *link_gains(problem, *ignoring(problem)), bits=128)
    with ctx.workprec(128):
        huge = [balls.exact(np.full((3, 3), 1e300)) * balls.arb(1e300)]
    assert by.leap(huge, 1.0, 2) is None
