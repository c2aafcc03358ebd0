"""The exact gain against independent formulations: enumeration of all paths, a Gramian, moments, a page of algebra."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from networks import random_gains, random_problem, real_network, real_networks

from agent.contract.arrays import Array
from agent.contract.problem import Problem
from designer.gain import exact
from designer.gain.exact import InvariantSet, Operator, exact_gain, horizon_gain, recursion_holds, step
from designer.gain.floor import floor
from designer.gain.sensitivity import gain_slope
from designer.gain.worst_case import Policy, path_gain, worst_disturbance, worst_policy
from designer.invariants import Invariants, invariants
from designer.lmi.back_off import inequality_17
from designer.model.error_model import ErrorModel, error_model, link_gains, paper_error_model, realised
from designer.problems import find
from designer.proof.prover import Prover
from designer.search.entries import Entries
from designer.search.starts import consensus_gains, least_variance_gains

Case = tuple[Problem, Array, Array]


def random_case(seed: int, *, lossy: bool = True, modes: int = 2, n: int = 3, nw: int = 2) -> Case:
    problem = random_problem(seed, n=n, modes=modes, lossy=lossy, nw=nw)
    return problem, *random_gains(problem, seed, size=0.2)


def lossy_example() -> Case:
    problem = find("zhu2020-lossy")
    return problem, *consensus_gains(problem, weight=0.3)


def real_case(kind: str, seed: int) -> Case:
    """Gains at random; where they have to be unbiased, a start of the descent, so that they are stable."""
    problem = real_networks(seed)[kind]
    return problem, *(least_variance_gains(problem) if problem.unbiased else random_gains(problem, seed, size=0.2))


CASES = [random_case(1), random_case(2, nw=1), lossy_example()]
KINDS = sorted(real_networks(0))
REAL = [pytest.param(real_case(kind, seed), id=kind) for seed, kind in enumerate(KINDS)]


def gamma_T(model: ErrorModel, horizon: int, *, width: float = 1e-10) -> float:
    return math.sqrt(horizon_gain(Operator(model), horizon, width=width)[1])


def chances(model: ErrorModel) -> list[tuple[float, Array, Array]]:
    """Every outcome of losses and deliveries in one step: its probability, theta (n,), delivered (n, n)."""
    n, links = len(model.beta), model.links
    lossy = np.flatnonzero(model.alpha > 0.0)
    rho = {} if links is None else dict(zip(zip(links.receiver, links.sender, strict=True), links.rho, strict=True))
    found = []
    for outcome in itertools.product((False, True), repeat=len(lossy) + len(rho)):
        theta, delivered, chance = np.ones(n), np.ones((n, n), dtype=bool), 1.0
        for i, arrived in zip(lossy, outcome, strict=False):
            theta[i] = float(arrived)
            chance *= model.beta[i] if arrived else 1.0 - model.beta[i]
        for (link, rho_ij), came in zip(rho.items(), outcome[len(lossy) :], strict=True):
            delivered[link] = came
            chance *= rho_ij if came else 1.0 - rho_ij
        found.append((float(chance), theta, delivered))
    return found


class Histories:
    """Every path of modes, losses and deliveries, with a w of its own for every history before the step."""

    def __init__(self, model: ErrorModel, initial: int, horizon: int) -> None:
        outcomes, size = chances(model), model.size
        self.probability, mode = np.ones(1), np.array([initial])
        self.responses: list[Array] = []  # of eta to each w so far, (histories, n_eta, nw)
        self.owners: list[Array] = []  # which w of its step each history has
        self.energies: list[Array] = []  # the probability of each history of a step
        for k in range(horizon):
            self.owners.append(np.arange(len(mode)))
            self.energies.append(self.probability)
            branches = []
            for chance, theta, delivered in outcomes:
                AB = np.array([realised(model, s, theta, delivered) for s in range(model.modes)])[mode]
                for t in range(model.modes) if k < horizon - 1 else [None]:
                    moved = model.transition[mode, t] if t is not None else np.ones(len(mode))
                    branches.append((self.probability * chance * moved, AB, t if t is not None else 0))
            self.responses = [np.concatenate([AB[:, :, :size] @ r for _, AB, _ in branches]) for r in self.responses]
            self.responses.append(np.concatenate([AB[:, :, size:] for _, AB, _ in branches]))
            self.owners = [np.tile(owner, len(branches)) for owner in self.owners]
            self.probability = np.concatenate([p for p, _, _ in branches])
            mode = np.concatenate([np.full(len(mode), t) for _, _, t in branches])
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


@pytest.mark.parametrize(
    ("case", "horizon"),
    [
        *itertools.product(CASES, (1, 2, 3)),
        *[pytest.param(*case.values, horizon, id=f"{case.id}-{horizon}") for case in REAL for horizon in (1, 2)],
    ],
)
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


@pytest.mark.parametrize("case", [*CASES, *REAL])
def test_the_interval_closes_on_what_longer_horizons_show(case: Case) -> None:
    """gamma_T rises with T, and gamma_400 is in the interval, which is 1e-6 wide at most."""
    model = error_model(*case)
    gain = exact_gain(model)
    rising = [gamma_T(model, horizon) for horizon in (1, 2, 4, 8, 16, 32)]
    assert all(longer >= shorter * (1.0 - 1e-9) for shorter, longer in pairwise(rising))
    assert rising[-1] <= gain.high * (1.0 + 1e-9)
    assert gain.low * (1.0 - 1e-9) <= gamma_T(model, 400, width=4e-7) <= gain.high * (1.0 + 4e-7)
    assert 0.0 < gain.high - gain.low <= 1e-6 * gain.high
    assert gain.stable


@pytest.mark.parametrize("case", CASES[:2])
def test_the_interval_of_a_large_network_is_wider_and_holds_the_gain(
    case: Case, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = error_model(*case)
    gain = exact_gain(model)
    monkeypatch.setattr(exact, "_LARGE", 1)
    wider = exact_gain(model)
    assert wider.low <= gain.high
    assert gain.low <= wider.high
    assert gain.high - gain.low < wider.high - wider.low <= 1e-4 * wider.high


@pytest.mark.parametrize("case", [*CASES, *REAL])
def test_a_sweep_that_ends_in_the_invariant_set_ends_as_a_long_one_does(case: Case) -> None:
    """At every g the answer is that of 400 steps; and (17) for a larger P would be false, so a larger set is none."""
    model = error_model(*case)
    operator, gain = Operator(model), exact_gain(model)
    assert gain.P is not None
    invariant, larger = InvariantSet(gain.P), InvariantSet(1e6 * gain.P)
    g = gain.low**2
    for factor in (0.5, 0.9, 1.0 - 1e-3, 1.0 - 1e-6, 1.0 + 2e-6, 1.0 + 1e-3, 1.1, 2.0, 10.0):
        early = recursion_holds(operator, factor * g, 400, invariant=invariant)
        late = recursion_holds(operator, factor * g, 400)
        assert early.holds == late.holds == (factor > 1.0)
        assert early.steps <= late.steps
    assert recursion_holds(operator, g * (1.0 - 1e-3), 400, invariant=larger).holds


@pytest.mark.parametrize("case", CASES)
def test_a_search_whose_sweeps_end_too_soon_leaves_its_interval_wider_and_true(case: Case) -> None:
    """Of a few steps at most, those near gamma do not come to their end; for a tiny P none does that is not far off."""
    model = error_model(*case)
    operator, gain = Operator(model), exact_gain(model)
    assert gain.P is not None
    for steps, part in itertools.product((1, 3, 10), (1.0, 1e-9, 1e-20)):
        found = exact._bracket(operator, steps, InvariantSet(part * gain.P), 1e-6)
        assert 0.0 < found.low <= gain.high**2
        assert gain.low**2 <= found.high < math.inf
        assert found.high > 1.0001 * found.low


@pytest.mark.parametrize("case", CASES)
def test_the_invariant_set_has_all_Y_up_to_gP_that_it_says_it_has(case: Case) -> None:
    """One step from g P leads to no more than g P; what the set contains is below g P in every direction."""
    model = error_model(*case)
    P = exact_gain(model).P
    assert P is not None
    invariant, operator, rng = InvariantSet(P), Operator(model), np.random.default_rng(0)
    taken = step(operator, 3.0 * P, 3.0)
    assert taken is not None
    assert np.linalg.eigvalsh(3.0 * P - taken.Y).min() > 0.0
    for _ in range(20):
        factor = rng.normal(size=P.shape)
        Y = factor @ factor.swapaxes(1, 2)
        assert not invariant.contains(Y, 0.999 * float(np.linalg.eigvals(np.linalg.solve(P, Y)).real.max()))
        g = 1.001 * float(np.trace(np.linalg.solve(P, Y), axis1=1, axis2=2).sum())
        assert invariant.contains(Y, g)
        assert np.linalg.eigvalsh(g * P - Y).min() > 0.0


@pytest.mark.parametrize("case", [random_case(2, nw=1), lossy_example()])
def test_a_disturbance_that_moves_nothing_changes_nothing(case: Case) -> None:
    """One w: its W are numbers, and nothing is factored. With a second that has no effect they are matrices."""
    model = error_model(*case)
    none = np.zeros((model.modes, model.size, 1))
    more = replace(
        model, B=np.concatenate([model.B, none], axis=2), R=np.hstack([model.R, np.zeros((len(model.R), 1))])
    )
    assert (model.nw, more.nw) == (1, 2)
    gain, other = exact_gain(model), exact_gain(more)
    assert gain.horizon == other.horizon
    assert gain.bounds == pytest.approx(other.bounds, rel=1e-6)


def test_errors_that_nothing_moves_have_the_gain_0() -> None:
    model = error_model(*lossy_example())
    gain = exact_gain(replace(model, M=np.zeros_like(model.M)))
    assert gain.low == 0.0
    assert gain.high < 1e-150


@pytest.mark.parametrize("case", CASES)
def test_the_printed_state_has_the_same_gain(case: Case) -> None:
    """eta = [1 kron x; e] of (10) as printed and the reduced eta = [x; e]."""
    reduced, printed = exact_gain(error_model(*case)), exact_gain(paper_error_model(*case))
    assert printed.low == pytest.approx(reduced.low, rel=2e-6)


@pytest.mark.parametrize("case", CASES)
def test_P_satisfies_17_strictly_and_the_check_confirms_no_less(case: Case) -> None:
    """The certificate holds at the upper end, fails 1e-6 below it, and fails for other gains or another P."""
    problem, K_bar, H_bar = case
    model = error_model(*case)
    gain = exact_gain(model)
    assert gain.P is not None
    P, gamma = gain.P, gain.high
    assert np.linalg.eigvalsh(inequality_17(model, P)).min() > 0.0
    K, H = link_gains(*case)
    verdict = Prover(problem, K, H, P=P).exact(gamma)
    assert verdict.holds, verdict.failure
    assert min(verdict.margins.values()) > 0.0
    other = link_gains(problem, K_bar, 1.001 * H_bar)
    mutants = {
        "recursion": Prover(problem, K, H, P=P).exact(gamma * (1.0 - 1e-6)),
        "(17)": Prover(problem, K, H, P=1.01 * P).exact(gamma),
        "recursion fails in": Prover(problem, *other, P=P / 1.1).exact(gamma / 1.01),
    }
    for name, mutant in mutants.items():
        assert not mutant.holds
        assert mutant.failure is not None
        assert mutant.failure.startswith(name)


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


@pytest.mark.parametrize("case", [*CASES, *REAL])
def test_the_gradient_agrees_with_differences(case: Case) -> None:
    """d gamma_T along random directions of the gains; unbiased ones stay so."""
    problem, K_bar, H_bar = case
    slope, entries = gain_slope(problem, K_bar, H_bar, horizon=5), Entries(problem)
    v, rng, step = entries.pack(K_bar, H_bar), np.random.default_rng(0), 1e-6
    for _ in range(3):
        direction = rng.normal(size=len(v))
        (K_plus, H_plus), (K_minus, H_minus) = (entries.unpack(v + sign * step * direction) for sign in (1.0, -1.0))
        plus = gamma_T(error_model(problem, K_plus, H_plus), 5, width=1e-12)
        minus = gamma_T(error_model(problem, K_minus, H_minus), 5, width=1e-12)
        dK, dH = (K_plus - K_minus) / (2.0 * step), (H_plus - H_minus) / (2.0 * step)
        expected = float((slope.K_bar * dK).sum() + (slope.H_bar * dH).sum())
        assert (plus - minus) / (2.0 * step) == pytest.approx(expected, rel=1e-4, abs=1e-5)
        along = float(entries.pack_slope(slope.K_bar, slope.H_bar) @ direction)
        assert along == pytest.approx(expected, rel=1e-9, abs=1e-9)  # dK and dH are differences, rounded


def noises(model: ErrorModel, s: int) -> list[tuple[float, Array]]:
    """Variance and matrix, (n_eta, n_eta + nw), of everything that chance adds to (10) in mode s."""
    found = [(float(alpha_i), model.F_i(s, i)) for i, alpha_i in enumerate(model.alpha)]
    if model.links is not None:
        terms = np.flatnonzero(model.links.mode == s)
        found += [(float(model.links.variance[term]), model.V_l(term)) for term in terms]
    return found


def moved(model: ErrorModel, X: Array) -> Array:
    """Second moments, by mode, one step later; X (modes, n_eta, n_eta) are those of [A B][eta; w] before the loss."""
    return np.einsum("st,sij->tij", model.transition, X)


def attained(model: ErrorModel, policy: Policy) -> float:
    """sqrt(E|z_tilde|^2 / energy of w) of a policy, from its second moments."""
    size = model.A.shape[1]
    X, energy = np.zeros((model.modes, size, size)), 0.0
    waiting = np.zeros((model.modes, model.nw, size))
    for k, Gamma in enumerate([waiting, *policy.Gamma]):
        after = np.zeros_like(X)
        for s in range(model.modes):
            with_w = np.vstack([np.eye(size), Gamma[s]])
            J = with_w @ X[s] @ with_w.T  # of [eta; w]
            if k == 0 and s == policy.mode:
                J[size:, size:] = np.outer(policy.u, policy.u)
            energy += float(np.trace(J[size:, size:]))
            AB = np.hstack([model.A[s], model.B[s]])
            after[s] = AB @ J @ AB.T + sum(variance * V @ J @ V.T for variance, V in noises(model, s))
        X = moved(model, after)
    return math.sqrt(float(np.trace(model.M @ X.sum(axis=0) @ model.M.T)) / energy)


@pytest.mark.parametrize("case", [*CASES, *REAL])
@pytest.mark.parametrize("horizon", [1, 3, 20])
def test_the_worst_policy_attains_gamma_T(case: Case, horizon: int) -> None:
    """Second moments under the policy, with no sampling."""
    model = error_model(*case)
    policy = worst_policy(model, horizon=horizon)
    assert attained(model, policy) == pytest.approx(policy.gamma, rel=1e-6)


@pytest.mark.parametrize("case", [*CASES, *REAL])
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
            with_w = np.zeros((size + len(w_k), size + 1))  # [eta; w] from [eta; 1]
            with_w[:size, :size], with_w[size:, size] = np.eye(size), w_k
            step = np.eye(size + 1)
            step[:size] = np.hstack([model.A[s], model.B[s]]) @ with_w
            after = step @ X[s] @ step.T
            for variance, V in noises(model, s):
                after[:size, :size] += variance * V @ with_w @ X[s] @ with_w.T @ V.T
            following += model.transition[s][:, None, None] * after
        X = following
    return math.sqrt(float(np.trace(model.M @ X[:, :size, :size].sum(axis=0) @ model.M.T)))


@pytest.mark.parametrize("case", [random_case(8), *REAL])
def test_the_path_gain_bounds_its_own_run_and_is_attained(case: Case) -> None:
    """For one realised path it is the norm of the map from w to z_tilde(k), which is written out."""
    model, rng = error_model(*case), np.random.default_rng(1)
    modes, outcomes = rng.integers(0, 2, size=9).tolist(), chances(model)
    drawn = [outcomes[at] for at in rng.integers(len(outcomes), size=9)]
    theta = np.array([theta for _, theta, _ in drawn])
    delivered = np.array([came for _, _, came in drawn])
    response, expected = np.zeros((model.size, 0)), [0.0]
    for s, theta_k, delivered_k in zip(modes, theta, delivered, strict=True):
        AB = realised(model, s, theta_k, delivered_k)
        response = np.hstack([AB[:, : model.size] @ response, AB[:, model.size :]])
        expected.append(np.linalg.norm(model.M @ response, ord=2))
    np.testing.assert_allclose(path_gain(model, modes, theta, delivered), expected, rtol=1e-9)


# an unstable plant, by hand
def scalar(beta: float, *, a: float = 1.25, b: float = 0.8) -> Problem:
    """x+ = a x + b w, y = x: one node, which sees its losses, and unbiased gains."""
    return Problem.from_document(
        {
            "name": "scalar",
            "plant": {"A": [[a]], "B": [[b]], "M": [[1.0]]},
            "node": [{"name": "only", "C": [[1.0]], "D": [[0.0]], "arrival_probability": beta, "loss": "seen"}],
            "topology": [{"name": "always", "adjacency": [[1.0]]}],
            "markov": {"transition": [[1.0]], "initial": "always"},
            "unbiased": True,
        }
    )


@pytest.mark.parametrize(("above", "stable"), [(0.01, True), (0.1, True), (-0.01, False), (-0.1, False)])
def test_an_unstable_plant_needs_more_than_the_critical_arrival_probability(above: float, stable: bool) -> None:
    """e+ = (a - theta h) e + b w with h = a: E|e|^2 grows by a^2 (1 - beta), so beta has to exceed 1 - 1/a^2."""
    a = 1.25
    beta = 1.0 - 1.0 / a**2 + above
    gain = exact_gain(error_model(scalar(beta), np.array([[[a]]]), np.array([[[a]]])))
    assert gain.radius == pytest.approx(a**2 * (1.0 - beta), rel=1e-3)
    assert gain.stable == stable


@pytest.mark.parametrize("beta", [0.4, 0.6, 0.9])
def test_the_gain_of_a_scalar_unstable_plant_is_that_of_the_algebra(beta: float) -> None:
    """gamma^2 = b^2 (1 + a^2 (1 - beta)^2 / (1 - a^2 (1 - beta))), with h = a.

    With c = a^2 (1 - beta) and y = Y b^2 / g the recursion is y <- c y + c (1 - beta) y^2 / (1 - y), from b^2 / g. It
    stays below 1 for ever if and only if it starts at most at its positive fixed point, where
    1 / y - 1 = c (1 - beta) / (1 - c).
    """
    a, b = 1.25, 0.8
    gain = exact_gain(error_model(scalar(beta, a=a, b=b), np.array([[[a]]]), np.array([[[a]]])))
    gamma = b * math.sqrt(1.0 + a**2 * (1.0 - beta) ** 2 / (1.0 - a**2 * (1.0 - beta)))
    assert gain.low <= gamma * (1.0 + 1e-9)
    assert gamma <= gain.high * (1.0 + 1e-9)
    assert gain.high - gain.low <= 1e-6 * gain.high


# the floor of what is not in the paper
def silent(problem: Problem, horizon: int) -> tuple[float, Array]:
    """The largest |M x(T)| per energy of a w with C_i x + D_i w = 0 at every node, and that w (T, nw).

    C_i is beta_i C_i where a loss is hidden. By a kernel of all measurements of all steps at once.
    """
    plant, nw = problem.plant, problem.nw
    C = np.vstack([node.C * (1.0 if node.seen else node.arrival_probability) for node in problem.nodes])
    D = np.vstack([node.D for node in problem.nodes])
    state, rows = np.zeros((problem.nx, horizon * nw)), []
    for k in range(horizon):
        give = np.zeros((nw, horizon * nw))
        give[:, k * nw : (k + 1) * nw] = np.eye(nw)
        rows.append(C @ state + D @ give)
        state = plant.A @ state + plant.B @ give
    _, sizes, right = np.linalg.svd(np.vstack(rows))
    kernel = right[int((sizes > 1e-9 * sizes[0]).sum()) :].T
    _, reached, inputs = np.linalg.svd(plant.M @ state @ kernel)
    return float(reached[0]), (kernel @ inputs[0]).reshape(horizon, nw)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", [1, 2])
def test_the_floor_is_what_a_w_that_no_node_hears_does(kind: str, seed: int) -> None:
    """By linear algebra over 25 steps at once; and every gains' exact gain is above it."""
    problem = real_networks(seed, nw=6)[kind]
    gain = float(np.linalg.norm(problem.weights)) * silent(problem, 25)[0]
    assert floor(problem) == pytest.approx(gain, rel=1e-6)
    assert floor(problem) > 0.0
    for K_bar, H_bar in (least_variance_gains(problem), consensus_gains(problem, weight=0.4)):
        assert floor(problem) <= exact_gain(error_model(problem, K_bar, H_bar)).high


@pytest.mark.parametrize("kind", ["seen", "unbiased, seen, links, unstable, weighted"])
def test_that_w_leaves_every_estimate_at_0_whatever_is_lost(kind: str) -> None:
    """Where losses are seen: each realised path gives |z_tilde| = |weights| |M x|: why the floor holds for it."""
    problem = real_networks(1, nw=6)[kind]
    K_bar, H_bar = random_gains(problem, 1)
    model, rng = error_model(problem, K_bar, H_bar), np.random.default_rng(0)
    reached, w = silent(problem, 12)
    outcomes = chances(model)
    for _ in range(5):
        eta, x = np.zeros(model.size), np.zeros(problem.nx)
        for w_k in w:
            _, theta, delivered = outcomes[rng.integers(len(outcomes))]
            eta = realised(model, int(rng.integers(model.modes)), theta, delivered) @ np.concatenate([eta, w_k])
            x = problem.plant.A @ x + problem.plant.B @ w_k
        np.testing.assert_allclose(eta[model.plant_states :], np.tile(x, problem.n), atol=1e-9)
        assert np.linalg.norm(model.M @ eta) == pytest.approx(
            float(np.linalg.norm(problem.weights)) * reached, rel=1e-9
        )


def test_lossy_links_do_not_move_the_floor() -> None:
    problem = random_problem(1, nw=6)
    assert floor(real_network(problem, delivery=0.5)) == floor(problem)


def test_a_loss_that_is_seen_does_not_move_the_floor_either() -> None:
    """But one that is hidden does: the mean measurement is then beta C x + D w."""
    problem = random_problem(1, nw=6)
    lossless = problem.document()
    for node in lossless["node"]:
        node["arrival_probability"] = 1.0
    assert floor(real_network(problem, seen=True)) == floor(Problem.from_document(lossless)) < floor(problem)


@pytest.mark.parametrize(
    ("growth", "driven", "seen_by_C", "value"),
    [
        (1.2, 1.0, 0.0, math.inf),  # nobody sees the unstable part
        (1.0, 1.0, 0.0, math.inf),  # nor the sum of w, which grows slowly
        (1.2, 0.0, 0.0, None),  # w does not reach it
        (1.2, 1.0, 0.3, None),  # somebody sees it
        (0.99, 1.0, 0.0, None),  # it is stable
    ],
)
def test_the_floor_is_infinite_where_nobody_sees_what_grows(
    growth: float, driven: float, seen_by_C: float, value: float | None
) -> None:
    """x_2+ = growth x_2 + driven w_2, and one sensor, of x_1 + seen_by_C x_2."""
    document = scalar(1.0).document() | {
        "plant": {"A": [[0.5, 0.0], [0.0, growth]], "B": [[1.0, 0.0, 0.0], [0.0, driven, 0.0]], "M": [[1.0, 1.0]]},
        "node": [{"name": "only", "C": [[1.0, seen_by_C]], "D": [[0.0, 0.0, 1.0]], "arrival_probability": 1.0}],
    }
    found = floor(Problem.from_document(document))
    assert math.isinf(found) == (value == math.inf)
    assert found > 0.5


def test_what_grows_unseen_does_not_matter_where_a_measurement_shows_all_of_w() -> None:
    """One w for all: y = w. A filter that knows w knows x, so the floor is 0, detectable or not."""
    document = scalar(1.0).document() | {
        "plant": {"A": [[1.2]], "B": [[1.0]], "M": [[1.0]]},
        "node": [{"name": "only", "C": [[0.0]], "D": [[1.0]], "arrival_probability": 1.0}],
    }
    assert floor(Problem.from_document(document)) == 0.0


def slow(a: float) -> Case:
    """One node that hardly listens to a leaking integrator, losses hidden: E|error|^2 decays by a^2 in each step."""
    problem = Problem.from_document(
        {
            "name": "slow",
            "plant": {"A": [[a, 0.1], [0.0, 0.5]], "B": [[0.1, 0.0], [0.3, 0.0]], "M": [[1.0, 0.2]]},
            "node": [{"name": "a", "C": [[1.0, 0.0]], "D": [[0.0, 0.5]], "arrival_probability": 0.6}],
            "topology": [{"name": "t", "hears": {}}],
            "markov": {"transition": [[1.0]], "initial": "t"},
        }
    )
    return problem, problem.plant.A[None], np.array([[[0.1], [0.05]]])


def test_a_slow_system_has_the_gain_of_the_whole_recursion(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither what ends it early nor what tells at once that it will fail changes the answer."""
    model = error_model(*slow(0.998))
    quick = exact_gain(model)
    monkeypatch.setattr(exact, "invariants", lambda *given: Invariants(invariants(*given).P[:1], []))
    whole = exact_gain(model)
    assert quick.horizon < whole.horizon / 5
    assert max(quick.low, whole.low) <= min(quick.high, whole.high)
    assert quick.high <= quick.low * (1.0 + 1e-5)
    assert whole.high <= whole.low * (1.0 + 1e-5)


@pytest.mark.parametrize("a", [0.999, 0.99999])
def test_the_gain_of_a_slow_system_takes_few_steps_and_is_proved(a: float) -> None:
    """However slowly it decays; and gamma is proved by floats or balls, and its lower end as far as steps go."""
    problem, K_bar, H_bar = slow(a)
    gain = exact_gain(error_model(problem, K_bar, H_bar))
    assert gain.high <= gain.low * (1.0 + 1e-5)
    assert gain.horizon < 1000
    K, H = link_gains(problem, K_bar, H_bar)
    assert Prover(problem, K, H).exact(gain.high * (1.0 + 1e-5), most=5000).holds


def test_errors_that_ignore_everything_have_the_gain_of_the_gramian() -> None:
    """x and its estimate's error are one: what is slow in other directions never moves."""
    problem, _, H_bar = slow(0.99999)
    A, B, M = problem.plant.A, problem.plant.B, problem.plant.M
    gramian = np.linalg.solve(np.eye(4) - np.kron(A, A), (B @ B.T).reshape(-1)).reshape(2, 2)
    gain = exact_gain(error_model(problem, A[None], 0.0 * H_bar))
    assert gain.high == pytest.approx(float(np.sqrt(M @ gramian @ M.T).item()), rel=1e-4)
    assert gain.low <= float(np.sqrt(M @ gramian @ M.T).item()) * (1.0 + 1e-9)
