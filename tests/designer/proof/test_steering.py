"""Where only x decays slowly: both ends of the gain by what it costs to bring x somewhere; nothing false is proved."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest
from flint import arb
from networks import random_gains, random_problem, real_network

from agent.contract.arrays import Array
from agent.contract.problem import Problem
from designer.gain.exact import Gain, InvariantSet, Operator, exact_gain, recursion_holds, step
from designer.invariants import Invariants, invariants
from designer.model.error_model import ErrorModel, StackedGains, error_model, link_gains
from designer.patience import Budget, TimeIsUp, looking
from designer.proof.by_balls import ByBalls
from designer.proof.by_floats import ByFloats
from designer.proof.prover import FLOATS, Prover
from designer.proof.recursion import Costs, disproof_by_costs, seen_by_floats
from designer.proof.steering import Steering
from designer.search.exact_design import confirmed, lower_end
from designer.steered import Steered, summed


@cache
def slow(radius: float, *, n: int = 3, seed: int = 11, modes: int = 2, **real: Any) -> tuple[Problem, ErrorModel]:
    """A random plant of this radius, and gains whose errors die out in a few steps."""
    problem = real_network(random_problem(seed, n=n, modes=modes), radius=radius, **real)
    return problem, error_model(problem, *gains_for(problem))


def gains_for(problem: Problem) -> StackedGains:
    """So that errors hear each other, and x by their biases and losses."""
    K_bar, H_bar = random_gains(problem, 1, size=0.15)
    return K_bar, H_bar


@cache
def gain_of(model: ErrorModel) -> Gain:
    return exact_gain(model)


def prover_of(problem: Problem, **how: Any) -> Prover:
    return Prover(problem, *link_gains(problem, *gains_for(problem)), **how)


JORDAN = {"A": [[0.999, 0.1], [0.0, 0.999]], "B": [[0.0, 0.0], [1.0, 0.0]], "M": [[1.0, 0.0]]}


@pytest.mark.parametrize("radius", [0.999, 0.99999, 0.9999999])
@pytest.mark.parametrize("real", [{}, {"seen": True, "delivery": 0.8}], ids=["hidden losses", "seen, lossy links"])
def test_both_ends_are_near_and_proved_in_few_steps(radius: float, real: dict[str, Any]) -> None:
    problem, model = slow(radius, **real)
    gain = gain_of(model)
    K, H = link_gains(problem, *gains_for(problem))
    verdict, low = confirmed(problem, K, H, gain.high), lower_end(problem, K, H, gain)
    assert gain.horizon < 1000
    assert verdict.holds
    assert verdict.gamma * (1.0 - 1e-5) < low < verdict.gamma


def test_a_jordan_block_is_proved() -> None:
    """Its powers grow before they decay, and its eigenvectors are no basis."""
    problem = Problem.from_document(random_problem(1, n=2, modes=1).document() | {"plant": JORDAN})
    gain = exact_gain(error_model(problem, *gains_for(problem)))
    prover = prover_of(problem, makes=FLOATS)
    assert prover.exact(gain.high * (1.0 + 1e-6)).holds
    assert prover.at_least_by_costs(gain.low * (1.0 - 1e-5)) is not None


def attained(model: ErrorModel, gain: Gain, before: int) -> float:
    """What one policy attains, by covariances: the cheapest w that brings x to xi, then the worst one, step by step."""
    operator, p, n, s = Operator(model), model.plant_states, model.size, 0
    A, B, g = model.A[0, :p, :p], model.B[0, :p], gain.low**2
    Y, policies = np.asarray(operator.MM), []
    for _ in range(60):
        taken = step(operator, Y, g)
        assert taken is not None
        Y, policies = taken.Y, [taken.Gamma, *policies]
    reached: list[Array] = []
    total, power = np.zeros((p, p)), np.eye(p)
    for _ in range(before):
        total, power = total + power @ B @ B.T @ power.T, A @ power
        reached.append(power)
    by_e = np.linalg.solve(Y[s, p:, p:] + 1e-9 * np.eye(n - p), Y[s, p:, :p])
    weight = Y[s, :p, :p] - Y[s, :p, p:] @ by_e
    values, vectors = np.linalg.eig(total @ weight)
    u = np.linalg.solve(total, np.real(vectors[:, np.real(values).argmax()]))
    joint, X = np.zeros((model.modes, n + operator.nw, n + operator.nw)), np.zeros((model.modes, n, n))
    mean, spent, where = np.zeros((model.modes, n)), 0.0, np.eye(model.modes)[s]
    for k in reversed(range(before)):  # w is known beforehand, so means and moments are enough
        w = B.T @ (np.eye(p) if k == 0 else reached[k - 1]).T @ u
        joint[:, :n, :n] = X
        joint[:, :n, n:] = mean[:, :, None] * w
        joint[:, n:, :n] = joint[:, :n, n:].swapaxes(1, 2)
        joint[:, n:, n:] = where[:, None, None] * np.outer(w, w)
        X = operator.carry(joint)
        mean = operator.transition.T @ (np.einsum("sij,sj->si", model.A, mean) + where[:, None] * (model.B @ w))
        spent, where = spent + float(w @ w), operator.transition.T @ where
    for Gamma in policies:
        closed = np.concatenate([np.tile(np.eye(n), (model.modes, 1, 1)), Gamma], axis=1)
        joint = closed @ X @ closed.swapaxes(1, 2)
        spent, X = spent + float(np.trace(joint[:, n:, n:].sum(axis=0))), operator.carry(joint)
    return float(np.sqrt(np.einsum("ij,sji->", operator.MM[0], X) / spent))


def test_a_policy_that_is_written_out_attains_it() -> None:
    """Over five thousand steps, by the moments of all errors: no interval lies below what w really does."""
    problem, model = slow(0.998)
    gain = gain_of(model)
    found = attained(model, gain, 5_000)
    assert gain.low * (1.0 - 2e-6) < found < gain.high * (1.0 + 1e-9)
    assert prover_of(problem).at_least_by_costs(found * (1.0 + 1e-5)) is None


def test_the_whole_recursion_agrees(monkeypatch: pytest.MonkeyPatch) -> None:
    """Thousands of steps, to the P that is strict, instead of some dozens."""
    _, model = slow(0.998)
    quick, operator = gain_of(model), Operator(model)
    assert quick.P is not None
    for g, holds in ((quick.low**2 * (1.0 - 1e-4), False), (quick.high**2 * (1.0 + 1e-4), True)):
        assert recursion_holds(operator, g, 20_000, invariant=InvariantSet(quick.P)).holds is holds


def test_what_x_costs_is_the_inverse_of_what_it_is_reached_by() -> None:
    """G and a little more; also where w does not reach all of x."""
    A, B = np.diag([0.999, 0.9]), np.array([[1.0], [0.5]])
    steered, strict = Steered(A, B), np.zeros((1, 2, 2))
    G = summed(A, B @ B.T)
    assert G is not None
    assert steered.P(strict)[0] == pytest.approx(np.linalg.inv(G), rel=1e-6)
    assert Steered(A, np.array([[0.0], [0.5]])).P(strict)[0, 1, 1] == pytest.approx(0.76, rel=1e-6)
    assert not Steered(1.1 * A, B).known
    assert summed(1.1 * A, B @ B.T) is None


def test_what_decays_fast_is_not_asked_for_its_costs() -> None:
    problem, model = slow(0.9)
    operator = Operator(model)
    assert prover_of(problem).at_least_by_costs(0.5 * gain_of(model).low) is None
    assert isinstance(found := known(operator), Invariants)
    assert found.of_x is None


def known(operator: Operator) -> Invariants:
    from designer.decay import decay

    model, p = operator.model, operator.model.plant_states
    decays = decay(operator.corner, model.modes, operator.units, model.moves)
    steered = Steered(model.A[0, :p, :p], model.B[0, :p])
    return invariants(operator.of, decays, operator.units, np.asarray(operator.MM), steered)


def test_balls_see_the_same_costs() -> None:
    """`verify --balls`: Y from balls, at a gamma that is not the least."""
    problem, model = slow(0.9999, n=2, modes=1)
    gain, prover = gain_of(model), prover_of(problem, makes=[lambda *case, T: ByBalls(*case, bits=128, T=T)])
    assert prover.exact(gain.high * (1.0 + 1e-5)).holds
    assert prover.at_least_by_costs(gain.low * (1.0 - 1e-5)) is not None
    assert prover.at_least_by_costs(gain.high * (1.0 + 1e-5)) is None


# mutants: what would be proved if the proof forgot something
def costs_of(prover: Prover) -> Steering:
    assert prover._steering is not None
    return prover._steering


def halved(costs: Steering) -> None:
    """To be at xi costs u'xi; half of it."""
    total = costs._G.total
    costs._G = costs._G._replace(total=total * arb(0.98))
    outweighed, direction = costs.outweighed, costs.direction
    costs.direction = lambda Y, gamma: direction(Y, 0.995 * gamma)  # type: ignore[method-assign]
    costs.outweighed = lambda Y, gamma, u: outweighed(  # type: ignore[method-assign]
        1.04 * Y, gamma, u
    )


def test_a_disturbance_that_costs_less_would_prove_too_much() -> None:
    problem, model = slow(0.9999)
    gain, prover = gain_of(model), prover_of(problem)
    assert prover.at_least_by_costs(1.001 * gain.high) is None
    halved(costs_of(prover))
    assert prover.at_least_by_costs(1.001 * gain.high) is not None


def test_an_x_that_costs_more_would_prove_too_much() -> None:
    problem, model = slow(0.9999)
    gain, prover = gain_of(model), prover_of(problem)
    assert not prover.exact(0.999 * gain.low, most=600).holds
    costs = costs_of(prover)
    costs._inverse = costs._inverse * arb(1.02)
    costs.P = 1.02 * costs.P
    assert prover.exact(0.999 * gain.low, most=600).holds


@pytest.mark.parametrize("forgotten", ["one mode", "errors"])
def test_all_modes_and_all_errors_count(forgotten: str) -> None:
    """Y that weighs x enough in one mode only, or for errors at 0 only, is not outweighed."""
    problem, model = slow(0.9999)
    gain, prover = gain_of(model), prover_of(problem)
    costs, gamma, p = costs_of(prover), 0.99 * gain.low, model.plant_states
    operator, Y = Operator(model), np.asarray(Operator(model).MM)
    for _ in range(60):
        taken = step(operator, Y, gain.low**2)
        assert taken is not None
        Y = taken.Y
    u = costs.direction(Y, gamma)
    assert u is not None
    assert all(sign.proved for sign in costs.outweighed(Y, gamma, u))
    worse = Y.copy()
    if forgotten == "one mode":
        worse[1] *= 0.5
    else:
        xi = np.linalg.solve(np.eye(p * p) - np.kron(model.A[0, :p, :p], model.A[0, :p, :p]), np.eye(p * p))
        G = (xi @ (model.B[0, :p] @ model.B[0, :p].T).reshape(-1)).reshape(p, p)
        at = np.concatenate([G @ u, -np.tile(G @ u, problem.n)])
        away = np.eye(len(at)) - np.outer(at, at) / (at @ at)
        worse = away @ Y @ away  # which weighs nothing where e = -x
    assert not all(sign.proved for sign in costs.outweighed(worse, gamma, u))
    assert costs.direction(worse, gamma) is None


def test_no_steps_are_enough_where_the_errors_may_undo_it() -> None:
    """Early on, errors that nobody has weighed yet would make z small: nothing is said before they have died out."""
    problem, model = slow(0.9999)
    costs: Costs = costs_of(prover_of(problem))
    assert costs.direction(np.asarray(Operator(model).MM), 0.1 * gain_of(model).low) is None


def test_whoever_follows_a_recursion_looks_whether_to_end() -> None:
    problem, _ = slow(0.999)
    by, costs = ByFloats(problem, *link_gains(problem, *gains_for(problem))), prover_of(problem)._steering
    assert costs is not None
    with looking(Budget(0.0).check):
        with pytest.raises(TimeIsUp):
            disproof_by_costs(by, problem.mode_names, 1.0, costs, most=1)
        with pytest.raises(TimeIsUp):
            next(seen_by_floats(by, 1.0, 1))


def test_what_overflows_in_a_look_ahead_is_no_warning() -> None:
    class Overflowing:
        def start(self, *, up: bool) -> Array:
            return np.full((1, 1, 1), 1e200)

        def weigh(self, Y: Array, X: Array) -> Array:
            return np.array([[[1e200, 0.0], [0.0, 0.0]]]) * Y

    assert np.isinf(list(seen_by_floats(Overflowing(), 1.0, 1))[-1]).all()
