"""What is proved of a box in other units: the same, and of the very numbers that were given."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
from made_recordings import random_gains, real_problem

from agent.contract.arrays import Array
from agent.contract.gains import Gains
from agent.contract.problem import Problem
from agent.contract.problem.matrices import matrices_of
from designer.box import robust as proving
from designer.box.extent import Box, box_of, within
from designer.box.natural import Side, sides
from designer.box.robust import Robust, proved_at, robust
from designer.problems import find

FAR = 2.0**-40  # units of w in those of x
UNITS = {
    "micro and mega": (np.array([1e6, 1e-6]), 1e-6, 1e6, 1e6),
    "any": (np.array([3e-7, 7e-6]), 0.2e6, 1e-5, 3e5),
    "states far from w": (np.array([1.0, 1.0]), 1.0, FAR, 1.0),
}
BOXES = {"two-nodes": "A=1%", "network": "B=1%"}


@cache
def gains_of(name: str) -> Gains:
    """`network`: two nodes of two states, losses seen and hidden, a lossy link, two modes."""
    return random_gains(find(name) if name == "two-nodes" else real_problem(4, unbiased=False, ny=(1, 1), modes=2))


def box_for(gains: Gains, name: str) -> Box:
    return box_of(gains.problem, within([BOXES[name]]))


@cache
def proved(name: str) -> Robust:
    gains = gains_of(name)
    return robust(gains.problem, gains.K, gains.H, box_for(gains, name))


def in_units(given: Gains, x: Array, y: float, w: float, z: float) -> Gains:
    """x = diag(x) x', and y, w and z by numbers."""
    x = x[: given.problem.nx]
    document, plant, rows = given.problem.document(), given.problem.plant, x[:, None]
    document["plant"] |= {
        "A": (plant.A * x / rows).tolist(),
        "B": (plant.B * w / rows).tolist(),
        "M": (plant.M * x / z).tolist(),
    }
    for said, node in zip(document["node"], given.problem.nodes, strict=True):
        said |= {"C": (node.C * x / y).tolist(), "D": (node.D * w / y).tolist()}
    problem = Problem.from_document(document)
    K, H = (
        {s: {i: {j: G * by / rows for j, G in of_i.items()} for i, of_i in of_s.items()} for s, of_s in gains.items()}
        for gains, by in ((given.K, x), (given.H, y))
    )
    return given.model_copy(update={"problem": problem, "problem_digest": problem.digest(), "K": K, "H": H})


@pytest.mark.parametrize(("name", "units"), [*(("two-nodes", units) for units in UNITS), ("network", "any")])
def test_units_change_nothing_of_what_is_proved(name: str, units: str) -> None:
    (x, y, w, z), known = UNITS[units], proved(name)
    gains = in_units(gains_of(name), x, y, w, z)
    box = box_for(gains, name)
    found = robust(gains.problem, gains.K, gains.H, box)
    assert found.gamma is not None
    assert known.gamma is not None
    assert found.gamma * z / w == pytest.approx(known.gamma, rel=1e-12)
    assert found.found * z / w == pytest.approx(known.found, rel=1e-12)
    for gamma, holds in ((found.gamma, True), (0.999 * found.found, False)):
        again = proved_at(gains.problem, gains.K, gains.H, box, found.worst, gamma, found.recipe)
        assert again is not None
        assert (again.holds, again.gamma) == (holds, gamma)


def test_sought_in_the_units_that_are_given_it_is_not_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    x, y, w, z = UNITS["states far from w"]
    gains = in_units(gains_of("two-nodes"), x, y, w, z)
    monkeypatch.setattr(proving, "sides", lambda *given: (Side(*given, np.ones(1)),) * 2)
    found, known = robust(gains.problem, gains.K, gains.H, box_for(gains, "two-nodes")).gamma, proved("two-nodes").gamma
    assert known is not None
    assert (math.inf if found is None else found) * z / w > 1.5 * known


def test_a_proof_is_of_the_numbers_that_were_given() -> None:
    """All that it takes comes back bit by bit; what powers of two would change stays as it is."""
    gains = in_units(gains_of("network"), *UNITS["any"])
    box = box_of(gains.problem, within(["A,B,C,D,M=1%"]))
    sought, there = sides(gains.problem, gains.K, gains.H, box)
    assert sought is not there
    x = there.state
    assert (np.frexp(x)[0] == 0.5).all()
    assert not (x == 1.0).any()
    np.testing.assert_array_equal(there.problem.plant.A * x[:, None] / x, gains.problem.plant.A)
    np.testing.assert_array_equal(there.problem.plant.B * x[:, None], gains.problem.plant.B)
    for entry, moved in zip(box.entries, there.box.entries, strict=True):
        sizes = []
        for side, of in ((gains.problem, entry), (there.problem, moved)):
            letter = getattr(matrices_of(side), of.matrix)
            value = (letter[of.node] if of.matrix in "CD" else letter)[of.row, of.column]
            sizes.append(of.radius / value)
        assert sizes[0] == sizes[1]


def test_what_powers_of_two_would_change_stays_as_it_is() -> None:
    """In natural units 1.2345e-300 is too small for all its bits."""
    gains = gains_of("network")
    A, B = np.array([[0.5, 1.2345e-300], [0.0, 0.4]]), np.array([[1.0], [1e-18]]) * gains.problem.plant.B
    plant = gains.problem.plant.model_copy(update={"A": A, "B": B})
    problem = gains.problem.model_copy(update={"plant": plant})
    for side in sides(problem, gains.K, gains.H, box_of(problem, within(["D=1%"]))):
        assert side.problem is problem
