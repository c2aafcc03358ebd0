"""The built-in problems: found by name, and right by their own sources."""

from __future__ import annotations

import math
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from places import ROOT

from agent.contract.arrays import Array
from agent.contract.errors import InputError
from agent.contract.problem import Problem
from designer.model.error_model import error_model, step
from designer.problems import find, names
from designer.proof.certificate import verify
from designer.search.starts import least_variance_gains
from designer.synthesis import design


def test_every_built_in_problem_loads_under_its_own_name() -> None:
    """A name finds the problem that calls itself so."""
    assert {"zhu2020-ideal", "zhu2020-lossy", "two-nodes", "quadruple-tank", "inverted-pendulum"} <= set(names())
    for name in names():
        assert find(name).name == name


def test_a_path_finds_a_problem_file(tmp_path: Path) -> None:
    """find takes a path where the text is no built-in name."""
    path = tmp_path / "mine.toml"
    path.write_text((ROOT / "designer/problems/two-nodes.toml").read_text())
    assert find(str(path)) == find("two-nodes")


def test_an_unknown_name_lists_the_built_in_ones() -> None:
    """What is neither a path nor a name is bad input, and the answer lists the names."""
    with pytest.raises(InputError, match=r'"zhu2021" is neither.*"quadruple-tank".*"zhu2020-lossy"'):
        find("zhu2021")


def test_two_nodes_by_hand() -> None:
    """gamma^2 = 2 in rational arithmetic, as the file's comment derives it, with nothing of the code's own."""
    A, B, C = Fraction(3, 4), Fraction(4, 5), (Fraction(3, 5), Fraction(9, 20))
    P = Fraction(1)
    S = 1 + (C[0] ** 2 + C[1] ** 2) * P
    assert A * A * P / S + B * B == P  # the Riccati equation of the best central filter: gamma^2 >= 2 P
    H = [A * P * C_j / S for C_j in C]
    K = [Fraction(24, 100) + H_j * C_j for H_j, C_j in zip(H, C, strict=True)]
    assert (H, K, sum(K)) == (
        [Fraction(288, 1000), Fraction(216, 1000)],
        [Fraction(4128, 10000), Fraction(3372, 10000)],
        A,
    )
    q = Fraction(1, 2)
    on_e = sum((K_j - H_j * C_j) ** 2 for K_j, H_j, C_j in zip(K, H, C, strict=True)) / q
    on_w = B * B + H[0] ** 2 + H[1] ** 2
    assert 2 * q * (on_e + on_w) == 1  # (17) with equality: gamma^2 <= 1 / q


def test_two_nodes_is_designed_to_the_value_found_by_hand() -> None:
    """Theorem 2 attains sqrt 2; no confirmed gamma lies below it."""
    for method in ("theorem2", "theorem2-reduced"):
        gamma = design(find("two-nodes"), method=method).certificate.gamma
        assert math.sqrt(2.0) <= gamma <= math.sqrt(2.0) * (1.0 + 1e-4)


def exponential(matrix: Array) -> Array:
    """exp(matrix) by its series, after halving it ten times."""
    small, term, total = matrix / 2.0**10, np.eye(len(matrix)), np.eye(len(matrix))
    for k in range(1, 20):
        term = term @ small / k
        total = total + term
    for _ in range(10):
        total = total @ total
    return np.asarray(total)


def test_quadruple_tank_is_johanssons_process_sampled() -> None:
    """A, B and the flow meters follow from the published constants, to the six decimals that the file keeps."""
    area, hole = np.array([28.0, 32.0, 28.0, 32.0]), np.array([0.071, 0.057, 0.071, 0.057])
    level, gravity, k1, k2, valve1, valve2 = np.array([12.4, 12.7, 1.8, 1.4]), 981.0, 3.33, 3.35, 0.70, 0.60
    T = area / hole * np.sqrt(2.0 * level / gravity)
    np.testing.assert_array_equal(np.floor(T + 0.02), [62, 90, 23, 30])  # the paper prints T without decimals
    A, B = np.diag(-1.0 / T), np.zeros((4, 2))
    A[0, 2], A[1, 3] = area[2] / (area[0] * T[2]), area[3] / (area[1] * T[3])
    B[0, 0], B[1, 1] = valve1 * k1 / area[0], valve2 * k2 / area[1]
    B[2, 1], B[3, 0] = (1.0 - valve2) * k2 / area[2], (1.0 - valve1) * k1 / area[3]
    sampled = exponential(10.0 * np.block([[A, B], [np.zeros((2, 6))]]))
    problem = find("quadruple-tank")
    np.testing.assert_allclose(problem.plant.A, sampled[:4, :4], rtol=0.0, atol=5.1e-7)
    np.testing.assert_allclose(problem.plant.B[:, :2], sampled[:4, 4:], rtol=0.0, atol=5.1e-7)
    flows = np.vstack([problem.nodes[i].C for i in (4, 5)])
    expected = np.diag(area / T)[[0, 2, 1, 3]]
    np.testing.assert_allclose(flows, expected, rtol=0.0, atol=5.1e-5)


def test_quadruple_tank_is_designed_and_confirmed() -> None:
    """Six nodes with one or two measurements, four states, three topologies: certified within 1e-3 of the optimum."""
    problem: Problem = find("quadruple-tank")
    assert (problem.n, problem.nx, len(problem.topologies)) == (6, 4, 3)
    gains = design(problem, method="theorem2-reduced")
    assert verify(gains).holds
    assert gains.certificate.by_theorem1 == pytest.approx(gains.certificate.lmi_gamma, rel=1e-3)


def test_inverted_pendulum_is_a_rod_on_a_hinge_sampled() -> None:
    """A and B follow from the length of the rod and g, to the six decimals that the file keeps."""
    k = 3.0 * 9.81 / (2.0 * 2.0)
    continuous = np.array([[0.0, 1.0, 0.0], [k, 0.0, 1000.0], [0.0, 0.0, 0.0]])
    sampled = exponential(0.02 * continuous)
    problem = find("inverted-pendulum")
    np.testing.assert_allclose(problem.plant.A, sampled[:2, :2], rtol=0.0, atol=5.1e-7)
    np.testing.assert_allclose(problem.plant.B[:, 0], sampled[:2, 2], rtol=0.0, atol=5.1e-7)
    assert np.abs(np.linalg.eigvals(problem.plant.A)).max() == pytest.approx(math.exp(math.sqrt(k) * 0.02), rel=1e-5)


def test_inverted_pendulum_is_designed_though_it_is_unstable() -> None:
    """Seen losses, lossy links, unbiased gains: floor <= exact gain <= the confirmed gamma of the LMI."""
    problem = find("inverted-pendulum")
    assert problem.unbiased
    assert problem.links
    assert not problem.carries_plant
    gains = design(problem, method="decomposed")
    proved = gains.certificate
    assert verify(gains).holds
    assert proved.exact is not None
    assert proved.floor is not None
    assert 0.0 < proved.floor <= proved.exact[1] <= proved.gamma * (1.0 + 1e-6)


def test_the_errors_of_the_inverted_pendulum_stay_exact_for_hundreds_of_steps() -> None:
    """x - x_hat of the filters and e of the error model differ by rounding, relative to x, which grows to 1e9."""
    problem = find("inverted-pendulum")
    K_bar, H_bar = least_variance_gains(problem)
    model = error_model(problem, K_bar, H_bar)
    rng, nx, plant = np.random.default_rng(0), problem.nx, problem.plant
    x, x_hat, e = np.zeros(nx), np.zeros((problem.n, nx)), np.zeros(problem.n * nx)
    s, rho = 0, problem.delivery
    for _ in range(400):
        w = 0.2 * rng.normal(size=problem.nw)
        theta = (rng.uniform(size=problem.n) < problem.beta).astype(float)
        came = rng.uniform(size=rho.shape) < rho
        nu = [theta[j] * (node.C @ (x - x_hat[j]) + node.D @ w) for j, node in enumerate(problem.nodes)]
        x_hat_next = np.zeros_like(x_hat)
        for i in range(problem.n):
            for j in problem.neighbours(s, i):
                K_ij, H_ij = K_bar[s, i * nx : (i + 1) * nx, j * nx : (j + 1) * nx], H_bar[s, i * nx : (i + 1) * nx, j]
                x_hat_next[i] += K_ij @ x_hat[j] + H_ij * nu[j] if came[i, j] else K_ij @ x_hat[i]
        e = step(model, s, theta, e, w, came)
        x, x_hat = plant.A @ x + plant.B @ w, x_hat_next
        s = int(rng.choice(len(problem.topologies), p=problem.markov.transition[s]))
    size = np.abs(x).max()
    assert size > 1e6
    np.testing.assert_allclose((x - x_hat).ravel(), e, rtol=0.0, atol=1e-13 * size)
    assert np.abs(e).max() < 1e-4 * size
