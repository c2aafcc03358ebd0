"""`design` in other units: the same gains, whoever measures in what."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
from networks import real_networks

from agent.contract.arrays import Array
from agent.contract.gains import Gains
from agent.contract.problem import Problem
from designer.model import units
from designer.model.units import NaturalUnits
from designer.problems import find
from designer.proof.certificate import verify
from designer.synthesis import design, methods

CHEAP = "a state that w does not reach"
DECIMALS = 1e-12  # relatively: what rounding of gains and of gamma leaves, and much less than any search would


def three_states(*, watched: bool = True) -> Problem:
    """`watched`: else w does not reach the last state, which acts on the others."""
    node = {"C": [[1.0, 0.0, 0.2]], "D": [[0.0, 0.3]], "arrival_probability": 0.8}
    plant = {
        "A": [[0.8, 0.1, 0.0], [0.0, 0.7, 0.2], [0.1 * watched, 0.0, 0.5]],
        "B": [[0.3, 0.0], [0.5, 0.0], [0.2 * watched, 0.1 * watched]],
        "M": [[1.0, 0.5, 0.0]],
    }
    document = {
        "name": "three-states",
        "plant": plant,
        "node": [{"name": "a", **node}],
        "topology": [{"name": "t", "hears": {}}],
        "markov": {"transition": [[1.0]], "initial": "t"},
    }
    return Problem.from_document(document)


def unbiased() -> Problem:
    """Two nodes that see their losses, who tell each other over links that lose messages."""
    nodes = [{"name": name, "D": [[0.0, 0.3, 0.1]], "arrival_probability": 0.8, "loss": "seen"} for name in "ab"]
    document = {
        **three_states().document(),
        "unbiased": True,
        "plant": {"A": [[1.01, 0.1], [0.0, 0.9]], "B": [[0.3, 0.0, 0.1], [0.5, 0.0, 0.0]], "M": [[1.0, 0.0]]},
        "node": [{**nodes[0], "C": [[1.0, 0.0]]}, {**nodes[1], "C": [[0.6, 0.7]]}],
        "topology": [{"name": "t", "hears": {"a": ["b"], "b": ["a"]}}],
        "link": [{"receiver": "a", "sender": "b", "delivery_probability": 0.7}],
    }
    return Problem.from_document(document)


PROBLEMS: dict[str, Callable[[], Problem]] = {
    "three-states": three_states,
    CHEAP: lambda: three_states(watched=False),
    "unbiased": unbiased,
    "two-nodes": lambda: find("two-nodes"),
}


@cache
def designed(name: str, method: str = "exact", peak_slack: float = 0.0) -> Gains:
    return design(PROBLEMS[name](), method=method, budget=math.inf, peak_slack=peak_slack)


def in_units(problem: Problem, x: Array, y: float, w: float, z: float = 1.0) -> Problem:
    """x = diag(x) x', y = y y', z = z z', and w = w w' where w means that the disturbance is told in other units."""
    document, rows = problem.document(), x[:, None]
    plant = problem.plant
    document["plant"] |= {
        "A": (plant.A * x / rows).tolist(),
        "B": (plant.B * w / rows).tolist(),
        "M": (plant.M * x / z).tolist(),
    }
    for said, node in zip(document["node"], problem.nodes, strict=True):
        said |= {"C": (node.C * x / y).tolist(), "D": (node.D * w / y).tolist()}
    return Problem.from_document(document)


def assert_same(there: Gains, x: Array, y: float, w: float, z: float = 1.0, *, rtol: float) -> None:
    """The gains of the problem in these units, told in the units that it came in."""
    method, _, slack = there.method.partition(", peak slack ")
    peak_slack = float(slack.split()[0]) / 100.0 if slack else 0.0
    here = design(in_units(there.problem, x, y, w, z), method=method, budget=math.inf, peak_slack=peak_slack)
    assert verify(here).holds
    assert here.certificate.gamma * z / w == pytest.approx(there.certificate.gamma, rel=rtol)
    for mode, of_mode in there.K.items():
        for i, heard in of_mode.items():
            for j, K_ij in heard.items():
                at_K = here.K[mode][i][j] * x[:, None] / x
                at_H = here.H[mode][i][j] * x[:, None] / y
                np.testing.assert_allclose(at_K, K_ij, rtol=rtol, atol=rtol * np.abs(K_ij).max())
                H_ij = there.H[mode][i][j]
                np.testing.assert_allclose(at_H, H_ij, rtol=rtol, atol=rtol * np.abs(H_ij).max())


# the problem that is searched
@pytest.mark.parametrize("name", [*PROBLEMS, *real_networks(1)])
def test_in_natural_units_a_problem_is_the_same_one(name: str) -> None:
    problem = PROBLEMS[name]() if name in PROBLEMS else real_networks(1)[name]
    twos, tens = 2.0 ** np.array([20, -31, 0]), 10.0 ** np.array([-6, 6, 3])
    others = [in_units(problem, x[: problem.nx], x[1], x[0], x[2]) for x in (twos, tens, 1.0 / tens)]
    natural = [NaturalUnits(each).problem.document() for each in (problem, *others)]
    assert all(document == natural[0] for document in natural)
    assert not NaturalUnits(problem).exactly


# what is designed
def test_powers_of_two_change_no_bit() -> None:
    assert_same(designed(CHEAP), 2.0 ** np.array([20, 0, -31]), 2.0**-7, 2.0**11, 2.0**3, rtol=0.0)


@pytest.mark.parametrize("method", sorted({*methods()} - {"exact"}))
def test_powers_of_two_change_no_bit_of_any_method(method: str) -> None:
    assert_same(designed("two-nodes", method), np.array([2.0**-9]), 2.0**-7, 2.0**11, 2.0**3, rtol=0.0)


@pytest.mark.parametrize("method", methods())
def test_states_in_micro_and_mega_units_have_the_same_gains(method: str) -> None:
    """And measurements, w and z: by no method are gains others, or gamma, but for the factor of w and z."""
    assert_same(designed(CHEAP, method), np.array([1e-6, 1.0, 1e6]), 1e3, 1e-6, 1e3, rtol=DECIMALS)


def test_gains_of_less_noise_are_the_same_in_micro_and_mega_units() -> None:
    there = designed("three-states", peak_slack=0.05)
    assert_same(there, np.array([1e6, 1e-6, 1.0]), 1e3, 1e-6, 1e3, rtol=DECIMALS)


def test_unbiased_gains_of_an_unstable_plant_are_the_same_in_any_units() -> None:
    assert_same(designed("unbiased", "least-variance"), np.array([1e-6, 1e6]), 1e-3, 1e6, rtol=DECIMALS)


def test_gains_of_a_file_are_the_same_in_whatever_order_it_names_nodes() -> None:
    natural, gains = NaturalUnits(unbiased()), designed("unbiased")
    K, H = ({s: dict(reversed(of_s.items())) for s, of_s in matrices.items()} for matrices in (gains.K, gains.H))
    for turned, as_they_are in zip(natural.rounded_there(K, H), natural.rounded_there(gains.K, gains.H), strict=True):
        for s, of_mode in as_they_are.items():
            for i, heard in of_mode.items():
                for j, G in heard.items():
                    np.testing.assert_array_equal(turned[s][i][j], G)


def test_numbers_that_are_not_rounded_are_not_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither with units that are powers of two, nor with the roundings of units left in: so the laws can fail."""
    problem = three_states()
    others = in_units(problem, np.array([1e-6, 1.0, 1e6]), 1e3, 1e-6, 1e3)

    def same() -> bool:
        return NaturalUnits(problem).problem.document() == NaturalUnits(others).problem.document()

    assert same()
    with monkeypatch.context() as patch:
        patch.setattr(units, "rounded", lambda numbers: numbers)
        assert not same()
    common = units.common_units

    def powers(given: Problem) -> units.Measures:
        found = common(given)
        return units.Measures(units._power(found.state), [units._power(y) for y in found.y], found.output)

    monkeypatch.setattr(units, "common_units", powers)
    assert not same()
    with pytest.raises(AssertionError):
        assert_same(designed("three-states", "least-variance"), np.array([1e-6, 1.0, 1e6]), 1e3, 1e-6, rtol=DECIMALS)
