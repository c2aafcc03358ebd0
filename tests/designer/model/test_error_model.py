"""The centralised error model, against n filters written out by eqs. (4)(5), with what is not in the paper too."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from networks import random_gains, random_problem, real_network, real_networks

from agent.contract.arrays import Array
from agent.contract.problem import Problem
from benchmarks.design import banded
from designer.gain.exact import Operator
from designer.gain.products import Collected
from designer.model.error_model import error_model, link_gains, paper_error_model, realised, stacks, step
from designer.search.starts import consensus_gains

SHAPES = [
    {"n": 3, "nx": 2, "nw": 2},
    {"n": 1, "nx": 3, "nw": 1},
    {"n": 4, "nx": 1, "nw": 3, "modes": 1},
    {"n": 2, "nx": 2, "nw": 1, "nz": 2, "modes": 3, "lossy": False},
]


Network = tuple[Problem, Array, Array]
REAL = sorted(real_networks(0))


@pytest.fixture(params=range(len(SHAPES)))
def network(request: pytest.FixtureRequest) -> Network:
    problem = random_problem(request.param, **SHAPES[request.param])  # type: ignore[arg-type]
    return problem, *random_gains(problem, request.param)


@pytest.fixture(params=[(kind, seed) for kind in REAL for seed in (1, 2)], ids=lambda param: f"{param[0]}-{param[1]}")
def real(request: pytest.FixtureRequest) -> Network:
    kind, seed = request.param
    problem = real_networks(seed)[kind]
    return problem, *random_gains(problem, seed)


def filters(
    problem: Problem,
    K_bar: Array,
    H_bar: Array,
    modes: Array,
    theta: Array,
    w: Array,
    x: Array,
    delivered: Array | None = None,
) -> Array:
    """Errors e(0), ..., e(steps) of n filters that run by eqs. (4)(5) from zero, (steps + 1, n nx).

    delivered (steps, n, n): where a message did not come, its receiver takes its own estimate and no innovation.
    """
    K, H = link_gains(problem, K_bar, H_bar)
    if delivered is None:
        delivered = np.ones((len(w), problem.n, problem.n))
    names, plant = problem.node_names, problem.plant
    x_hat = [np.zeros(problem.nx) for _ in names]
    errors = [np.concatenate([x - estimate for estimate in x_hat])]
    for k in range(len(w)):
        innovation = []
        for j, node in enumerate(problem.nodes):
            if not node.seen:
                y = theta[k, j] * node.C @ x + node.D @ w[k]
                innovation.append(y - node.arrival_probability * node.C @ x_hat[j])
            elif theta[k, j] == 1.0:
                innovation.append(node.C @ x + node.D @ w[k] - node.C @ x_hat[j])
            else:
                innovation.append(np.zeros(len(node.C)))
        topology = problem.topologies[modes[k]]
        x_hat_next = []
        for i in range(problem.n):
            estimate = np.zeros(problem.nx)
            for j in range(problem.n):
                if topology.adjacency[i, j] > 0.0:
                    K_ij = K[topology.name][names[i]][names[j]]
                    H_ij = H[topology.name][names[i]][names[j]]
                    if i == j or delivered[k, i, j] == 1.0:
                        estimate += topology.adjacency[i, j] * (K_ij @ x_hat[j] + H_ij @ innovation[j])
                    else:
                        estimate += topology.adjacency[i, j] * (K_ij @ x_hat[i])
            x_hat_next.append(estimate)
        x_hat, x = x_hat_next, plant.A @ x + plant.B @ w[k]
        errors.append(np.concatenate([x - estimate for estimate in x_hat]))
    return np.array(errors)


def draws(problem: Problem, steps: int) -> tuple[Array, Array, Array, Array]:
    rng = np.random.default_rng(5)
    modes = rng.integers(len(problem.topologies), size=steps)
    theta = (rng.uniform(size=(steps, problem.n)) < problem.beta).astype(float)
    return modes, theta, rng.normal(size=(steps, problem.nw)), rng.normal(size=problem.nx)


def test_the_error_model_moves_as_the_errors_of_the_filters(network: Network) -> None:
    """x - x_hat of n filters run by (4)(5) is e of (10), whatever modes, losses, w and x(0)."""
    problem, K_bar, H_bar = network
    modes, theta, w, x = draws(problem, 30)
    expected = filters(problem, K_bar, H_bar, modes, theta, w, x)
    model = error_model(problem, K_bar, H_bar)
    eta = np.concatenate([x, np.tile(x, problem.n)])
    for k in range(30):
        np.testing.assert_allclose(eta[problem.nx :], expected[k], rtol=1e-10, atol=1e-10)
        eta = step(model, modes[k], theta[k], eta, w[k])


def test_the_reduced_state_gives_the_errors_of_the_printed_one(network: Network) -> None:
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


def test_a_step_is_the_matrix_of_eq_10(network: Network) -> None:
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


def test_expectation_over_losses_is_the_enumeration_of_all_of_them(network: Network) -> None:
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
        assert eta @ Operator(model).corner(P)[s] @ eta == pytest.approx(expected, rel=1e-10)


# what is not in the paper
def real_draws(problem: Problem, steps: int) -> tuple[Array, Array, Array, Array, Array]:
    """Modes, theta (steps, n), w, x(0), and delivered (steps, n, n)."""
    modes, theta, w, x = draws(problem, steps)
    arrives = np.random.default_rng(6).uniform(size=(steps, problem.n, problem.n))
    return modes, theta, w, x, (arrives < problem.delivery).astype(float)


def test_the_realised_matrix_is_a_step_of_the_filters(real: Network) -> None:
    """With seen losses, lossy links and unbiased gains; from any x(0), for 30 steps, and of an unstable plant."""
    problem, K_bar, H_bar = real
    modes, theta, w, x, delivered = real_draws(problem, 30)
    assert (theta == 0.0).any()
    expected = filters(problem, K_bar, H_bar, modes, theta, w, x, delivered)
    model = error_model(problem, K_bar, H_bar)
    assert model.plant_states == (problem.nx if problem.carries_plant else 0)
    eta = np.concatenate([x[: model.plant_states], np.tile(x, problem.n)])
    for k in range(30):
        size = np.abs(expected[: k + 1]).max()
        np.testing.assert_allclose(eta[model.plant_states :], expected[k], rtol=0.0, atol=1e-11 * size)
        arrived = delivered[k] == 1.0
        eta = step(model, modes[k], theta[k], eta, w[k], arrived)


def outcomes(problem: Problem) -> list[tuple[float, Array, Array]]:
    """Every outcome of the losses of measurements and messages: its probability, theta (n,), delivered (n, n)."""
    found = []
    lossy = np.flatnonzero(problem.beta < 1.0)
    links = np.argwhere(problem.delivery < 1.0)
    for arrived in product([0.0, 1.0], repeat=len(lossy)):
        for came in product([False, True], repeat=len(links)):
            theta, delivered = np.ones(problem.n), np.ones((problem.n, problem.n), dtype=bool)
            theta[lossy] = arrived
            delivered[links[:, 0], links[:, 1]] = came
            beta, rho = problem.beta[lossy], problem.delivery[links[:, 0], links[:, 1]]
            chance = np.prod(np.where(theta[lossy] == 1.0, beta, 1.0 - beta)) * np.prod(np.where(came, rho, 1.0 - rho))
            found.append((float(chance), theta, delivered))
    return found


def test_the_mean_over_all_losses_is_what_the_operator_says(real: Network) -> None:
    """sum over theta and phi of P(theta, phi) [A_k B_k]'P_bar[A_k B_k] is `Operator.joint`, in every mode."""
    problem, K_bar, H_bar = real
    model = error_model(problem, K_bar, H_bar)
    operator = Operator(model)
    factors = np.random.default_rng(2).normal(size=(model.modes, model.size, model.size))
    P_bar = operator.bar(factors @ factors.swapaxes(1, 2))
    joint, all_outcomes = operator.joint(P_bar), outcomes(problem)
    assert sum(chance for chance, _, _ in all_outcomes) == pytest.approx(1.0)
    for s in range(model.modes):
        expected = np.zeros_like(joint[s])
        for chance, theta, delivered in all_outcomes:
            AB = realised(model, s, theta, delivered)
            expected += chance * AB.T @ P_bar[s] @ AB
        np.testing.assert_allclose(joint[s], expected, rtol=1e-11, atol=1e-11 * np.abs(expected).max())


@pytest.mark.parametrize("rows", [1, 2, 3])
def test_the_zeros_of_large_networks_may_be_left_out(
    network: Network, rows: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`Operator.joint`, its adjoint and its derivative are the same by one group of rows and by many."""
    zeros_may_be_left_out(network, rows, monkeypatch)


@pytest.mark.parametrize("rows", [1, 2, 3])
def test_and_of_real_networks_too(real: Network, rows: int, monkeypatch: pytest.MonkeyPatch) -> None:
    zeros_may_be_left_out(real, rows, monkeypatch)


def zeros_may_be_left_out(network: Network, rows: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Wherever the zeros are."""
    model, rng = error_model(*network), np.random.default_rng(6)
    A, H, R = (np.where(rng.uniform(size=full.shape) < 0.5, 0.0, full) for full in (model.A, model.H, model.R))
    model = replace(model, A=A, H=H, R=R)
    both = model.size + model.nw
    Y, X = (f @ f.swapaxes(1, 2) for f in (rng.normal(size=(model.modes, k, k)) for k in (model.size, both)))
    found = []
    for small in (10_000, 0):
        monkeypatch.setattr("designer.gain.products._SMALL", small)
        monkeypatch.setattr("designer.gain.products._SPARSE", 2.0)
        monkeypatch.setattr("designer.gain.products._WIDE", 0.8)
        monkeypatch.setattr("designer.gain.products._ROWS", rows)
        operator = Operator(model)
        assert (len(operator.products.pattern.rows) == 1) == (small > 0)
        collected = Collected(operator.products)
        joint, carried = operator.joint(Y), operator.carry(X, collected, Y)
        by_AB, by_H = collected.full(model)
        kept = np.concatenate([model.A, model.B], axis=2).any(axis=0)[model.plant_states :]
        found.append((joint, carried, by_AB * kept, by_H * (model.H != 0.0)))
    for one, many in zip(*found, strict=True):
        np.testing.assert_allclose(one, many, rtol=1e-11, atol=1e-11 * np.abs(one).max())


def test_networks_of_40_nodes_have_many_groups_of_rows_and_those_of_4_have_one() -> None:
    for n, many in ((4, False), (40, True)):
        problem = banded(n, seed=1)
        products = Operator(error_model(problem, *consensus_gains(problem))).products
        assert (len(products.pattern.rows) > 1) == many


def test_the_noises_have_mean_0_and_the_matrices_that_the_model_names(real: Network) -> None:
    """[A_k B_k] = [A B] + sum of (theta_j - beta_j) F_j + sum of xi_l V_l; its mean is [A B]."""
    problem, K_bar, H_bar = real
    model = error_model(problem, K_bar, H_bar)
    for s in range(model.modes):
        mean = np.zeros((model.size, model.size + model.nw))
        for chance, theta, delivered in outcomes(problem):
            AB = np.hstack([model.A[s], model.B[s]])
            AB += sum((theta - problem.beta)[j] * model.F_i(s, j) for j in range(problem.n))
            if model.links is not None:
                for term in np.flatnonzero(model.links.mode == s):
                    i, j = model.links.receiver[term], model.links.sender[term]
                    xi = delivered[i, j] - problem.delivery[i, j]
                    xi *= (theta - problem.beta)[j] if model.links.with_loss[term] else 1.0
                    AB += xi * model.V_l(term)
            np.testing.assert_allclose(realised(model, s, theta, delivered), AB, atol=1e-12)
            mean += chance * AB
        np.testing.assert_allclose(mean, np.hstack([model.A[s], model.B[s]]), atol=1e-12)


def test_carrying_a_covariance_forward_is_the_adjoint_of_weighing_it_back(real: Network) -> None:
    """sum_s tr(Y(s) carry(J)(s)) = sum_s tr(joint(Y_bar)(s) J(s))."""
    model = error_model(*real)
    operator, rng = Operator(model), np.random.default_rng(3)
    Y, J = (rng.normal(size=(model.modes, m, m)) for m in (model.size, model.size + model.nw))
    Y, J = Y @ Y.swapaxes(1, 2), J @ J.swapaxes(1, 2)
    forward, back = (Y * operator.carry(J)).sum(), (operator.joint(operator.bar(Y)) * J).sum()
    assert forward == pytest.approx(back, rel=1e-12)


@pytest.mark.parametrize("unbiased", [False, True])
def test_a_loss_that_never_happens_may_be_seen_or_hidden(unbiased: bool) -> None:
    """beta = 1: the same errors. A link that delivers always: as if it were not listed."""
    base = random_problem(1, lossy=False)
    K_bar, H_bar = random_gains(real_network(base, unbiased=unbiased), 1)
    plain = error_model(real_network(base, unbiased=unbiased), K_bar, H_bar)
    seen, delivered = (real_network(base, unbiased=unbiased, **more) for more in ({"seen": True}, {"delivery": 1.0}))
    for other in (seen, delivered):
        model = error_model(other, K_bar, H_bar)
        assert model.links is None
        np.testing.assert_array_equal(model.A, plain.A)
        np.testing.assert_array_equal(model.B, plain.B)
        joints = [Operator(each).joint(np.eye(each.size)[None].repeat(each.modes, 0)) for each in (model, plain)]
        np.testing.assert_array_equal(*joints)


def test_unbiased_gains_leave_x_out_of_the_errors_where_every_loss_is_seen() -> None:
    """With x carried along, its columns in the rows of e are 0, and the rest is the model without x."""
    base = random_problem(3)
    free = real_network(base, seen=True)
    problem = real_network(base, seen=True, unbiased=True)
    K_bar, H_bar = random_gains(problem, 3)
    with_x, without = error_model(free, K_bar, H_bar), error_model(problem, K_bar, H_bar)
    nx = problem.nx
    assert (with_x.plant_states, without.plant_states) == (nx, 0)
    for s in range(with_x.modes):
        for theta in product([0.0, 1.0], repeat=problem.n):
            AB, AB_e = (realised(model, s, np.array(theta)) for model in (with_x, without))
            np.testing.assert_allclose(AB[nx:, :nx], 0.0, atol=1e-12)
            np.testing.assert_allclose(AB[nx:, nx:], AB_e, atol=1e-12)


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
