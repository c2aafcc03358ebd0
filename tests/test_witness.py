"""The designer's model and answers, held against the witness on 50 seeded problems of every kind."""

from __future__ import annotations

import ast
import json
import runpy
from fractions import Fraction
from functools import cache
from typing import NamedTuple

import numpy as np
import pytest
from networks import random_gains, random_problem, real_networks
from places import ROOT

from agent.contract.problem import Problem
from designer.gain.exact import Gain, Operator, exact_gain, node_gains
from designer.gain.noise import steady_state
from designer.model.error_model import ErrorModel, error_model, link_gains
from designer.proof.prover import Prover
from tests.witness import Network

SHAPES = ({"n": 2, "nx": 1}, {"n": 2, "nx": 2, "nw": 1}, {"n": 3, "nx": 1, "modes": 1}, {"n": 2, "nx": 1, "modes": 3})
KINDS = ("paper", *real_networks(0, n=2, nx=1))


def shape(seed: int) -> dict[str, int]:
    return SHAPES[seed % len(SHAPES)]


def has_links(problem: Problem) -> bool:
    return any(len(problem.ever_heard(i)) > 1 for i in range(problem.n))


SEEDS = [seed for seed in range(20) if has_links(random_problem(seed, **shape(seed)))][:8]
CASES = [(kind, seed) for seed in SEEDS for kind in KINDS][:50]
CHECKER = runpy.run_path(str(ROOT / "tools" / "check_certificate.py"))
every_case = pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case[0]}-{case[1]}")


class Case(NamedTuple):
    problem: Problem
    K: dict
    H: dict
    model: ErrorModel
    witness: Network
    gain: Gain


@cache
def made(kind: str, seed: int) -> Case:
    problem = random_problem(seed, **shape(seed)) if kind == "paper" else real_networks(seed, **shape(seed))[kind]
    K_bar, H_bar = random_gains(problem, seed, size=0.25)
    K, H = link_gains(problem, K_bar, H_bar)
    model = error_model(problem, K_bar, H_bar)
    return Case(problem, K, H, model, Network(problem.document(), K, H), exact_gain(model))


def test_the_cases_are_of_every_kind() -> None:
    assert len(set(CASES)) == 50
    cases = [made(*case) for case in CASES]
    assert {kind for kind, _ in CASES} == set(KINDS)
    assert {case.gain.stable for case in cases} == {True, False}
    assert sum(case.gain.stable for case in cases) >= 30
    assert {case.witness.plant_counts for case in cases} == {True, False}


@every_case
def test_the_model_is_the_mean_over_every_outcome(case: tuple[str, int]) -> None:
    """S(Y), for symmetric Y of any sign."""
    made_case = made(*case)
    witness, rng = made_case.witness, np.random.default_rng(case[1])
    assert sum(p for p, _ in witness.outcomes[0]) == pytest.approx(1.0, abs=1e-14)
    Y = rng.normal(size=(len(witness.Pi), witness.size, witness.size))
    Y += Y.swapaxes(1, 2)
    expected = witness.quadratic(Y)
    found = Operator(made_case.model).of(Y)
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-12 * np.abs(expected).max())


@every_case
def test_stable_or_not(case: tuple[str, int]) -> None:
    """The rate, and what is proved of it."""
    problem, K, H, _, witness, gain = made(*case)
    assert gain.radius == pytest.approx(witness.radius, rel=1e-6)
    assert gain.stable is (witness.radius < 1.0)
    assert Prover(problem, K, H).stable.holds is (witness.radius < 1.0)


@every_case
def test_the_exact_gain(case: tuple[str, int]) -> None:
    """Nothing below the interval bounds the peak, all above it does; `verify` proves the one and not the other."""
    problem, K, H, _, witness, gain = made(*case)
    if not gain.stable:
        assert not Prover(problem, K, H).exact(1e6).holds
        return
    assert gain.bounds is not None
    low, high = gain.bounds
    assert witness.slack(witness.invariant()) > 0.0
    assert witness.bounds(0.999 * low) is False
    assert witness.bounds(1.001 * high) is True
    assert witness.fixed(2) <= high**2
    prover = Prover(problem, K, H)
    assert prover.exact(1.001 * high).holds
    assert not prover.exact(0.999 * low).holds
    assert prover.at_least(0.999 * low) is not None
    assert prover.at_least(1.001 * high) is None


@every_case
def test_a_certificate_by_theorem_1(case: tuple[str, int]) -> None:
    """The witness's own P: `verify` proves (17) and (18) for it from the least gamma on that M'M <= gamma^2 P has."""
    problem, K, H, _, witness, gain = made(*case)
    if not gain.stable:
        return
    P = witness.invariant()
    roots = [np.linalg.eigvals(np.linalg.solve(P_s, MM)).real.max() for P_s, MM in zip(P, witness.peak(), strict=True)]
    least = float(np.sqrt(max(roots)))
    prover = Prover(problem, K, H, P=P)
    assert prover.theorem1(1.001 * least).holds
    assert not prover.theorem1(0.999 * least).holds
    assert not Prover(problem, K, H, P=1.01 * P).theorem1(1.001 * least).holds  # (17) has no room for that


@every_case
def test_white_noise_and_each_node(case: tuple[str, int]) -> None:
    problem, _, _, model, witness, gain = made(*case)
    if not gain.stable:
        assert steady_state(model, initial=witness.first) is None
        return
    noise = steady_state(model, initial=problem.mode_index(problem.markov.initial))
    assert noise is not None
    np.testing.assert_allclose(noise.nodes, witness.noise(), rtol=1e-6)
    gains = node_gains(model)
    assert gains is not None
    for i, (low, high) in enumerate(gains):
        assert witness.bounds(0.998 * low, node=i) is False
        assert witness.bounds(1.002 * high, node=i) is True


@every_case
def test_the_checker_in_tools_has_the_same_model(case: tuple[str, int]) -> None:
    """S(Y) for Y = I, from its fractions; its vectors are [w; eta]."""
    problem, K, H, _, witness, _ = made(*case)
    read = {"parse_float": lambda text: Fraction(float(text)), "parse_int": lambda text: Fraction(float(text))}
    text = json.dumps([problem.document(), K, H], default=np.ndarray.tolist)
    modes, MM, Pi, nw, n_x = CHECKER["model"](*json.loads(text, **read))
    assert (nw, n_x > 0) == (witness.nw, witness.plant_counts)
    np.testing.assert_allclose(np.array(Pi, dtype=float), witness.Pi, rtol=1e-14)
    np.testing.assert_allclose(np.array(MM, dtype=float), witness.peak()[0], rtol=1e-14)
    expected = witness.quadratic(np.array([np.eye(witness.size)] * len(modes)))
    order = [*range(nw, nw + witness.size), *range(nw)]
    for terms, S in zip(modes, expected, strict=True):
        found = sum(float(variance) * (V := np.array(rows, dtype=float)).T @ V for variance, rows in terms)
        np.testing.assert_allclose(found[np.ix_(order, order)], S, rtol=0.0, atol=1e-13 * np.abs(S).max())


def test_the_witness_knows_nothing_of_peakmesh() -> None:
    tree = ast.parse((ROOT / "tests" / "witness.py").read_text())
    imported = {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    imported |= {name.name for node in ast.walk(tree) if isinstance(node, ast.Import) for name in node.names}
    assert imported == {"__future__", "functools", "itertools", "typing", "numpy"}


def test_a_model_that_is_a_little_wrong_is_found_out() -> None:
    """A loss or a delivery that is a thousandth off, and a loss that is seen in place of one that is hidden."""
    for kind, part, key in (("paper", "node", "arrival_probability"), ("links", "link", "delivery_probability")):
        case = made(kind, 0)
        document = case.problem.document()
        document[part][-1][key] -= 1e-3
        other = Network(document, case.K, case.H)
        assert differs(other, case)
    case = made("seen", 0)
    document = case.problem.document()
    for node in document["node"]:
        node.pop("loss")
    assert differs(Network(document, case.K, case.H), case)


def differs(witness: Network, case: Case) -> bool:
    Y = np.array([np.eye(case.model.size)] * case.model.modes)
    expected = Operator(case.model).of(Y)
    return bool(np.abs(witness.quadratic(Y) - expected).max() > 1e-6 * np.abs(expected).max())
