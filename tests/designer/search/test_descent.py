"""Gains designed for the exact gain: the barrier's gradient, the search, its interruption, and the file it ends in."""

from __future__ import annotations

import math

import numpy as np
import pytest
from networks import random_gains, random_problem, real_network, real_networks

from agent.contract.arrays import Array
from agent.contract.errors import Unattainable
from agent.contract.gains import Gains
from agent.contract.problem import Problem
from designer.gain.exact import Operator, exact_gain
from designer.gain.floor import floor
from designer.model.error_model import error_model, link_gains, stacked_links
from designer.model.units import Units, rescaled
from designer.problems import find
from designer.proof.certificate import verify
from designer.search import bfgs, descent
from designer.search.barrier import Barrier, Entries
from designer.search.descent import Progress, descend
from designer.search.exact_design import design_exact
from designer.search.starts import consensus_gains, least_variance_gains
from designer.synthesis import design

PROBLEMS = [random_problem(1), random_problem(2), *real_networks(3).values()]


@pytest.mark.parametrize("problem", PROBLEMS, ids=["paper 1", "paper 2", *real_networks(3)])
def test_the_gradients_of_both_barriers_agree_with_differences(problem: Problem) -> None:
    """By every direction of the gains that they may take, and of y = log g."""
    barrier = Barrier(problem, 9)
    gains = least_variance_gains(problem) if problem.unbiased else random_gains(problem, 1, size=0.1)
    v = barrier.entries.pack(*gains)
    y = math.log(2.0 * exact_gain(error_model(problem, *barrier.entries.unpack(v))).high ** 2)
    rng = np.random.default_rng(0)
    for function, x in ((barrier.descent(0.03), np.append(v, y)), (barrier.centre(y, 2.0), v)):
        _, gradient = function(x)
        for _ in range(3):
            direction = 1e-5 * rng.normal(size=len(x))
            difference = function(x + direction)[0] - function(x - direction)[0]
            assert difference / 2.0 == pytest.approx(float(gradient @ direction), rel=1e-5, abs=1e-10)


def test_the_barrier_is_finite_exactly_where_g_is_above_gamma_squared() -> None:
    """Just above gamma_T^2 it is a number, just below it is infinite."""
    problem = random_problem(3)
    barrier = Barrier(problem, 200)
    v = barrier.entries.pack(*random_gains(problem, 3, size=0.1))
    gain = exact_gain(error_model(problem, *barrier.entries.unpack(v)))
    J = barrier.descent(0.1)
    assert math.isfinite(J(np.append(v, 2.0 * math.log(gain.high * (1.0 + 1e-6))))[0])
    assert J(np.append(v, 2.0 * math.log(gain.low * (1.0 - 1e-6))))[0] == math.inf


def test_entries_are_those_that_the_topologies_allow() -> None:
    """Consensus gains keep to them, and packing loses nothing of them."""
    problem = random_problem(4)
    entries = Entries(problem)
    K_bar, H_bar = consensus_gains(problem, weight=0.3)
    v = entries.pack(K_bar, H_bar)
    assert np.count_nonzero(v) == np.count_nonzero(K_bar) + np.count_nonzero(H_bar)
    for stacked, back in zip((K_bar, H_bar), entries.unpack(v), strict=True):
        np.testing.assert_allclose(stacked, back, rtol=1e-15)


def test_consensus_gains_leave_the_estimates_unbiased() -> None:
    """Every row of K_bar shares out A."""
    problem = random_problem(5)
    K_bar, _ = consensus_gains(problem, weight=0.3)
    ones = np.tile(np.eye(problem.nx), (problem.n, 1))
    np.testing.assert_allclose(K_bar @ ones, np.tile(problem.plant.A, (2, problem.n, 1)), atol=1e-14)


@pytest.mark.parametrize("kind", sorted(real_networks(4)))
def test_both_starts_keep_to_the_entries_and_are_unbiased_where_asked(kind: str) -> None:
    """Nothing is lost by packing them, weights other than 1 included, and the file takes them."""
    problem = real_networks(4)[kind]
    entries, ones = Entries(problem), np.tile(np.eye(problem.nx), (problem.n, 1))
    for K_bar, H_bar in (consensus_gains(problem, weight=0.3), least_variance_gains(problem)):
        for stacked, back in zip((K_bar, H_bar), entries.unpack(entries.pack(K_bar, H_bar)), strict=True):
            np.testing.assert_allclose(stacked, back, atol=1e-12)
        if problem.unbiased:
            np.testing.assert_allclose(K_bar @ ones, np.tile(problem.plant.A, (2, problem.n, 1)), atol=1e-12)


@pytest.mark.parametrize("kind", sorted(real_networks(5)))
def test_gains_of_least_variance_leave_each_node_no_better_choice(kind: str) -> None:
    """E|e_i|^2 of every node under white w, where it has settled, rises with any change of that node's own gains."""
    problem = real_networks(5)[kind]
    K_bar, H_bar = least_variance_gains(problem)
    entries, rng = Entries(problem), np.random.default_rng(0)
    v = entries.pack(K_bar, H_bar)
    operator, X = Operator(error_model(problem, K_bar, H_bar)), None
    nx, p, w = problem.nx, operator.p, np.eye(problem.nw)
    occupied = np.linalg.matrix_power(problem.markov.transition, 10_000)[0]
    joint = np.zeros((2, operator.size + operator.nw, operator.size + operator.nw))
    joint[:, operator.size :, operator.size :] = occupied[:, None, None] * w
    for _ in range(400):
        X = operator.carry(joint)
        joint[:, : operator.size, : operator.size] = X

    def variances(gains: tuple[Array, Array]) -> Array:
        X = Operator(error_model(problem, *gains)).carry(joint).sum(axis=0)
        return np.diag(X)[p:].reshape(problem.n, nx).sum(axis=1)

    least = variances((K_bar, H_bar))
    for _ in range(10):
        other = variances(entries.unpack(v + 0.1 * rng.normal(size=len(v))))
        assert (other > least * (1.0 - 1e-3)).all()


def test_bfgs_finds_a_minimum_with_a_kink() -> None:
    """Nesterov's nonsmooth variant of Rosenbrock's function, minimum 0 at (1, 1)."""

    def kinked(x: Array) -> tuple[float, Array]:
        inner = x[1] - 2.0 * x[0] ** 2 + 1.0
        gradient = np.array([(x[0] - 1.0) / 2.0 - 4.0 * x[0] * np.sign(inner), np.sign(inner)])
        return float((x[0] - 1.0) ** 2 / 4.0 + abs(inner)), gradient

    point = bfgs.start(kinked, np.array([-1.0, 1.3]), np.eye(2))
    for _ in range(300):
        following = bfgs.step(kinked, point)
        if following is None:
            break
        point = following
    assert point.value < 1e-5


@pytest.mark.parametrize("problem", PROBLEMS, ids=["paper 1", "paper 2", *real_networks(3)])
def test_bfgs_begins_with_the_curvature_of_what_each_node_chooses(problem: Problem) -> None:
    """With Y_bar and the moments held, -log det is a quadratic of one node's gains; second differences of it are exact.

    It is written out with S(Y_bar), which shares nothing with the regressions of `inverse_hessian`.
    """
    barrier, mu, rng = Barrier(problem, 9), 0.03, np.random.default_rng(0)
    gains = least_variance_gains(problem) if problem.unbiased else random_gains(problem, 1, size=0.1)
    v = barrier.entries.pack(*gains)
    x = np.append(v, math.log(2.0 * exact_gain(error_model(problem, *gains)).high ** 2))
    found = barrier._swept(x)
    assert found is not None
    swept, slopes = found

    def held(v: Array) -> float:
        operator = barrier.operator(v)
        pairs = zip(swept.Y_bar, slopes.moments, strict=True)
        return mu * sum(float((operator.joint(Y_bar) * moments).sum()) for Y_bar, moments in pairs)

    inverse = barrier.inverse_hessian(x, mu, ridge=0.7)
    for s in range(len(problem.topologies)):
        for i in range(problem.n):
            at = barrier.entries.of_node(s, i)
            damped = np.linalg.inv(inverse[np.ix_(at, at)])
            hessian = damped - np.diag(damped.diagonal() * 0.1 / 1.1)
            direction = np.zeros(len(v))
            direction[at] = rng.normal(size=len(at))
            second = held(v + direction) - 2.0 * held(v) + held(v - direction) + 0.7 * float(direction @ direction)
            assert float(direction[at] @ hessian @ direction[at]) == pytest.approx(second, rel=1e-6)


@pytest.mark.parametrize("kind", sorted(real_networks(4)))
def test_the_entries_of_a_node_are_its_rows_and_all_are_somebodys(kind: str) -> None:
    problem = real_networks(4)[kind]
    entries, nx, seen = Entries(problem), problem.nx, []
    for s in range(len(problem.topologies)):
        for i in range(problem.n):
            at = entries.of_node(s, i)
            seen += at.tolist()
            v = np.zeros(len(entries.units))
            v[at] = 1.0
            for moved, still in zip(entries.unpack(v), entries.unpack(0.0 * v), strict=True):
                where, rows, _ = np.nonzero(moved != still)
                assert set(where) <= {s}  # no K at all where a node hears itself alone
                assert set(rows // nx) <= {i}
    assert sorted(seen) == list(range(len(entries.units)))


def in_other_units(problem: Problem, x: Array, y: Array) -> Problem:
    """The same network with x = diag(x) x' and y = diag(y) y', y of all nodes."""
    document, first = rescaled(problem, Units(x, 1.0)).document(), 0
    for node in document["node"]:
        rows = slice(first, first + len(node["C"]))
        node["C"], node["D"] = (np.asarray(node[name]) / y[rows, None] for name in "CD")
        node["C"], node["D"], first = node["C"].tolist(), node["D"].tolist(), rows.stop
    return Problem.from_document(document)


@pytest.mark.parametrize("kind", ["some seen, links", "unbiased, seen, links, unstable"])
def test_the_search_does_not_depend_on_units(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Powers of 2 change no rounding: the same steps, and the same gamma from every start, bit for bit."""
    monkeypatch.setattr(descent, "_COARSE", (3e-2, 9e-3))
    monkeypatch.setattr(descent, "_FINE", (3e-3,))
    problem = real_networks(6, n=2)[kind]
    starts = {"consensus": consensus_gains(problem, weight=0.4), "least variance": least_variance_gains(problem)}
    x, y = 2.0 ** np.array([-3, 5]), 2.0 ** np.array([4, -6, 2])
    each = np.tile(x, problem.n)
    others = {name: (K * each / each[:, None], H * y / each[:, None]) for name, (K, H) in starts.items()}
    found, other = descend(problem, starts), descend(in_other_units(problem, x, y), others)
    assert other.steps == found.steps
    assert other.starts == found.starts
    assert other.least.gain.high == pytest.approx(found.least.gain.high, rel=1e-6)
    assert other.least.norm == found.least.norm
    np.testing.assert_array_equal(other.least.K_bar * each[:, None] / each, found.least.K_bar)


def test_starts_agree_on_the_pendulum_whose_states_are_of_different_size(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(descent, "_FINE", (3e-4,))
    problem = find("inverted-pendulum")
    starts = {"consensus": consensus_gains(problem), "least variance": least_variance_gains(problem)}
    found = descend(problem, starts)
    assert max(found.starts.values()) <= 1.005 * min(found.starts.values())


def test_gains_are_chosen_on_the_way_where_the_smallest_are_not_stable() -> None:
    """In the paper's first example centring ends at errors that grow, too slowly for the horizon."""
    problem = find("zhu2020-ideal")
    found = descend(problem, {"least variance": least_variance_gains(problem)})
    assert found.chosen.gain.high <= 1.00101 * found.least.gain.high
    assert found.chosen.cost < 0.5 * found.least.cost


def test_any_start_leads_to_the_answer_that_is_known() -> None:
    """two-nodes has the gain sqrt 2 at best; the chosen gains are within 0.1 % of the least found."""
    problem = find("two-nodes")
    starts = {str(seed): random_gains(problem, seed, size=0.1) for seed in range(2)}
    found = descend(problem, starts)
    assert math.sqrt(2.0) <= found.least.gain.high <= math.sqrt(2.0) * (1.0 + 1e-4)
    assert found.chosen.gain.high <= found.least.gain.high * 1.00101
    assert found.chosen.cost <= found.least.cost
    assert max(found.starts.values()) <= 1.005 * min(found.starts.values())


@pytest.mark.parametrize("kind", ["some seen, links", "unbiased, seen, links, unstable"])
def test_starts_agree_with_what_real_networks_need(kind: str) -> None:
    """From gains that share nothing but their sparsity, within 0.5 %; the result is above the floor and stable."""
    problem = real_networks(6, n=2)[kind]
    starts = {"consensus": consensus_gains(problem, weight=0.4), "least variance": least_variance_gains(problem)}
    found = descend(problem, starts)
    assert found.chosen.gain.stable
    assert max(found.starts.values()) <= 1.005 * min(found.starts.values())
    before = min(exact_gain(error_model(problem, *gains)).high for gains in starts.values())
    assert floor(problem) <= found.least.gain.high < before
    K, H = link_gains(problem, found.chosen.K_bar, found.chosen.H_bar)
    np.testing.assert_allclose(stacked_links(problem, K, H)[0], found.chosen.K_bar, atol=1e-12)


def test_a_start_that_is_not_mean_square_stable_leads_to_gains_that_are(monkeypatch: pytest.MonkeyPatch) -> None:
    """The barrier is finite over 30 steps, however fast the errors grow. The coarse weights show it."""
    monkeypatch.setattr(descent, "_FINE", (3e-4,))
    problem = real_network(random_problem(5, n=2), seen=True, delivery=0.6, unbiased=True, radius=1.3)
    start = consensus_gains(problem, weight=0.9)
    assert not exact_gain(error_model(problem, *start)).stable
    found = descend(problem, {"too much consensus": start})
    assert found.chosen.gain.stable


def alone(beta: float) -> Problem:
    """One node before x+ = 2 x + w; no gains are mean-square stable unless beta > 1 - 1 / 2^2 = 0.75."""
    node = {"name": "only", "C": [[1.0]], "D": [[0.0, 0.1]], "arrival_probability": beta, "loss": "seen"}
    return Problem.from_document(
        {
            "name": "alone",
            "plant": {"A": [[2.0]], "B": [[1.0, 0.0]], "M": [[1.0]]},
            "node": [node],
            "topology": [{"name": "always", "adjacency": [[1.0]]}],
            "markov": {"transition": [[1.0]], "initial": "always"},
            "unbiased": True,
        }
    )


def test_above_the_critical_arrival_probability_there_are_gains_and_below_there_is_no_design(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The refusal says how far the best gains are from stable: a^2 (1 - beta)."""
    monkeypatch.setattr(descent, "_FINE", (3e-4,))
    assert exact_gain(error_model(alone(0.8), *least_variance_gains(alone(0.8)))).stable
    with pytest.raises(Unattainable, match=r"^no mean-square stable gains .* multiply E\|error\|\^2 by 1\.2 "):
        design_exact(alone(0.7), starts={"least variance": least_variance_gains(alone(0.7))})


def test_a_plant_that_nobody_sees_grow_is_refused_in_one_sentence() -> None:
    document = alone(1.0).document()
    document["node"][0]["C"] = [[0.0]]
    with pytest.raises(Unattainable, match="all sensors together do not show an unstable part"):
        design_exact(Problem.from_document(document))


@pytest.mark.parametrize(("name", "target"), [("zhu2020-ideal", 0.2700), ("zhu2020-lossy", 0.2456)])
def test_the_papers_examples_reach_their_targets(name: str, target: float) -> None:
    """From Kalman-consensus gains, without any solver."""
    problem = find(name)
    found = descend(problem, {"consensus": consensus_gains(problem, weight=0.4)})
    assert found.chosen.gain.high <= target


def test_an_interrupted_search_keeps_the_best_so_far() -> None:
    """KeyboardInterrupt after some steps: gains no worse than what progress reported, and no exception."""
    problem = find("zhu2020-lossy")
    reported: list[Progress] = []

    def interrupt(progress: Progress) -> None:
        reported.append(progress)
        if progress.steps == 25:
            raise KeyboardInterrupt

    found = descend(problem, {"consensus": consensus_gains(problem, weight=0.2)}, progress=interrupt)
    assert found.interrupted
    assert found.steps == 25
    assert found.chosen.gain.stable
    assert found.least.gain.high <= min(progress.gamma for progress in reported) * 1.01


def test_method_exact_ends_in_a_certificate_of_kind_exact() -> None:
    """floor <= exact <= gamma, and the check confirms gamma for what a reader of the file has."""
    problem = find("two-nodes")
    gains = Gains.from_bytes(design(problem, method="exact").canonical(), source="memory")
    proved = gains.certificate
    assert (proved.kind, proved.form, gains.method) == ("exact", "full", "exact")
    assert proved.holds
    assert proved.exact is not None
    assert proved.floor is not None
    assert proved.P is not None
    assert proved.horizon is not None
    assert proved.floor <= proved.exact[1] <= proved.gamma <= proved.exact[1] * (1.0 + 1e-4)
    assert verify(gains).holds
    lower = proved.model_copy(update={"gamma": proved.gamma * (1.0 - 1e-4)})
    verdict = verify(gains.model_copy(update={"certificate": lower}))
    assert not verdict.holds
    assert verdict.failure is not None


def test_a_design_by_theorem_2_shows_the_ladder_too() -> None:
    """floor <= exact gain of its gains <= its gamma."""
    problem = find("two-nodes")
    proved = design(problem, method="theorem2-reduced").certificate
    assert proved.exact is not None
    assert proved.floor == floor(problem)
    assert proved.floor <= proved.exact[1] <= proved.gamma * (1.0 + 1e-6)
