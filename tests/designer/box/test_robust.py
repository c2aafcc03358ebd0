"""Gamma for every model of a box, against models of it: filters on unit vectors, every outcome of chance."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from fractions import Fraction
from functools import cache
from typing import Any

import numpy as np
import pytest
from made_recordings import observer_gains, random_gains, real_problem, uncertified
from outcomes import moment
from places import ROOT

from agent.contract.arrays import Array
from agent.contract.gains import Gains
from agent.contract.problem import Problem
from agent.contract.problem.matrices import Matrices
from designer.box import worst as worst_of_a_box
from designer.box.extent import Box, box_of, corners, truth_at, within
from designer.box.radius import Shape, _Search, radii
from designer.box.robust import Robust, proved_at, robust
from designer.box.worst import _gain, worst
from designer.cli import main
from designer.gain.exact import exact_gain
from designer.ladder import FOUND_IN_BOX, PROVED_IN_BOX, Ladder
from designer.model.error_model import error_model, stacked_gains
from designer.patience import Budget
from designer.proof.ball_model import Truth
from designer.proof.by_floats import ByFloats
from designer.proof.by_vertices import ByVertices, prove, upper_bound
from designer.proof.cube import Cube
from designer.proof.prover import Prover

GOLDEN = ROOT / "recordings" / "golden" / "zhu2020-lossy.gains.json"


@dataclass(frozen=True, eq=False)
class Case:
    gains: Gains
    box: Box
    answer: Robust

    def truth(self, rng: np.random.Generator) -> Truth:
        """A model of the box, half of them with probabilities at an end."""
        problem, box = self.gains.problem, self.box
        beta, rho, sharp = np.array(problem.beta), np.array(problem.delivery), rng.uniform() < 0.5
        for part in box.intervals:
            share = rng.integers(2) if sharp else rng.uniform()
            (beta if part.matrix == "beta" else rho)[part.at] = part.low + share * (part.high - part.low)
        rows = []
        for of_mode in box.rows:
            weights = (
                np.eye(len(of_mode))[rng.integers(len(of_mode))] if sharp else rng.dirichlet(np.ones(len(of_mode)))
            )
            rows.append(
                [
                    sum(float(w) * float(pi[t]) for w, pi in zip(weights, of_mode, strict=True))
                    for t in range(len(of_mode[0]))
                ]
            )
        signs = rng.choice([-1, 1], len(box.entries)) if sharp else rng.uniform(-1.0, 1.0, len(box.entries))
        matrices = truth_at(problem, box, [False] * len(box.intervals), [0] * len(box.rows), list(signs)).matrices
        return Truth(beta, rho, rows, matrices, box.carry)  # type: ignore[arg-type]


@cache
def case(name: str) -> Case:
    """Two nodes, two modes: half of the gains of random filters, and a box."""
    seen, links, texts = {
        "hidden": (False, False, ("probabilities=0.1",)),
        "seen, links": (True, True, ("probabilities=20%",)),
        "rows": (False, False, ("transition=0.3",)),
        "all": (False, True, ("probabilities=0.05", "transition=0.2")),
        "from 0 to 1": (False, True, ("probabilities=1",)),
        "unbiased": (False, True, ("probabilities=0.3",)),
        "matrices": (False, True, ("A,B,C,D,M=1%",)),
        "matrices, seen": (True, True, ("A,C=0.5%", "M=0.02", "D=0.02")),
        "matrices, unbiased": (True, False, ("A,B,C,D=1%",)),
        "everything": (True, True, ("A,B,C,D,M=0.5%", "probabilities=0.02", "transition=0.05")),
    }[name]
    problem = real_problem(4, seen=seen, links=links, unbiased="unbiased" in name, ny=(1, 1), modes=2)
    gains = observer_gains(problem) if problem.unbiased else random_gains(problem)
    box = box_of(problem, within(texts))
    return Case(gains, box, robust(problem, gains.K, gains.H, box))


def provers(found: Case, every: list[Truth]) -> ByVertices:
    """With weights that know nothing."""
    gains = found.gains
    models = [Cube(gains.problem, gains.K, gains.H, truth, found.box.entries) for truth in every]
    return ByVertices(models, np.tile(np.eye(models[0].model.order), (1, models[0].model.modes, 1, 1)))


CASES = [
    "hidden",
    "seen, links",
    "rows",
    "all",
    "from 0 to 1",
    "unbiased",
    "matrices",
    "matrices, seen",
    "matrices, unbiased",
    "everything",
]


def moment_of(gains: Gains, mode: str, truth: Truth, Y_bar: Array) -> Array:
    return moment(gains, mode, truth.beta, truth.rho, Y_bar, truth.matrices)


def step(gains: Gains, truth: Truth, Y: Array, g: float) -> Array | None:
    """The recursion for one model, by its definition; None where a W is not positive definite."""
    problem, following = gains.problem, []
    for s, mode in enumerate(problem.mode_names):
        Y_bar = sum(float(pi) * Y_t for pi, Y_t in zip(truth.transition[s], Y, strict=True))
        S, n = moment_of(gains, mode, truth, np.asarray(Y_bar)), Y.shape[1]
        W = g * np.eye(problem.nw) - S[n:, n:]
        if np.linalg.eigvalsh(W)[0] <= 0.0:
            return None
        following.append(S[:n, :n] + S[:n, n:] @ np.linalg.solve(W, S[n:, :n]))
    return np.array(following)


def peak(problem: Problem, matrices: Matrices | None = None) -> Array:
    """M'M of every mode."""
    off = 0.0 * problem.plant.M if matrices is None else matrices.M - problem.plant.M
    z = [np.hstack([off, *(problem.plant.M * (i == j) for j in range(problem.n))]) for i in range(problem.n)]
    M = np.vstack([weight * z_i for weight, z_i in zip(problem.weights, z, strict=True)])
    return np.tile(M.T @ M, (len(problem.topologies), 1, 1))


def lasts(gains: Gains, models: list[Truth], gamma: float) -> bool:
    """Whether every W is positive definite through these models, from the last step backwards."""
    Y: Array | None = peak(gains.problem, models[0].matrices)
    for truth in models:
        Y = step(gains, truth, Y, gamma**2) if Y is not None else None
    return Y is not None


@pytest.mark.parametrize("name", CASES)
def test_no_model_of_the_box_exceeds_gamma_though_it_changes_at_every_step(name: str) -> None:
    found, rng = case(name), np.random.default_rng(1)
    assert found.answer.gamma is not None, found.answer.lines()
    for _ in range(3):
        assert lasts(found.gains, [found.truth(rng) for _ in range(8)], found.answer.gamma)


@pytest.mark.parametrize("name", CASES)
def test_the_worst_that_is_found_is_in_the_box_and_attains_what_is_said(name: str) -> None:
    """Its gain by its definition, over so many steps; the one that is proved is not far above."""
    found = case(name)
    worst, gamma, at = found.answer.found, found.answer.gamma, found.answer.worst
    assert gamma is not None
    assert worst <= gamma < 1.1 * worst
    if all(len(rows) == 1 for rows in found.box.rows):
        assert not lasts(found.gains, [at.truth] * 60, worst * 0.999)
        assert lasts(found.gains, [at.truth] * 60, worst * 1.001)


@pytest.mark.parametrize("name", CASES)
def test_a_step_stands_above_the_mean_of_every_model_by_every_outcome(name: str) -> None:
    found, rng = case(name), np.random.default_rng(2)
    gains, problem = found.gains, found.gains.problem
    by = provers(found, corners(problem, found.box))
    half = rng.normal(size=peak(problem).shape)
    Y = half @ half.swapaxes(1, 2)
    Z = by.upper(Y, 0)
    for truth in (found.truth(rng) for _ in range(6)):
        for s, mode in enumerate(problem.mode_names):
            Y_bar = sum(float(pi) * Y_t for pi, Y_t in zip(truth.transition[s], Y, strict=True))
            assert np.linalg.eigvalsh(Z[s] - moment_of(gains, mode, truth, np.asarray(Y_bar)))[0] > -1e-9


def test_an_entry_that_is_rounding_alone_does_not_raise_the_others() -> None:
    """As of errors that hardly move: what is above all corners there is measured by the whole, not by itself."""
    for seed in range(10):
        rng = np.random.default_rng(seed)
        F, G = rng.normal(size=(1, 4, 4)), rng.normal(size=(3, 1, 4, 4))
        G[..., 3, :] *= 1e-9
        X, S = F @ F.swapaxes(-1, -2) + np.eye(4), G @ G.swapaxes(-1, -2)
        without = upper_bound(S[..., :3, :3], X[..., :3, :3])
        Z = upper_bound(S, X)
        assert np.linalg.eigvalsh(Z - S).min() > -1e-14
        assert np.trace(X[0] @ Z[0]) < 1.0001 * np.trace(X[0, :3, :3] @ without[0])


# mutants
@pytest.mark.parametrize("name", ["hidden", "rows"])
def test_an_upper_bound_of_a_box_that_is_too_small_is_none(name: str) -> None:
    """By 1 %, or by a corner: what is above the S of the mutant is proved not to be above the S of the box."""
    found = case(name)
    problem, every = found.gains.problem, corners(found.gains.problem, found.box)
    whole = provers(found, every)
    half = np.random.default_rng(3).normal(size=peak(problem).shape)
    Y = half @ half.swapaxes(1, 2)
    full = [corner.joint(Y, whole.mean) for corner in whole.corners]
    assert whole._is_above(whole.upper(Y, 0), full)  # type: ignore[arg-type]
    texts = {"hidden": "probabilities=0.099", "rows": "transition=0.297"}
    smaller = corners(problem, box_of(problem, within([texts[name]])))
    assert not whole._is_above(provers(found, smaller).upper(Y, 0), full)  # type: ignore[arg-type]
    left_out = [
        whole._is_above(provers(found, every[:k] + every[k + 1 :]).upper(Y, 0), full) for k in range(len(every))
    ]
    assert not all(left_out)


def one_node() -> Gains:
    """That has to hear a plant of radius 1.2: stable where it does with a probability above 1 - 1 / 1.44 = 0.3056."""
    problem = Problem.from_document(
        {
            "name": "one",
            "plant": {"A": [[1.2]], "B": [[1.0, 0.0]], "M": [[1.0]]},
            "node": [{"name": "a", "C": [[1.0]], "D": [[0.0, 0.1]], "arrival_probability": 0.4, "loss": "seen"}],
            "topology": [{"name": "m", "adjacency": [[1]]}],
            "markov": {"transition": [[1.0]], "initial": "m"},
            "unbiased": True,
        }
    )
    K, H = ({"m": {"a": {"a": np.array([[1.2]])}}} for _ in range(2))
    return uncertified(problem, K, H, method="made up")


@pytest.mark.parametrize("name", ["all", "unbiased", "everything"])
def test_where_time_is_over_what_was_found_is_proved(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Gamma stays above every model, though neither the worst of them nor the best weights are looked for."""
    found = case(name)
    problem, K, H = found.gains.problem, found.gains.K, found.gains.H
    looked, hurry = counted_gains(monkeypatch), Budget(0.0)
    soon = robust(problem, K, H, found.box, budget=hurry)
    assert len(looked) == 3  # the first model, and at the end it and the nominal one more closely
    assert len(hurry.left_out) == 2
    assert soon.gamma is not None
    assert soon.found <= found.answer.found <= soon.gamma
    again = proved_at(problem, K, H, found.box, soon.worst, soon.gamma, soon.recipe)
    assert again is not None
    assert again.holds


def test_where_there_is_time_nothing_is_left_out() -> None:
    found, budget = case("all"), Budget(1e6)
    assert (
        robust(found.gains.problem, found.gains.K, found.gains.H, found.box, budget=budget).gamma == found.answer.gamma
    )
    assert not budget.left_out


def counted_gains(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Those of constant models, as they are computed."""
    looked: list[float] = []

    def gain(*given: Any, **more: Any) -> float:
        looked.append(_gain(*given, **more))
        return looked[-1]

    monkeypatch.setattr(worst_of_a_box, "_gain", gain)
    return looked


def test_an_unstable_model_in_the_box_has_no_gamma() -> None:
    gains = one_node()
    inside, beyond = (
        robust(gains.problem, gains.K, gains.H, box_of(gains.problem, within([f"probabilities={size}"])))
        for size in (0.09, 0.1)
    )
    assert inside.gamma is not None
    assert (beyond.gamma, beyond.found) == (None, math.inf)
    assert "a model in it is not mean-square stable" in "\n".join(beyond.lines())


@pytest.mark.parametrize("mutant", ["too small by 1 %", "a corner left out"])
def test_what_is_proved_of_less_than_the_box_is_false_of_the_box(mutant: str) -> None:
    """The model that the mutant forgets refutes its gamma, by the definition of W; and so it is not proved."""
    gains = one_node()
    problem = gains.problem
    box = box_of(problem, within(["probabilities=0.08"]))
    if mutant == "too small by 1 %":
        less = box_of(problem, within(["probabilities=0.0792"]))
    else:
        less = box._replace(intervals=(box.intervals[0]._replace(low=box.intervals[0].high),))
    honest, proved = (robust(problem, gains.K, gains.H, each) for each in (box, less))
    assert honest.gamma is not None
    assert proved.gamma is not None
    forgotten = [truth_at(problem, box, [False], [0])] * 200
    assert lasts(gains, forgotten, honest.gamma)
    assert not lasts(gains, forgotten, proved.gamma)
    by = provers(Case(gains, box, honest), corners(problem, box))
    P = ByFloats(problem, gains.K, gains.H, forgotten[0]).model.invariants[0]
    assert prove(by, problem.mode_names, honest.gamma * 1.01, P).holds
    assert not prove(by, problem.mode_names, proved.gamma, P).holds


def test_the_radius_is_proved_and_not_far_from_where_a_model_exceeds_it() -> None:
    gains = one_node()
    problem = gains.problem
    nominal = Prover(problem, gains.K, gains.H).exact(
        exact_gain(error_model(problem, *stacked_gains(gains))).high * 1.001
    )
    assert nominal.holds
    radius, of_B_and_D = radii(problem, gains.K, gains.H, nominal.gamma)
    assert (radius.shape.name, radius.gamma) == ("probabilities", nominal.gamma * 1.05)
    assert of_B_and_D.shape.name == "B, D"  # of A and C nothing may be off: the plant is unstable
    assert of_B_and_D.proved == pytest.approx(0.05, rel=0.1)  # gamma grows with B and D
    assert radius.beyond is not None
    box = box_of(problem, within([f"probabilities={radius.proved}"]))
    found = robust(problem, gains.K, gains.H, box).gamma
    assert found is not None
    assert found <= radius.gamma
    further = box_of(problem, within([f"probabilities={1.1 * radius.beyond}"]))
    assert lasts(gains, [truth_at(problem, box, [False], [0])] * 200, radius.gamma)
    assert not lasts(gains, [truth_at(problem, further, [False], [0])] * 200, radius.gamma)
    assert f"for {radius.beyond:.4f} that was not proved" in radius.line()


def test_rounds_of_weights_take_the_radius_further_and_not_beyond_a_model_that_has_more() -> None:
    gains = random_gains(real_problem(4, unbiased=False, links=False, ny=(1, 1), modes=1))
    problem, shape = gains.problem, Shape(("A", "B", "C", "D"), relative=True)
    gamma = 1.05 * exact_gain(error_model(problem, *stacked_gains(gains))).high
    search = _Search(problem, gains.K, gains.H, shape, gamma)
    plainly, beyond = search.coarse()
    low, high = search.further(plainly, beyond)
    assert low >= 1.05 * plainly
    assert search.plainly(low) is None
    found = search.by_rounds(low)
    assert found is not None
    assert prove(found.by, problem.mode_names, gamma, found.P).holds
    box = shape.box(problem, Fraction(high, 10_000) * Fraction(11, 10))
    assert worst(problem, gains.K, gains.H, box).gain > gamma


def test_the_commands_print_the_rungs_and_say_no(capsys: pytest.CaptureFixture[str]) -> None:
    box = ["--within", "probabilities=0.05"]
    assert main(["analyse", "zhu2020-lossy", "--gains", str(GOLDEN), *box, "--json"]) == 0
    analysed = json.loads(capsys.readouterr().out)
    ladder = analysed["ladder"]
    assert ladder["exact"][1] < ladder["found_in_box"] < ladder["proved_in_box"] < 1.01 * ladder["exact"][1]
    assert analysed["within"]["corners"] == 16
    assert main(["verify", str(GOLDEN), *box]) == 0
    assert f"gamma = {ladder['proved_in_box']} is proved for every model of the box" in capsys.readouterr().out
    assert main(["verify", str(GOLDEN), "--within", "probabilities=2"]) == 2


def test_what_analyse_says_of_a_box() -> None:
    found = case("hidden")
    lines = Ladder(None, (1.0, 2.0), 2.0, None, None, found_in_box=3.0, proved_in_box=found.answer.gamma).lines()
    assert [line.split("  ", 1)[1].strip() for line in lines[-2:]] == [FOUND_IN_BOX, PROVED_IN_BOX]
    assert "2 corners" in found.answer.lines()[0]
    assert found.answer.lines()[-1].startswith("           worst found at arrival at node")
