"""The exact gain against independent formulations: enumeration of all paths, a Gramian, moments, a page of algebra."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from networks import random_gains, random_problem

from agent.contract.arrays import Array
from agent.contract.problem import Problem
from designer.back_off import inequality_17
from designer.consensus import consensus_gains
from designer.error_model import ErrorModel, error_model, link_gains, paper_error_model
from designer.exact_certificate import check_exact
from designer.floor import floor
from designer.gain import Operator, exact_gain, horizon_gain
from designer.problems import find
from designer.sensitivity import gain_slope
from designer.worst_case import Policy, path_gain, worst_disturbance, worst_policy

Case = tuple[Problem, Array, Array]


def random_case(seed: int, *, lossy: bool = True, modes: int = 2, n: int = 3, nw: int = 2) -> Case:
    problem = random_problem(seed, n=n, modes=modes, lossy=lossy, nw=nw)
    return problem, *random_gains(problem, seed, size=0.2)


def lossy_example() -> Case:
    problem = find("zhu2020-lossy")
    return problem, *consensus_gains(problem, weight=0.3)


CASES = [random_case(1), random_case(2, nw=1), lossy_example()]


def gamma_T(model: ErrorModel, horizon: int, *, width: float = 1e-10) -> float:
    return math.sqrt(horizon_gain(Operator(model), horizon, width=width)[1])


class Histories:
    """Every path of modes and losses, with a w of its own for every history r(0..k), theta(0..k-1)."""

    def __init__(self, model: ErrorModel, initial: int, horizon: int) -> None:
        lossy = np.flatnonzero(model.alpha > 0.0)
        self.probability, mode = np.ones(1), np.array([initial])
        self.responses: list[Array] = []  # of eta to each w so far, (histories, n_eta, nw)
        self.owners: list[Array] = []  # which w of its step each history has
        self.energies: list[Array] = []  # the probability of each history of a step
        for k in range(horizon):
            self.owners.append(np.arange(len(mode)))
            self.energies.append(self.probability)
            branches = []
            for arrived in itertools.product((0.0, 1.0), repeat=len(lossy)):
                theta = model.beta.copy()
                theta[lossy] = arrived
                chance = np.prod(np.where(theta[lossy] == 1.0, model.beta[lossy], 1.0 - model.beta[lossy]))
                A = np.array(
                    [
                        model.A[s] + sum((theta - model.beta)[i] * model.F_i(s, i)[:, : model.size] for i in lossy)
                        for s in mode
                    ]
                )
                for t in range(len(model.A)) if k < horizon - 1 else [None]:
                    moved = model.transition[mode, t] if t is not None else np.ones(len(mode))
                    branches.append((self.probability * chance * moved, A, t if t is not None else 0))
            fresh = model.B[mode]
            self.responses = [np.concatenate([A @ r for _, A, _ in branches]) for r in self.responses]
            self.responses.append(np.tile(fresh, (len(branches), 1, 1)))
            self.owners = [np.tile(owner, len(branches)) for owner in self.owners]
            self.probability = np.concatenate([p for p, _, _ in branches])
            mode = np.concatenate([np.full(len(fresh), t) for _, _, t in branches])
        self.outputs = [model.M @ r for r in self.responses]

    def gain(self) -> float:
        """sqrt of the largest E|z_tilde(T)|^2 / E sum |w|^2: Lanczos, each vector made orthogonal to all before it."""
        sizes = [len(energy) * self.outputs[0].shape[2] for energy in self.energies]
        q = np.random.default_rng(0).normal(size=sum(sizes))
        basis = np.zeros((len(q), min(len(q), 150 if len(q) < 1000 else 20)))
        images = np.zeros_like(basis)
        for m in range(basis.shape[1]):
            for _ in range(2):
                q -= basis @ (basis.T @ q)
            basis[:, m] = q / np.linalg.norm(q)
            images[:, m] = q = self.weighed(basis[:, m])
        return math.sqrt(float(np.linalg.eigvalsh(basis.T @ images).max()))

    def weighed(self, q: Array) -> Array:
        """The quadratic form E|z_tilde(T)|^2 times q, q = all w, scaled so that its energy is E sum |w|^2."""
        roots = [np.sqrt(energy)[:, None] for energy in self.energies]
        nw = self.outputs[0].shape[2]
        parts = np.split(q, np.cumsum([len(root) * nw for root in roots])[:-1])
        scaled = [part.reshape(-1, nw) / root for part, root in zip(parts, roots, strict=True)]
        z = sum((G @ w[owner][:, :, None]) for G, w, owner in zip(self.outputs, scaled, self.owners, strict=True))
        pulled = []
        for G, owner, root in zip(self.outputs, self.owners, roots, strict=True):
            back = self.probability[:, None] * (G.swapaxes(1, 2) @ z)[:, :, 0]
            gathered = [np.bincount(owner, weights=column, minlength=len(root)) for column in back.T]
            pulled.append((np.array(gathered).T / root).ravel())
        return np.concatenate(pulled)


@pytest.mark.parametrize("horizon", [1, 2, 3])
@pytest.mark.parametrize("case", CASES)
def test_the_recursion_agrees_with_every_path_and_one_w_for_each_history(case: Case, horizon: int) -> None:
    """gamma_T is the largest eigenvalue of a quadratic form with a variable for each history."""
    model = error_model(*case)
    enumerated = max(Histories(model, initial, horizon).gain() for initial in range(len(model.A)))
    assert gamma_T(model, horizon) == pytest.approx(enumerated, rel=1e-7)


def test_without_switching_and_loss_the_gain_is_that_of_the_gramian() -> None:
    """gamma^2 = lambda_max(M W M'), W = A W A' + B B'."""
    model = error_model(*random_case(3, lossy=False, modes=1))
    A, B = model.A[0], model.B[0]
    vectorised = np.linalg.solve(np.eye(A.size) - np.kron(A, A), (B @ B.T).ravel())
    gramian = vectorised.reshape(A.shape)
    gamma = math.sqrt(np.linalg.eigvalsh(model.M @ gramian @ model.M.T).max())
    gain = exact_gain(model)
    assert gain.low <= gamma * (1.0 + 1e-12)
    assert gamma <= gain.high


def test_the_page_of_algebra_in_two_nodes_is_right() -> None:
    """The gains worked out in two-nodes.toml have the gain sqrt 2, which is the floor."""
    problem = find("two-nodes")
    K_bar, H_bar = (
        np.array([[[0.4128, 0.3372]] * 2]).reshape(1, 2, 2),
        np.array([[[0.288, 0.216]] * 2]).reshape(1, 2, 2),
    )
    gain = exact_gain(error_model(problem, K_bar, H_bar))
    assert gain.low <= math.sqrt(2.0) * (1.0 + 1e-9)
    assert math.sqrt(2.0) <= gain.high * (1.0 + 1e-12)
    assert floor(problem) == pytest.approx(math.sqrt(2.0), rel=1e-9)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_one_node_alone_attains_the_floor(seed: int) -> None:
    """One node, one mode, no loss: Riccati's predictor, w shared by plant and sensor, has gamma = floor."""
    problem = random_problem(seed, n=1, modes=1, nw=3)
    (A, B), (C, D) = (problem.plant.A, problem.plant.B), (problem.nodes[0].C, problem.nodes[0].D)
    P = np.zeros_like(A)
    for _ in range(2000):
        cross = A @ P @ C.T + B @ D.T
        L = cross @ np.linalg.inv(C @ P @ C.T + D @ D.T)
        P = A @ P @ A.T + B @ B.T - L @ cross.T
    gain = exact_gain(error_model(problem, A[None], L[None]))
    assert floor(problem) == pytest.approx(math.sqrt(np.linalg.eigvalsh(problem.plant.M @ P @ problem.plant.M.T).max()))
    assert gain.low <= floor(problem) * (1.0 + 1e-9)
    assert floor(problem) <= gain.high * (1.0 + 1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_no_gains_are_below_the_floor(seed: int) -> None:
    """Not with switching and losses either."""
    case = random_case(seed, n=2, modes=3, nw=5)
    assert floor(case[0]) < exact_gain(error_model(*case)).high


def test_a_sensor_that_is_there_twice_does_not_raise_or_lower_the_floor() -> None:
    """Rows of [C S, D] that depend on each other are one measurement; only the number of nodes counts."""
    document = random_problem(4, n=1, modes=1, nw=3).document()
    twin = document["node"][0] | {"name": "twin", "C": (3.0 * np.array(document["node"][0]["C"])).tolist()}
    twin["D"] = (3.0 * np.array(document["node"][0]["D"])).tolist()
    doubled = document | {
        "node": [document["node"][0], twin],
        "topology": [{"name": "m0", "adjacency": [[1.0, 1.0], [1.0, 1.0]]}],
    }
    assert floor(Problem.from_document(doubled)) == pytest.approx(
        math.sqrt(2.0) * floor(Problem.from_document(document)), rel=1e-9
    )


@pytest.mark.parametrize("case", CASES)
def test_the_interval_closes_on_what_longer_horizons_show(case: Case) -> None:
    """gamma_T rises with T, and gamma_400 is in the interval, which is 1e-6 wide at most."""
    model = error_model(*case)
    gain = exact_gain(model)
    rising = [gamma_T(model, horizon) for horizon in (1, 2, 4, 8, 16, 32)]
    assert rising == sorted(rising)
    assert rising[-1] <= gain.high
    assert gain.low * (1.0 - 1e-9) <= gamma_T(model, 400, width=4e-7) <= gain.high * (1.0 + 4e-7)
    assert 0.0 < gain.high - gain.low <= 1e-6 * gain.high
    assert gain.stable


@pytest.mark.parametrize("case", CASES)
def test_the_printed_state_has_the_same_gain(case: Case) -> None:
    """eta = [1 kron x; e] of (10) as printed and the reduced eta = [x; e]."""
    reduced, printed = exact_gain(error_model(*case)), exact_gain(paper_error_model(*case))
    assert printed.low == pytest.approx(reduced.low, rel=2e-6)


@pytest.mark.parametrize("case", CASES)
def test_P_satisfies_17_strictly_and_the_check_confirms_no_less(case: Case) -> None:
    """The certificate holds at the upper end, fails 1e-6 below it, and fails for other gains, P or horizon."""
    problem, K_bar, H_bar = case
    model = error_model(*case)
    gain = exact_gain(model)
    assert gain.P is not None
    P, horizon, gamma = gain.P, gain.horizon, gain.high
    assert np.linalg.eigvalsh(inequality_17(model, P)).min() > 0.0
    K, H = link_gains(*case)
    verdict = check_exact(problem, K, H, P=P, gamma=gamma, horizon=horizon)
    assert verdict.holds, verdict.failure
    assert min(verdict.margins.values()) > 0.0
    other = link_gains(problem, K_bar, 1.001 * H_bar)
    mutants = {
        "recursion": check_exact(problem, K, H, P=P, gamma=gamma * (1.0 - 1e-6), horizon=horizon),
        "(17)": check_exact(problem, K, H, P=1.01 * P, gamma=gamma, horizon=horizon),
        "tail": check_exact(problem, K, H, P=P, gamma=gamma, horizon=1),
        "recursion fails in": check_exact(problem, *other, P=P / 1.1, gamma=gamma / 1.01, horizon=horizon),
    }
    for name, mutant in mutants.items():
        assert not mutant.holds
        assert mutant.failure is not None
        assert mutant.failure.startswith((name, "recursion"))


def spectral_radius(model: ErrorModel) -> float:
    """Of L, by its matrix."""
    operator, size = Operator(model), model.A.shape[1]
    units = np.eye(len(model.A) * size * size).reshape(-1, len(model.A), size, size)
    matrix = np.array([operator.corner(unit).ravel() for unit in units])
    return float(np.abs(np.linalg.eigvals(matrix)).max())


@pytest.mark.parametrize("growth", [0.98, 1.02, 1.5])
def test_gains_that_are_not_mean_square_stable_are_recognised(growth: float) -> None:
    """The answer is a value: no finite bound, no P, and the spectral radius of the coupled operator."""
    problem, K_bar, H_bar = random_case(6)
    scale = 1.0
    for _ in range(60):  # the radius of K_bar and H_bar together, by bisection of their scale in logarithms
        radius = spectral_radius(error_model(problem, scale * K_bar, scale * H_bar))
        scale *= (growth / radius) ** 0.5 if abs(radius - growth) > 1e-6 else 1.0
    gain = exact_gain(error_model(problem, scale * K_bar, scale * H_bar))
    assert gain.radius == pytest.approx(growth, rel=0.01)
    assert gain.stable == (growth < 1.0)
    assert math.isfinite(gain.high) == gain.stable
    assert (gain.P is not None) == gain.stable
    assert gain.low > 0.0


@pytest.mark.parametrize("case", CASES)
def test_the_gradient_agrees_with_differences(case: Case) -> None:
    """d gamma_T along random directions of K_bar and H_bar."""
    problem, K_bar, H_bar = case
    slope = gain_slope(problem, K_bar, H_bar, horizon=12)
    rng = np.random.default_rng(0)
    for _ in range(3):
        dK, dH = rng.normal(size=K_bar.shape), rng.normal(size=H_bar.shape)
        step = 1e-6
        plus = gamma_T(error_model(problem, K_bar + step * dK, H_bar + step * dH), 12, width=1e-12)
        minus = gamma_T(error_model(problem, K_bar - step * dK, H_bar - step * dH), 12, width=1e-12)
        expected = float((slope.K_bar * dK).sum() + (slope.H_bar * dH).sum())
        assert (plus - minus) / (2.0 * step) == pytest.approx(expected, rel=1e-4, abs=1e-5)


def moved(model: ErrorModel, X: Array) -> Array:
    """Second moments, by mode, one step later; X (modes, n_eta, n_eta) are those of [A B][eta; w] before the loss."""
    return np.einsum("st,sij->tij", model.transition, X)


def attained(model: ErrorModel, policy: Policy) -> float:
    """sqrt(E|z_tilde|^2 / energy of w) of a policy, from its second moments."""
    size = model.A.shape[1]
    X = np.zeros((len(model.A), size, size))
    energy = float(policy.u @ policy.u)
    kick = model.B[policy.mode] @ policy.u
    X[policy.mode] = np.outer(kick, kick)
    X = moved(model, X)
    for Gamma in policy.Gamma:
        energy += sum(float(np.trace(Gamma[s] @ X[s] @ Gamma[s].T)) for s in range(len(X)))
        closed = [
            (model.A[s] + model.B[s] @ Gamma[s]) @ X[s] @ (model.A[s] + model.B[s] @ Gamma[s]).T
            + sum(
                model.alpha[i] * model.F_i(s, i)[:, : model.size] @ X[s] @ model.F_i(s, i)[:, : model.size].T
                for i in range(len(model.alpha))
            )
            for s in range(len(X))
        ]
        X = moved(model, np.array(closed))
    return math.sqrt(float(np.trace(model.M @ X.sum(axis=0) @ model.M.T)) / energy)


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("horizon", [1, 3, 20])
def test_the_worst_policy_attains_gamma_T(case: Case, horizon: int) -> None:
    """Second moments under the policy, with no sampling."""
    model = error_model(*case)
    policy = worst_policy(model, horizon=horizon)
    assert attained(model, policy) == pytest.approx(policy.gamma, rel=1e-6)


@pytest.mark.parametrize("case", CASES)
def test_the_worst_fixed_disturbance_has_the_gain_it_says(case: Case) -> None:
    """First and second moments for that w; no other w of its length does more; and it is below the exact gain."""
    model = error_model(*case)
    worst = worst_disturbance(model, initial=1, horizon=15)
    assert float((worst.w**2).sum()) == pytest.approx(1.0)
    assert peak(model, worst.w, initial=1) == pytest.approx(worst.gain, rel=1e-9)
    assert worst.gain < exact_gain(model).high
    rng = np.random.default_rng(0)
    for _ in range(20):
        w = worst.w + 0.3 * rng.normal(size=worst.w.shape)
        assert peak(model, w / np.linalg.norm(w), initial=1) <= worst.gain * (1.0 + 1e-12)


def peak(model: ErrorModel, w: Array, *, initial: int) -> float:
    """sqrt(E|z_tilde(T)|^2) for a fixed w (T, nw), by the moments of [eta; 1] in every mode."""
    size, modes = model.A.shape[1], len(model.A)
    X = np.zeros((modes, size + 1, size + 1))
    X[initial, size, size] = 1.0
    for w_k in w:
        following = np.zeros_like(X)
        for s in range(modes):
            step = np.eye(size + 1)
            step[:size, :size], step[:size, size] = model.A[s], model.B[s] @ w_k
            after = step @ X[s] @ step.T
            for i, alpha_i in enumerate(model.alpha):
                F_i = model.F_i(s, i)[:, : model.size]
                after[:size, :size] += alpha_i * F_i @ X[s, :size, :size] @ F_i.T
            following += model.transition[s][:, None, None] * after
        X = following
    return math.sqrt(float(np.trace(model.M @ X[:, :size, :size].sum(axis=0) @ model.M.T)))


def test_the_path_gain_bounds_its_own_run_and_is_attained() -> None:
    """For one realised path it is the norm of the map from w to z_tilde(k)."""
    model = error_model(*random_case(8))
    rng = np.random.default_rng(1)
    modes = rng.integers(0, 2, size=9).tolist()
    theta = np.where(model.alpha > 0.0, rng.integers(0, 2, size=(9, len(model.beta))), 1.0)
    response = np.zeros((model.A.shape[1], 0))
    expected = [0.0]
    for s, theta_k in zip(modes, theta, strict=True):
        A_k = model.A[s] + sum(
            (theta_k - model.beta)[i] * model.F_i(s, i)[:, : model.size] for i in range(len(model.beta))
        )
        response = np.hstack([A_k @ response, model.B[s]])
        expected.append(np.linalg.norm(model.M @ response, ord=2))
    np.testing.assert_allclose(path_gain(model, modes, theta), expected, rtol=1e-9)
