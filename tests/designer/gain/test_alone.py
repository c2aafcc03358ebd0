"""Where chance has no say the gain is that of the gramian: found at once, and proved in balls."""

from __future__ import annotations

import math
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from flint import arb
from networks import random_gains, random_problem, real_network

from agent.contract.arrays import Array
from agent.contract.gains import LinkMatrices
from agent.contract.problem import Problem
from designer.analysis import analyse, given_plain
from designer.gain.alone import Alone
from designer.gain.exact import Operator, exact_gain, horizon_gain, node_gains
from designer.model.error_model import error_model, link_gains, stacked_links
from designer.proof import gramian
from designer.proof.by_gramian import ByGramian
from designer.proof.prover import Prover
from designer.search.exact_design import certify
from designer.search.starts import ignoring

Case = tuple[Problem, LinkMatrices, LinkMatrices]


def with_plant(A: Array, B: Array, M: Array, *, nodes: int = 3, modes: int = 2) -> Problem:
    """Nodes that lose measurements, of what is scaled so that only its units could matter."""
    document = random_problem(4, n=nodes, modes=modes).document()
    for topology in document["topology"]:
        topology["adjacency"] = (np.array(topology["adjacency"]) != 0.0).astype(float).tolist()
    rng, nx = np.random.default_rng(2), len(A)
    document["plant"] = {"A": A.tolist(), "B": B.tolist(), "M": M.tolist()}
    for node in document["node"]:
        node |= {"C": rng.normal(size=(1, nx)).tolist(), "D": rng.normal(size=(1, B.shape[1])).tolist()}
    return Problem.from_document(document)


def ignored(problem: Problem) -> Case:
    return problem, *link_gains(problem, *ignoring(problem))


def by_fractions(problem: Problem, steps: int) -> float:
    """The gain to z_tilde(steps) where all measurements are ignored and z is one number: no rounding until the end."""
    A, v = problem.plant.A, [Fraction(entry) for entry in problem.plant.M[0].tolist()]
    total = Fraction(0)
    for _ in range(steps):
        total += sum(sum(a * Fraction(b) for a, b in zip(v, column, strict=True)) ** 2 for column in problem.plant.B.T)
        v = [sum((a * Fraction(entry) for a, entry in zip(v, column, strict=True)), Fraction(0)) for column in A.T]
    weights = sum(Fraction(weight) ** 2 for weight in problem.weights.tolist())
    return math.sqrt(total * weights)


JORDAN = 0.99 * np.eye(3) + np.eye(3, k=1)
TURNS = 0.9999999 * np.array([[math.cos(0.3), -math.sin(0.3)], [math.sin(0.3), math.cos(0.3)]])
UNITS = np.array([1.0, 2.0**30, 2.0**-40])
PLANTS = {
    "Jordan": (JORDAN, np.eye(3)[:, 1:], np.eye(3)[:1]),
    "Jordan, in other units": (
        JORDAN * UNITS / UNITS[:, None],
        np.eye(3)[:, 1:] / UNITS[:, None],
        UNITS[None] * [1, 0, 0],
    ),
    "turns": (TURNS, np.eye(2), np.array([[1.0, 0.3]])),
    "M cancels": (np.diag([0.9999, 0.5]), np.array([[1.0, 0.0], [1.0, 1e-6]]), np.array([[1.0, -1.0]])),
    "what w never reaches": (np.diag([0.9999999, 0.5]), np.array([[0.0], [1.0]]), np.array([[1.0, 1.0]])),
}


@pytest.mark.parametrize("name", PLANTS)
def test_the_trivial_certificate_is_always_there(name: str) -> None:
    """However slowly the plant decays, whatever its units, with losses and modes; both ends are proved."""
    problem, K, H = ignored(with_plant(*PLANTS[name]))
    certificate = certify(problem, K, H)
    assert certificate.exact is not None
    low, high = certificate.exact
    assert high * (1.0 - 2e-6) < low < high
    assert Prover(problem, K, H).stable.holds is True
    assert by_fractions(problem, 40) <= high


def test_it_is_the_gain_of_exact_sums() -> None:
    """Of a plant that is at rest, to 1e-30 and more, after a few hundred steps; and gamma is told from both sides."""
    problem, K, H = ignored(with_plant(0.5 * JORDAN / 0.99, *PLANTS["Jordan"][1:]))
    true, proof = by_fractions(problem, 120), ByGramian.of(problem, K, H)
    assert proof is not None
    assert proof.sign(true * (1.0 + 1e-12)).proved
    assert proof.sign(true * (1.0 - 1e-12)).refuted
    assert exact_gain(error_model(problem, *ignoring(problem))).low == pytest.approx(true, rel=1e-8)


@pytest.mark.parametrize("left", [1e-3, 1e-12, 1e-15])
def test_a_filter_that_hardly_decays_is_told_as_closely_as_another(left: float) -> None:
    """K = 1 - left on an estimate that nothing excites: what floats allow for, balls narrow. The error is x itself."""
    problem = with_plant(np.array([[0.5]]), np.array([[1.0]]), np.array([[1.0]]), nodes=1, modes=1)
    mode, node = problem.mode_names[0], problem.node_names[0]
    K, H = ({mode: {node: {node: np.array([[entry]])}}} for entry in (1.0 - left, 0.0))
    true = math.sqrt(4.0 / 3.0 * float((problem.weights**2).sum()))
    for low, high in (certify(problem, K, H).exact, analyse(problem, given_plain(problem, K, H)).ladder.exact):
        assert low <= true <= high < low * (1.0 + 3e-6)


@pytest.mark.parametrize("unbiased", [False, True])
def test_what_the_recursion_finds_is_the_same(unbiased: bool) -> None:
    """Certain arrival, one mode, any gains; and each node's own."""
    problem = real_network(random_problem(3, modes=1, lossy=False), unbiased=unbiased, weighted=True)
    gains = [0.5 * part for part in random_gains(problem, 1)]
    if unbiased:
        gains[0] = np.array([np.kron(np.eye(3), 0.9 * problem.plant.A)])
    model = error_model(problem, *gains)
    gain, (low, high) = exact_gain(model), horizon_gain(Operator(model), 400)
    assert Alone.of(model) is not None
    assert low <= gain.high**2
    assert gain.low**2 <= high
    for M, (least, most) in zip(np.split(model.M, 3), node_gains(model) or [], strict=True):
        operator = Operator(replace(model, M=M))
        assert horizon_gain(operator, 400) == pytest.approx((least**2, most**2), rel=2e-6)


@pytest.mark.parametrize("change", ["H", "K", "one mode", "one node"])
def test_where_chance_may_have_a_say_nothing_is_said(change: str) -> None:
    """The least change of any number is seen, by floats and in balls."""
    problem, K, H = ignored(with_plant(*PLANTS["turns"]))
    mode = problem.mode_names[0]
    if change == "H":
        H[mode]["n1"]["n1"][0, 0] = 1e-300
    elif change == "K":
        K[mode]["n1"]["n1"][0, 0] = np.nextafter(K[mode]["n1"]["n1"][0, 0], 1.0)
    elif change == "one mode":
        for name in problem.node_names:
            K[mode][name][name] = 0.5 * K[mode][name][name]
    else:
        K = {each: {**row, "n2": {**row["n2"], "n2": 0.5 * row["n2"]["n2"]}} for each, row in K.items()}
    alike = change == "one node"  # the same in all modes: chance still has no say, and nodes differ
    found, known = ByGramian.of(problem, K, H), Alone.of(error_model(problem, *stacked_links(problem, K, H)))
    assert (found is not None) is alike
    assert (known is not None) is alike
    if known is not None:
        assert known.copies == 1


def test_a_lossy_message_that_counts_is_chance_and_one_that_does_not_is_not() -> None:
    problem = real_network(with_plant(*PLANTS["turns"]), delivery=0.7)
    problem, K, H = ignored(problem)
    assert ByGramian.of(problem, K, H) is not None
    assert Alone.of(error_model(problem, *ignoring(problem))) is not None
    mode, (receiver, sender) = next(
        (mode, (i, j)) for mode, rows in K.items() for i, row in rows.items() for j in row if i != j
    )
    K[mode][receiver][sender][0, 0] = 1e-200
    assert ByGramian.of(problem, K, H) is None
    assert Alone.of(error_model(problem, *stacked_links(problem, K, H))) is None


@pytest.mark.parametrize("A", [np.array([[0.0, -1.0], [1.0, 0.0]]), (1.0 + 2e-7) * TURNS], ids=["lasts", "grows"])
def test_what_does_not_die_out_has_no_gramian(A: Array) -> None:
    document = with_plant(*PLANTS["turns"]).document() | {"unbiased": True}
    document["plant"]["A"] = A.tolist()
    for node in document["node"]:
        node["loss"] = "seen"
    problem, K, H = ignored(Problem.from_document(document))
    assert ByGramian.of(problem, K, H) is None
    assert Prover(problem, K, H).stable.holds is not True


# mutants of the proof
def test_a_sum_that_is_too_short_proves_no_bound_without_its_rest(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is left out is allowed for: gamma that only the first terms have is not proved."""
    problem, K, H = ignored(with_plant(np.diag([0.9, 0.5]), np.eye(2), np.array([[1.0, 0.0]])))
    weights = float((problem.weights**2).sum())
    true, short = (math.sqrt(weights * (1.0 - 0.81**steps) / 0.19) for steps in (1000, 4))
    monkeypatch.setattr(gramian, "_SETTLED", 0.5)
    proof = ByGramian.of(problem, K, H)
    assert proof is not None
    assert not proof.sign(true).proved
    assert not proof.sign(short * (1.0 + 1e-9)).proved
    assert proof.sign(short * (1.0 - 1e-9)).refuted
    assert proof._sum is not None
    monkeypatch.setattr(proof, "_sum", (proof._sum[0], arb(0)))
    assert proof.sign(true).proved
    assert proof.sign(short * (1.0 + 1e-9)).proved  # which is false
