"""From a problem to gains with a gamma that is confirmed."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from networks import random_problem

from agent.contract.errors import InputError, Unattainable
from agent.contract.gains import Solver
from agent.contract.problem import Problem
from designer import synthesis
from designer.lmi import LmiSolution
from designer.lmi.lmi_design import METHODS
from designer.model.units import NaturalUnits
from designer.problems import find
from designer.proof.certificate import verify
from designer.synthesis import design

SOLVER = Solver(name="made up", version="0", status="optimal_inaccurate", iterations=1, seconds=0.0)


@pytest.mark.parametrize("name", ["zhu2020-ideal", "zhu2020-lossy"])
@pytest.mark.parametrize("method", METHODS)
def test_the_papers_examples_are_confirmed_close_to_the_optimum(name: str, method: str) -> None:
    """Both gammas hold by the check without a solver; Theorem 1's lies within 1e-4 of the LMI's optimum."""
    gains = design(find(name), method=method)
    proved = gains.certificate
    assert proved.holds
    assert verify(gains).holds
    assert proved.lmi_gamma is not None
    assert proved.by_theorem1 == pytest.approx(proved.lmi_gamma, rel=1e-4)
    assert proved.kind == "exact"
    assert proved.exact is not None
    assert proved.gamma == pytest.approx(proved.exact[1], rel=1e-9)
    assert gains.seconds["total"] >= gains.seconds["solve"] > 0.0


@pytest.mark.parametrize(
    "problem",
    [
        random_problem(11),
        random_problem(12, n=1, modes=1),
        random_problem(13, n=4, nx=1, nw=3, nz=2, modes=1),
        random_problem(14, n=2, nx=3, modes=3, lossy=False),
    ],
    ids=["weights", "one-node-one-mode", "one-mode", "no-loss"],
)
def test_random_networks_are_confirmed(problem: Problem) -> None:
    """Different numbers of measurements, weights, one node, one mode, several disturbances: gains that hold."""
    gains = design(problem, method="theorem2-reduced")
    assert verify(gains).holds
    assert gains.certificate.by_theorem1 == pytest.approx(gains.certificate.lmi_gamma, rel=1e-3)


def test_a_node_gets_gains_only_from_nodes_that_it_hears() -> None:
    """K and H have the sparsity (9)."""
    gains = design(find("zhu2020-lossy"), method="theorem2-reduced")
    assert set(gains.K["1"]["2"]) == {"2"}
    assert set(gains.H["3"]["1"]) == {"1", "2", "4"}


def test_an_unknown_method_lists_the_methods() -> None:
    """A wrong method is bad input, answered before anything is solved."""
    with pytest.raises(InputError, match=r'"magic" does not exist; the methods are "theorem2"'):
        design(find("two-nodes"), method="magic")


def test_nothing_to_estimate_is_refused() -> None:
    """M = 0 is bad input: no gamma > 0 would mean anything."""
    document = find("two-nodes").document()
    document["plant"]["M"] = [[0.0]]
    with pytest.raises(InputError, match="M is zero"):
        design(Problem.from_document(document))


@pytest.mark.parametrize("bad", ["zero", "unstable", "not-a-number"])
def test_an_answer_that_the_check_does_not_confirm_is_refused(bad: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """optimal_inaccurate passes only if the check does; otherwise Unattainable names status, reason and advice."""
    Q = {
        "zero": np.zeros((1, 2, 1, 1)),
        "unstable": np.ones((1, 2, 1, 1)),
        "not-a-number": np.full((1, 2, 1, 1), np.nan),
    }
    wrong = LmiSolution(1.0, np.eye(1), Q[bad], np.ones((1, 2, 2)), 3.0 * np.ones((1, 2, 2)), SOLVER)
    monkeypatch.setitem(synthesis.METHODS, "wrong", lambda problem: iter([wrong]))
    with pytest.raises(Unattainable, match=r"made up says optimal_inaccurate .*does not confirm"):
        design(find("two-nodes"), method="wrong")


def test_an_inaccurate_answer_is_backed_off_until_it_holds(monkeypatch: pytest.MonkeyPatch) -> None:
    """A P that is a little too large for (17) is lowered, gamma rises by as much, and what is stored holds."""
    exact = next(METHODS["theorem2-reduced"](NaturalUnits(find("two-nodes")).problem))
    rough = exact._replace(R=1.00001 * exact.R, Q=1.00001 * exact.Q, X=1.00001 * exact.X, Y=1.00001 * exact.Y)
    monkeypatch.setitem(synthesis.METHODS, "rough", lambda problem: iter([rough]))
    gains = design(find("two-nodes"), method="rough")
    assert verify(gains).holds
    assert np.sqrt(2.0) < gains.certificate.gamma < np.sqrt(2.0) * (1.0 + 1e-4)


def test_an_answer_that_is_confirmed_near_its_gamma_is_taken_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever the solver calls it: optimal_inaccurate is good enough where the check says so."""
    good = next(METHODS["theorem2-reduced"](NaturalUnits(find("two-nodes")).problem))
    called_bad = good._replace(solver=good.solver.model_copy(update={"status": "optimal_inaccurate"}))

    def made(problem: Problem) -> Iterator[LmiSolution]:
        yield called_bad
        raise AssertionError("nobody should have asked for more")

    monkeypatch.setitem(synthesis.METHODS, "made", made)
    gains = design(find("two-nodes"), method="made")
    assert gains.solver.status == "optimal_inaccurate"
    assert verify(gains).holds


def test_the_best_confirmed_answer_is_kept_where_none_is_near_its_gamma(monkeypatch: pytest.MonkeyPatch) -> None:
    """Answers that are refused, or confirmed far above the LMI's gamma, lead to the next; what was tried is said."""
    good = next(METHODS["theorem2-reduced"](NaturalUnits(find("two-nodes")).problem))
    record = SOLVER.model_copy(update={"status": "optimal"})
    refused = good._replace(Y=3.0 * good.Y, solver=SOLVER)
    claims = [good._replace(gamma=share * good.gamma, solver=record) for share in (0.9, 0.8)]
    monkeypatch.setitem(synthesis.METHODS, "made", lambda problem: iter([refused, *claims]))
    gains = design(find("two-nodes"), method="made")
    assert gains.certificate.lmi_gamma == NaturalUnits(find("two-nodes")).output * claims[0].gamma
    assert gains.solver.status == "optimal; tried further: made up optimal"
    assert gains.certificate.gamma == pytest.approx(np.sqrt(2.0), rel=1e-4)


@pytest.mark.parametrize("method", ["exact", "decomposed"])
@pytest.mark.parametrize(("M", "B"), [([[0.0, 0.0]], [[1.0], [1.0]]), ([[1.0, 0.0]], [[0.0], [1.0]])])
def test_a_z_that_never_moves_is_refused(method: str, M: list[list[float]], B: list[list[float]]) -> None:
    """M = 0, or no w reaches z: the best error is 0, and no gamma above 0 is the least."""
    plant = {"A": [[0.5, 0.0], [0.1, 0.4]], "B": B, "M": M}
    with pytest.raises(InputError, match="nothing to estimate"):
        design(Problem.from_document(one_node(plant, C=[[1.0, 1.0]])), method=method)


def test_an_error_that_can_be_0_has_no_least_gain() -> None:
    """The node measures w itself, so its estimate can be exact."""
    document = one_node({"A": [[0.5]], "B": [[1.0]], "M": [[1.0]]}, C=[[0.0]])
    with pytest.raises(InputError, match="no least gain"):
        design(Problem.from_document(document), method="exact")


def one_node(plant: dict[str, object], C: list[list[float]]) -> dict[str, object]:
    """A node that is alone and measures C x + w without loss."""
    return {
        "name": "alone",
        "plant": plant,
        "node": [{"name": "a", "C": C, "D": [[1.0]], "arrival_probability": 1.0}],
        "topology": [{"name": "still", "adjacency": [[1.0]]}],
        "markov": {"transition": [[1.0]], "initial": "still"},
    }


def test_without_a_budget_there_is_that_of_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(synthesis, "default_budget", lambda problem: 1e-9)
    assert design(find("two-nodes")).solver.status.startswith("out of time")
