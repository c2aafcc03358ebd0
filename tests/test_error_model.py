"""The centralised error model, against n filters written out by eqs. (4)(5)."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from networks import random_gains, random_problem

from agent.contract.arrays import Array
from agent.contract.problem import Problem
from designer.back_off import corner
from designer.error_model import error_model, link_gains, paper_error_model, stacks, step

SHAPES = [
    {"n": 3, "nx": 2, "nw": 2},
    {"n": 1, "nx": 3, "nw": 1},
    {"n": 4, "nx": 1, "nw": 3, "modes": 1},
    {"n": 2, "nx": 2, "nw": 1, "nz": 2, "modes": 3, "lossy": False},
]


@pytest.fixture(params=range(len(SHAPES)))
def network(request: pytest.FixtureRequest) -> tuple[Problem, Array, Array]:
    problem = random_problem(request.param, **SHAPES[request.param])  # type: ignore[arg-type]
    return problem, *random_gains(problem, request.param)


def filters(problem: Problem, K_bar: Array, H_bar: Array, modes: Array, theta: Array, w: Array, x: Array) -> Array:
    """Errors e(0), ..., e(steps) of n filters that run by eqs. (4)(5) from zero, (steps + 1, n nx)."""
    K, H = link_gains(problem, K_bar, H_bar)
    names, plant = problem.node_names, problem.plant
    x_hat = [np.zeros(problem.nx) for _ in names]
    errors = [np.concatenate([x - estimate for estimate in x_hat])]
    for k in range(len(w)):
        innovation = [
            theta[k, j] * node.C @ x + node.D @ w[k] - node.arrival_probability * node.C @ x_hat[j]
            for j, node in enumerate(problem.nodes)
        ]
        topology = problem.topologies[modes[k]]
        x_hat_next = []
        for i in range(problem.n):
            estimate = np.zeros(problem.nx)
            for j in range(problem.n):
                if topology.adjacency[i, j] > 0.0:
                    K_ij = K[topology.name][names[i]][names[j]]
                    H_ij = H[topology.name][names[i]][names[j]]
                    estimate += topology.adjacency[i, j] * (K_ij @ x_hat[j] + H_ij @ innovation[j])
            x_hat_next.append(estimate)
        x_hat, x = x_hat_next, plant.A @ x + plant.B @ w[k]
        errors.append(np.concatenate([x - estimate for estimate in x_hat]))
    return np.array(errors)


def draws(problem: Problem, steps: int) -> tuple[Array, Array, Array, Array]:
    rng = np.random.default_rng(5)
    modes = rng.integers(len(problem.topologies), size=steps)
    theta = (rng.uniform(size=(steps, problem.n)) < problem.beta).astype(float)
    return modes, theta, rng.normal(size=(steps, problem.nw)), rng.normal(size=problem.nx)


def test_the_error_model_moves_as_the_errors_of_the_filters(network: tuple[Problem, Array, Array]) -> None:
    """x - x_hat of n filters run by (4)(5) is e of (10), whatever modes, losses, w and x(0)."""
    problem, K_bar, H_bar = network
    modes, theta, w, x = draws(problem, 30)
    expected = filters(problem, K_bar, H_bar, modes, theta, w, x)
    model = error_model(problem, K_bar, H_bar)
    eta = np.concatenate([x, np.tile(x, problem.n)])
    for k in range(30):
        np.testing.assert_allclose(eta[problem.nx :], expected[k], rtol=1e-10, atol=1e-10)
        eta = step(model, modes[k], theta[k], eta, w[k])


def test_the_reduced_state_gives_the_errors_of_the_printed_one(network: tuple[Problem, Array, Array]) -> None:
    """[x; e] and [1 kron x; e] have the same e and the same z_tilde."""
    problem, K_bar, H_bar = network
    modes, theta, w, x = draws(problem, 30)
    reduced, printed = error_model(problem, K_bar, H_bar), paper_error_model(problem, K_bar, H_bar)
    e = np.tile(x, problem.n)
    eta, eta_printed = np.concatenate([x, e]), np.concatenate([e, e])
    for k in range(30):
        eta = step(reduced, modes[k], theta[k], eta, w[k])
        eta_printed = step(printed, modes[k], theta[k], eta_printed, w[k])
        np.testing.assert_allclose(reduced.M @ eta, printed.M @ eta_printed, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(eta[problem.nx :], eta_printed[problem.n * problem.nx :], rtol=1e-10, atol=1e-10)


def test_a_step_is_the_matrix_of_eq_10(network: tuple[Problem, Array, Array]) -> None:
    """step = [A_s + sum (theta_i - beta_i) F_i,s] eta + B_s w with every matrix in full."""
    problem, K_bar, H_bar = network
    model = error_model(problem, K_bar, H_bar)
    rng = np.random.default_rng(1)
    eta, w, theta = rng.normal(size=len(model.A[0])), rng.normal(size=problem.nw), np.zeros(problem.n)
    for s in range(len(problem.topologies)):
        matrix = model.A[s] + sum(
            (theta[i] - model.beta[i]) * model.F_i(s, i)[:, : model.size] for i in range(problem.n)
        )
        np.testing.assert_allclose(step(model, s, theta, eta, w), matrix @ eta + model.B[s] @ w, rtol=1e-12)


def test_expectation_over_losses_is_the_enumeration_of_all_of_them(network: tuple[Problem, Array, Array]) -> None:
    """E[V(eta(k+1))] over all 2^n losses and all next modes is the quadratic form of (17)'s left upper corner."""
    problem, K_bar, H_bar = network
    model = error_model(problem, K_bar, H_bar)
    rng = np.random.default_rng(2)
    eta, no_w = rng.normal(size=len(model.A[0])), np.zeros(problem.nw)
    factors = rng.normal(size=(len(problem.topologies), len(eta), len(eta)))
    P = factors @ factors.swapaxes(1, 2)
    for s in range(len(problem.topologies)):
        expected = 0.0
        for theta in product([0.0, 1.0], repeat=problem.n):
            chance = np.prod(np.where(np.array(theta) == 1.0, problem.beta, 1.0 - problem.beta))
            eta_next = step(model, s, np.array(theta), eta, no_w)
            for t, pi_st in enumerate(problem.markov.transition[s]):
                expected += chance * pi_st * (eta_next @ P[t] @ eta_next)
        assert eta @ corner(model, P)[s] @ eta == pytest.approx(expected, rel=1e-10)


def test_link_gains_are_divided_by_the_weights() -> None:
    """a_ij K_ij and a_ij H_ij are the blocks of K_bar and H_bar, (8)."""
    problem = random_problem(0)
    K_bar, H_bar = random_gains(problem, 0)
    K, H = link_gains(problem, K_bar, H_bar)
    a = problem.topologies[1].adjacency
    i, j = next((i, j) for i in range(3) for j in range(3) if i != j and a[i, j] > 0.0)
    np.testing.assert_allclose(a[i, j] * K["m1"][f"n{i}"][f"n{j}"], K_bar[1, 2 * i : 2 * i + 2, 2 * j : 2 * j + 2])
    assert H["m1"][f"n{i}"][f"n{j}"].shape == (2, len(problem.nodes[j].C))
    assert stacks(problem).D.shape == (H_bar.shape[2], problem.nw)
