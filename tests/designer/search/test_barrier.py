"""The barrier and the entries it takes: gradients, domain, and the curvature that BFGS begins with."""

from __future__ import annotations

import math

import numpy as np
import pytest
from networks import random_gains, random_problem, real_networks

from agent.contract.arrays import Array
from agent.contract.problem import Problem
from agent.contract.problem.matrices import Matrices, matrices_of
from designer.gain.exact import exact_gain
from designer.gain.sensitivity import Inputs, slope, sweep
from designer.model.error_model import error_model
from designer.model.mismatch import Real
from designer.model.units import natural_units
from designer.search.barrier import Barrier
from designer.search.entries import Entries
from designer.search.starts import consensus_gains, least_variance_gains

PROBLEMS = [random_problem(1), random_problem(2), *real_networks(3).values()]


@pytest.mark.parametrize("problem", PROBLEMS, ids=["paper 1", "paper 2", *real_networks(3)])
def test_the_gradients_of_all_barriers_agree_with_differences(problem: Problem) -> None:
    """By every direction of the gains that they may take, and of y = log g."""
    barrier = Barrier(problem, 9)
    gains = least_variance_gains(problem) if problem.unbiased else random_gains(problem, 1, size=0.1)
    v = barrier.entries.pack(*gains)
    y = math.log(2.0 * exact_gain(error_model(problem, *barrier.entries.unpack(v))).high ** 2)
    rng = np.random.default_rng(0)
    functions = (barrier.descent(0.03), np.append(v, y)), (barrier.centre(y, 2.0), v), (barrier.noise(y, 0.03), v)
    for function, x in functions:
        _, gradient = function(x)
        for _ in range(3):
            direction = 1e-5 * rng.normal(size=len(x))
            difference = function(x + direction)[0] - function(x - direction)[0]
            assert difference / 2.0 == pytest.approx(float(gradient @ direction), rel=1e-5, abs=1e-10)


def others(problem: Problem, seed: int) -> Inputs:
    """The same network with other probabilities and matrices, of which its filters are not told."""
    rng, n, modes = np.random.default_rng(seed), problem.n, len(problem.topologies)
    rho = np.where(problem.delivery < 1.0, rng.uniform(0.3, 0.9, (n, n)), 1.0)

    def off(matrix: Array) -> Array:
        return matrix * rng.uniform(0.9, 1.1, matrix.shape)

    A, B, M, C, D = matrices_of(problem)
    matrices = Matrices(off(A), off(B), off(M), tuple(map(off, C)), tuple(map(off, D)))
    real = Real(rng.uniform(0.3, 0.9, n), rho, rng.dirichlet(np.ones(modes), modes), matrices)
    return Inputs(problem, real, carry=True)


@pytest.mark.parametrize("problem", PROBLEMS, ids=["paper 1", "paper 2", *real_networks(3)])
def test_the_gradient_of_several_models_agrees_with_differences(problem: Problem) -> None:
    """Whose numbers are others than the filters were told; x may be in the errors of these alone."""
    barrier = Barrier(problem, 9, [others(problem, seed) for seed in (0, 1)])
    v = barrier.entries.pack(
        *(least_variance_gains(problem) if problem.unbiased else random_gains(problem, 1, size=0.1))
    )
    J, y = barrier.descent(0.03), 0.0
    while not math.isfinite(J(np.append(v, y))[0]):
        y += 1.0
    x, rng = np.append(v, y + 0.5), np.random.default_rng(0)
    assert J(x)[0] != pytest.approx(Barrier(problem, 9).descent(0.03)(x)[0], rel=1e-6)
    for _ in range(4):
        direction = 1e-5 * rng.normal(size=len(x))
        difference = J(x + direction)[0] - J(x - direction)[0]
        assert difference / 2.0 == pytest.approx(float(J(x)[1] @ direction), rel=1e-5, abs=1e-10)


def test_the_barrier_is_finite_exactly_where_g_is_above_gamma_squared() -> None:
    """Just above gamma_T^2 it is a number, just below it is infinite."""
    problem = random_problem(3)
    barrier = Barrier(problem, 200)
    v = barrier.entries.pack(*random_gains(problem, 3, size=0.1))
    gain = exact_gain(error_model(problem, *barrier.entries.unpack(v)))
    J = barrier.descent(0.1)
    assert math.isfinite(J(np.append(v, 2.0 * math.log(gain.high * (1.0 + 1e-6))))[0])
    assert J(np.append(v, 2.0 * math.log(gain.low * (1.0 - 1e-6))))[0] == math.inf


@pytest.mark.parametrize("problem", PROBLEMS, ids=["paper 1", "paper 2", *real_networks(3)])
def test_bfgs_begins_with_the_curvature_of_what_each_node_chooses(problem: Problem) -> None:
    """With Y_bar and the moments held, -log det is a quadratic of one node's gains; second differences of it are exact.

    It is written out with S(Y_bar), which shares nothing with the regressions of `inverse_hessian`.
    """
    barrier, mu, rng = Barrier(problem, 9), 0.03, np.random.default_rng(0)
    gains = least_variance_gains(problem) if problem.unbiased else random_gains(problem, 1, size=0.1)
    v = barrier.entries.pack(*gains)
    x = np.append(v, math.log(2.0 * exact_gain(error_model(problem, *gains)).high ** 2))
    operator = barrier.operator(v)
    swept = sweep(operator, math.exp(x[-1]), 9)
    assert swept is not None
    everything = np.arange(operator.joint(swept.Y_bar[0]).size)
    found = slope(barrier.model(v), operator, barrier.inputs, swept, swept.W_inverse, entries=everything).moments
    assert found is not None
    moments = found.reshape(9, len(problem.topologies), *2 * [barrier.size + problem.nw])

    def held(v: Array) -> float:
        operator = barrier.operator(v)
        pairs = zip(swept.Y_bar, moments, strict=True)
        return mu * sum(float((operator.joint(Y_bar) * of_step).sum()) for Y_bar, of_step in pairs)

    inverse = barrier.inverse_hessian(x, mu, ridge=0.7)
    for s in range(len(problem.topologies)):
        for i in range(problem.n):
            at = barrier.entries.nodes[s, i]
            damped = np.linalg.inv([inverse(unit)[at] for unit in np.eye(len(x))[at]])
            hessian = damped - np.diag(damped.diagonal() * 0.1 / 1.1)
            direction = np.zeros(len(v))
            direction[at] = rng.normal(size=len(at))
            second = held(v + direction) - 2.0 * held(v) + held(v - direction) + 0.7 * float(direction @ direction)
            assert float(direction[at] @ hessian @ direction[at]) == pytest.approx(second, rel=1e-6)


def test_the_curvature_by_y_is_that_of_the_barrier_with_Y_bar_held() -> None:
    """Second differences of -sum log det (I - S_ww e^-y), for the S_ww of one sweep."""
    problem, h = random_problem(2), 1e-3
    barrier, gains = Barrier(problem, 9), random_gains(problem, 1, size=0.1)
    y = math.log(2.0 * exact_gain(error_model(problem, *gains)).high ** 2)
    swept = sweep(barrier.operator(barrier.entries.pack(*gains)), math.exp(y), 9)
    assert swept is not None
    S_ww = math.exp(y) * np.eye(problem.nw) - np.linalg.inv(swept.W_inverse)
    values = [-np.linalg.slogdet(np.eye(problem.nw) - S_ww * math.exp(-y - step))[1].sum() for step in (-h, 0.0, h)]
    x = np.append(barrier.entries.pack(*gains), y)
    last = barrier.inverse_hessian(x, 0.03)(np.ones_like(x))[-1]
    assert 1.0 / last == pytest.approx(0.03 * (values[0] - 2.0 * values[1] + values[2]) / h**2, rel=1e-3)


def test_what_grows_slowly_costs_something() -> None:
    """kappa tr(X_0 Y_T) / g, and nothing else, is what J has more than with kappa = 0."""
    problem = random_problem(2)
    barrier, gains = Barrier(problem, 5), random_gains(problem, 1, size=0.1)
    y = math.log(2.0 * exact_gain(error_model(problem, *gains)).high ** 2)
    x = np.append(barrier.entries.pack(*gains), y)
    swept = sweep(barrier.operator(x[:-1]), math.exp(y), 5)
    assert swept is not None
    units = np.tile(natural_units(problem).state, problem.n + 1)
    late = sum(float(units**2 @ Y.diagonal()) for Y in swept.Y) / math.exp(y)
    assert barrier._inside(x, 2.0)[0] - barrier._inside(x, 0.0)[0] == pytest.approx(2.0 * late, rel=1e-9)
    assert late > 0.0


def test_entries_are_those_that_the_topologies_allow() -> None:
    """Consensus gains keep to them, and packing loses nothing of them."""
    problem = random_problem(4)
    entries = Entries(problem)
    K_bar, H_bar = consensus_gains(problem, weight=0.3)
    v = entries.pack(K_bar, H_bar)
    assert np.count_nonzero(v) == np.count_nonzero(K_bar) + np.count_nonzero(H_bar)
    for stacked, back in zip((K_bar, H_bar), entries.unpack(v), strict=True):
        np.testing.assert_allclose(stacked, back, rtol=1e-15)


@pytest.mark.parametrize("kind", sorted(real_networks(4)))
def test_the_entries_of_a_node_are_its_rows_and_all_are_somebodys(kind: str) -> None:
    problem = real_networks(4)[kind]
    entries, nx, seen = Entries(problem), problem.nx, []
    for s in range(len(problem.topologies)):
        for i in range(problem.n):
            at = entries.nodes[s, i]
            seen += at.tolist()
            v = np.zeros(len(entries.units))
            v[at] = 1.0
            for moved, still in zip(entries.unpack(v), entries.unpack(0.0 * v), strict=True):
                where, rows, _ = np.nonzero(moved != still)
                assert set(where) <= {s}  # no K at all where a node hears itself alone
                assert set(rows // nx) <= {i}
    assert sorted(seen) == list(range(len(entries.units)))
