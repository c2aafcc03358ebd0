"""What no gains have less than by an LMI: where weights for it are found, what is said where they are not."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from networks import random_problem

from agent.contract.gains import Weights
from agent.contract.problem import Problem
from designer import undercut as room
from designer.coordinates import Coordinates
from designer.ladder import ladder_of
from designer.lmi import decomposed
from designer.model.units import NaturalUnits
from designer.problems import find
from designer.proof.undercut import LeastAgain, least_again
from designer.synthesis import design
from designer.undercut import undercut

BY_WEIGHTS = LeastAgain(True, "by the weights on (17) that are stored")


@pytest.fixture(scope="module")
def large() -> Problem:
    """Seven nodes in a line, of whom the ends never meet."""
    document = random_problem(4, n=7, nw=2, modes=2).document()
    line = np.eye(7) + np.eye(7, k=1) + np.eye(7, k=-1)
    document["topology"] = [{"name": f"m{s}", "adjacency": line.tolist()} for s in range(2)]
    return Problem.from_document(document)


def test_multipliers_of_a_design_are_good_enough_for_networks_of_any_shape(large: Problem) -> None:
    """No solver is asked once more, and nobody says how far nodes that never meet err together."""
    gains = design(large, method="decomposed")
    claim = gains.certificate
    assert claim.lmi_gamma is not None
    assert claim.lmi_least is not None
    assert claim.lmi_weights is not None
    assert claim.lmi_gamma * (1.0 - 1e-4) < claim.lmi_least <= claim.lmi_gamma * (1.0 + 1e-9)
    assert least_again(gains) == BY_WEIGHTS
    V, nx, p = claim.lmi_weights.matrices(large.mode_names), large.nx, large.plant_states
    assert not V[:, p : p + nx, p + 6 * nx : p + 7 * nx].any()
    assert V[:, p : p + nx, p + nx : p + 2 * nx].all()


def test_weights_are_not_sought_where_that_takes_too_long(large: Problem) -> None:
    """Unless some are offered, and whatever these prove is taken then."""
    found = undercut(large, seconds=0.0)
    assert found.gamma is None
    assert found.why_not is not None
    assert found.why_not.startswith("better weights would take about ")
    multipliers = decomposed.solve(large).weights
    assert multipliers is not None
    offered = Weights.of(np.eye(large.nx), multipliers, large.mode_names)
    assert undercut(large, offered=offered, seconds=0.0).gamma is not None
    nonsense = Weights.of(np.zeros((2, 2)), multipliers, large.mode_names)
    assert undercut(large, offered=nonsense, seconds=0.0).gamma is None


def test_where_there_would_be_too_many_for_a_file_it_is_said(large: Problem, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(decomposed, "MOST_WEIGHTS", 100)
    assert undercut(large).why_not == "it takes 342 weights, and a file keeps at most 100"
    monkeypatch.setattr(room, "undercut", lambda *_, **__: room.Undercut(None, why_not="of the moon"))
    gains = design(find("two-nodes"), method="decomposed")
    assert "-         what no gains are below by Theorem 2: not proved; of the moon" in ladder_of(gains).lines()


def cancelling(eps: float, **plant: Any) -> Problem:
    """Two nodes apart with one disturbance, and z the difference of two states that it moves nearly alike."""
    document = random_problem(3, n=2, nw=1, modes=1).document()
    document["plant"] = {"A": [[0.5, 0.0], [0.0, 0.5]], "B": [[0.7], [0.7]], "M": [[1.0, -1.0 - eps]], **plant}
    document["node"] = [
        {**node, "C": [node["C"][0]], "D": [node["D"][0]], "arrival_probability": 0.8} for node in document["node"]
    ]
    document["topology"] = [{"name": "m0", "adjacency": [[1.0, 0.0], [0.0, 1.0]]}]
    return Problem.from_document(document)


@pytest.mark.parametrize("eps", [1e-4, 1e-10])
@pytest.mark.parametrize(
    "plant",
    [
        pytest.param({}, id="no state of its own"),
        pytest.param({"A": [[0.5, 0.1], [0.1, 0.5]]}, id="coupled"),
        pytest.param({"A": [[0.5, 0.0], [0.0, 0.4]]}, id="decaying apart"),
    ],
)
def test_where_M_cancels_the_optimum_is_enclosed_too(eps: float, plant: dict[str, Any]) -> None:
    """Whether one disturbance moves both states alike for ever, so that only one combination of them ever moves."""
    problem = cancelling(eps, **plant)
    natural = NaturalUnits(problem, Coordinates.of(problem))
    optimum = natural.output * decomposed.solve(natural.problem).gamma
    assert undercut(problem).gamma == pytest.approx(optimum, rel=1e-3)
    gains = design(problem, method="decomposed")
    assert gains.certificate.lmi_least == pytest.approx(optimum, rel=1e-3)
    assert least_again(gains) == BY_WEIGHTS


@pytest.mark.parametrize(
    "problem",
    [
        pytest.param(random_problem(41, n=3, nx=2, nw=1), id="w is known to some, and to others where all arrives"),
        pytest.param(random_problem(44, n=2, nx=2, nw=2, lossy=False), id="an error that w can only feed"),
    ],
)
def test_errors_that_gains_can_keep_free_of_w_are_left_out_of_the_balance(problem: Problem) -> None:
    """Or not, where w feeds what there is of them."""
    assert undercut(problem).gamma == pytest.approx(decomposed.solve(problem).gamma, rel=1e-3)
