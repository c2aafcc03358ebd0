"""`design` in other units: the same gains, whoever measures in what."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest

from agent.contract.arrays import Array
from agent.contract.gains import Gains
from agent.contract.problem import Problem
from designer.problems import find
from designer.proof.certificate import verify
from designer.synthesis import design


def three_states() -> Problem:
    node = {"C": [[1.0, 0.0, 0.2]], "D": [[0.0, 0.3]], "arrival_probability": 0.8}
    plant = {
        "A": [[0.8, 0.1, 0.0], [0.0, 0.7, 0.2], [0.1, 0.0, 0.5]],
        "B": [[0.3, 0.0], [0.5, 0.0], [0.2, 0.1]],
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


PROBLEMS = {"three-states": three_states, "two-nodes": lambda: find("two-nodes")}


@cache
def designed(name: str) -> Gains:
    return design(PROBLEMS[name](), method="exact", budget=math.inf)


def in_units(problem: Problem, x: Array, y: float, w: float) -> Problem:
    """x = diag(x) x', y = y y', and w = w w' where w means that the disturbance is told in other units."""
    document, rows = problem.document(), x[:, None]
    plant = problem.plant
    document["plant"] |= {
        "A": (plant.A * x / rows).tolist(),
        "B": (plant.B * w / rows).tolist(),
        "M": (plant.M * x).tolist(),
    }
    for said, node in zip(document["node"], problem.nodes, strict=True):
        said |= {"C": (node.C * x / y).tolist(), "D": (node.D * w / y).tolist()}
    return Problem.from_document(document)


def assert_same(name: str, x: Array, y: float, w: float, *, rtol: float) -> None:
    """The gains of the problem in these units, told in the units that it came in."""
    there = designed(name)
    here = design(in_units(there.problem, x, y, w), method="exact", budget=math.inf)
    assert verify(here).holds
    assert here.certificate.gamma == pytest.approx(w * there.certificate.gamma, rel=rtol)
    for mode, of_mode in there.K.items():
        for i, heard in of_mode.items():
            for j, K_ij in heard.items():
                at_K = here.K[mode][i][j] * x[:, None] / x
                at_H = here.H[mode][i][j] * x[:, None] / y
                np.testing.assert_allclose(at_K, K_ij, rtol=rtol, atol=rtol * np.abs(K_ij).max())
                H_ij = there.H[mode][i][j]
                np.testing.assert_allclose(at_H, H_ij, rtol=rtol, atol=rtol * np.abs(H_ij).max())


@pytest.mark.parametrize(
    ("name", "x"), [("three-states", 2.0 ** np.array([20, 0, -31])), ("two-nodes", 2.0 ** np.array([-9]))]
)
def test_powers_of_two_change_no_bit(name: str, x: Array) -> None:
    assert_same(name, x, 2.0**-7, 2.0**11, rtol=0.0)


def test_states_in_micro_and_mega_units_have_the_same_gamma() -> None:
    """No power of two, so every number of the problem is rounded anew, and a flat minimum may be met elsewhere."""
    there = designed("three-states")
    here = design(in_units(there.problem, np.array([1e-6, 1.0, 1e6]), 1e3, 1e-6), method="exact", budget=math.inf)
    assert verify(here).holds
    assert here.certificate.gamma == pytest.approx(1e-6 * there.certificate.gamma, rel=1e-3)
