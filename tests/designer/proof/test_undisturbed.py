"""What an initial error alone leaves: proved above every step of what really follows, and nothing where it is not."""

from __future__ import annotations

import math
from fractions import Fraction
from itertools import product

import numpy as np
import pytest
from flint import ctx
from made_recordings import observer_gains, random_gains, real_problem
from outcomes import moment

from agent.contract.arrays import Array
from agent.contract.gains import Gains, LinkMatrices
from agent.contract.problem import Problem
from designer.patience import Budget, TimeIsUp, looking
from designer.proof import by_floats, undisturbed
from designer.proof.balls import diagonal, exact, part, sign
from designer.proof.by_balls import ByBalls
from designer.proof.by_floats import ByFloats
from designer.proof.prover import BALLS, FLOATS, Make, Prover
from designer.proof.undisturbed import Starts, largest
from designer.start import left_by_start

ERROR = [0.1, 0.3]


def jordan(a: float = 0.9) -> tuple[Problem, LinkMatrices, LinkMatrices]:
    """One node that ignores what it measures: z~(k) = M A^k x(0) exactly, which is largest after some steps."""
    problem = Problem.from_arrays(
        "jordan",
        A=[[a, 1.0], [0.0, a]],
        B=[[0.1], [0.1]],
        M=[[1.0, 0.0]],
        C={"a": [[1.0, 0.0]]},
        D={"a": [[0.1]]},
        adjacency={"on": [[1.0]]},
    ).with_(plant={"initial_error": ERROR})
    return problem, {"on": {"a": {"a": problem.plant.A}}}, {"on": {"a": {"a": np.zeros((2, 1))}}}


def latest_peak(a: float) -> Fraction:
    """The largest |M A^k x|, |x_1| <= 0.1, |x_2| <= 0.3: a^k x_1 + k a^(k-1) x_2, and the sum of both sizes."""
    e, f = map(Fraction, ERROR)
    return max(Fraction(a) ** k * e + k * Fraction(a) ** k / Fraction(a) * f for k in range(400))


@pytest.mark.parametrize("makes", [FLOATS, BALLS[:1]], ids=["floats", "balls"])
@pytest.mark.parametrize("a", [0.9, 0.99])
def test_a_peak_that_comes_late_is_met_and_not_exceeded_by_much(a: float, makes: tuple[Make, ...]) -> None:
    problem, K, H = jordan(a)
    corners = np.array([[1.0, 1.0], [1.0, -1.0]]) * ERROR
    found = Prover(problem, K, H, makes=makes).undisturbed(Starts(0, corners, None))
    assert found is not None
    assert latest_peak(a) <= Fraction(found) < latest_peak(a) * (1 + Fraction(1, 10**7))


@pytest.mark.parametrize("unbiased", [True, False])
def test_no_step_leaves_more_by_every_outcome_of_chance(unbiased: bool) -> None:
    """Second moments of filters on unit vectors, step by step, two modes, losses of measurements and messages."""
    problem = real_problem(4, unbiased=unbiased, ny=(1, 1), modes=2).with_(plant={"initial_error": ERROR})
    gains = observer_gains(problem) if unbiased else random_gains(problem)
    found = left_by_start(problem, gains.K, gains.H)
    assert found is not None
    largest = 0.0
    for x in np.array([[1.0, 1.0], [1.0, -1.0]]) * ERROR:
        largest = max(largest, *(_value(Y, problem, x) for Y in followed(gains, 30)))
    assert largest <= found**2 < largest * (1.0 + 1e-6)


def followed(gains: Gains, steps: int) -> list[Array]:
    """Y(k), of [x; e]."""
    problem, modes = gains.problem, gains.problem.mode_names
    z = np.hstack([np.zeros((problem.n * problem.nz, problem.nx)), np.kron(np.diag(problem.weights), problem.plant.M)])
    found = [np.tile(z.T @ z, (len(modes), 1, 1))]
    for _ in range(steps):
        Y_bar = np.einsum("st,tij->sij", problem.markov.transition, found[-1])
        n = Y_bar.shape[1]
        S = [
            moment(gains, mode, problem.beta, problem.delivery, Y, None)[:n, :n]
            for mode, Y in zip(modes, Y_bar, strict=True)
        ]
        found.append(np.array(S))
    return found


def _value(Y: Array, problem: Problem, x: Array) -> float:
    eta = np.tile(x, problem.n + 1)
    return float(eta @ Y[problem.mode_index(problem.markov.initial)] @ eta)


def test_a_step_of_floats_is_above_that_of_balls() -> None:
    gains = random_gains(real_problem(4, unbiased=False, ny=(1, 1), modes=2))
    arguments = gains.problem, gains.K, gains.H
    floats, balls = ByFloats(*arguments), ByBalls(*arguments, bits=256)
    half = np.random.default_rng(0).normal(size=(2, floats.order, floats.order))
    Y = half @ half.swapaxes(1, 2)
    Y = (Y + Y.swapaxes(1, 2)) / 2.0

    def is_above() -> bool:
        above, eta = floats.undisturbed(Y), balls.model.eta
        assert above is not None
        with ctx.workprec(256):
            of_balls = [part(S, eta, eta) for S in balls.model.joint([exact(Y_s) for Y_s in Y])]
            rests = [exact(mine) - S for mine, S in zip(above, of_balls, strict=True)]
            return all(sign(rest, np.abs(diagonal(rest))).proved for rest in rests)

    assert is_above()
    with pytest.MonkeyPatch.context() as patch:  # mutant: rounded as it comes
        patch.setattr(by_floats, "raised", lambda S, *, up: S.middle)
        assert not is_above()


def test_values_in_floats_are_above_those_in_fractions() -> None:
    """For any T, and for all signs at once."""
    rng = np.random.default_rng(1)
    half, T, tried = rng.normal(size=(1, 6, 2)), rng.normal(size=(2, 2)), rng.normal(size=(5, 2))
    Y = half @ half.swapaxes(1, 2)
    fractions = [[Fraction(float(entry)) for entry in row] for row in Y[0]]
    for by_size in (False, True):
        largest = Fraction(0)
        for x in tried:
            for signs in product((1, -1), repeat=2) if by_size else [(1, 1)]:
                Tx = [
                    sum(Fraction(float(t)) * s * Fraction(float(x_j)) for t, s, x_j in zip(row, signs, x, strict=True))
                    for row in T
                ]
                eta = [*Tx, *Tx, *Tx]
                value = sum(
                    a * b * y for a, row in zip(eta, fractions, strict=True) for b, y in zip(eta, row, strict=True)
                )
                largest = max(largest, Fraction(value))
        assert largest <= Fraction(Starts(0, tried, T, by_size).above(Y))


# what is not proved
def test_errors_that_do_not_die_out_have_no_bound() -> None:
    problem, K, H = jordan()
    grows = {"on": {"a": {"a": problem.plant.A * 1.2}}}
    assert left_by_start(problem, K, H) is not None
    assert left_by_start(problem, grows, H) is None


@pytest.mark.parametrize("makes", [FLOATS, BALLS[:1]], ids=["floats", "balls"])
def test_an_end_that_is_not_proved_is_none(makes: tuple[Make, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    """A c that is a tenth too small: then Y(k) < c P is false, and what comes later may be more."""
    problem, K, H = jordan()
    monkeypatch.setattr(undisturbed, "_ROOM", -0.1)
    assert Prover(problem, K, H, makes=makes).undisturbed(Starts(0, np.array([ERROR]), None)) is None


def test_a_P_without_17_ends_nothing() -> None:
    problem, K, H = jordan()
    P = np.tile(np.eye(4), (1, 1, 1))
    assert Prover(problem, K, H, P=P).undisturbed(Starts(0, np.array([ERROR]), None)) is None


def test_where_the_steps_end_first_the_bound_is_still_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """After three of them, far before the peak."""
    problem, K, H = jordan()
    monkeypatch.setattr(undisturbed, "_MOST_STEPS", 3)
    found = left_by_start(problem, K, H)
    assert found is not None
    assert math.isfinite(found)
    assert latest_peak(0.9) < Fraction(found)


def test_it_looks_whether_to_end() -> None:
    problem, K, H = jordan()
    by, P = ByFloats(problem, K, H), Prover(problem, K, H).P
    assert P is not None
    with pytest.raises(TimeIsUp), looking(Budget(0.0).check):
        largest(by, P, Starts(0, np.array([ERROR]), None))
