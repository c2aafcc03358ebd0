"""Gains that are designed for a box: better there than the nominal design, or that."""

from __future__ import annotations

import io
import json
import math
from collections.abc import Callable
from contextlib import redirect_stdout
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from made_recordings import real_problem

from agent.contract.gains import Gains
from agent.contract.problem import Problem
from designer import synthesis
from designer.box import design as designing
from designer.box.design import ForBox, design_for_box
from designer.box.extent import Box, box_in, box_of, corners, within
from designer.box.robust import robust
from designer.box.worst import real, real_model
from designer.cli import main
from designer.commands.design import design_text
from designer.gain.exact import exact_gain
from designer.ladder import NOMINAL, NOMINAL_IN_BOX
from designer.patience import Budget
from designer.problems import text_of
from designer.proof.ball_model import told
from designer.ranking import Rank, table
from designer.search.descent import Progress
from designer.synthesis import design, design_in_box


@cache
def nominal() -> Gains:
    """Two nodes, two modes, hidden losses and a lossy link."""
    return design(real_problem(4, seen=False, links=True, unbiased=False, ny=(1, 1), modes=2))


def box() -> Box:
    return box_of(nominal().problem, within(["probabilities=0.1"]))


def for_box(**named: Any) -> ForBox:
    return briefly(nominal().problem, box(), nominal(), **named)


def briefly(problem: Problem, box: Box, gains: Gains, **named: Any) -> ForBox:
    """`design_for_box` with one weight alone: a second."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(designing, "_WEIGHTS", (3e-3,))
        return design_for_box(problem, box, gains, **named)


@cache
def honest() -> ForBox:
    return for_box()


def interrupting(at: int) -> Callable[..., Any]:
    """What raises KeyboardInterrupt at this call, and does nothing before."""
    calls = [0]

    def interrupt(*_: Any) -> None:
        calls[0] += 1
        if calls[0] == at:
            raise KeyboardInterrupt

    return interrupt


def gamma_of(gains: Gains, box: Box) -> float:
    found = robust(gains.problem, gains.K, gains.H, box).gamma
    return math.inf if found is None else found


def worst_of(gains: Gains, box: Box) -> float:
    """The largest exact gain of all corners."""
    models = (real_model(gains.problem, gains.K, gains.H, corner) for corner in corners(gains.problem, box))
    return max(exact_gain(model).high for model in models)


class Pendulum(NamedTuple):
    """What `design` made and said of the inverted pendulum, whose camera and gyro are known to 0.05."""

    path: Path
    said: dict[str, Any]
    nominal: Gains


@pytest.fixture(scope="module")
def pendulum(tmp_path_factory: pytest.TempPathFactory) -> Pendulum:
    nominal: list[Gains] = []

    def designed(problem: Problem, box: Box, gains: Gains, **named: Any) -> ForBox:
        nominal.append(gains)
        return design_for_box(problem, box, gains, **named)

    folder, text = tmp_path_factory.mktemp("pendulum"), text_of("inverted-pendulum")
    for value in ("0.9", "0.7"):
        line = f"\narrival_probability = {value}\n"
        assert text.count(line) == 1
        text = text.replace(line, f"{line}tolerance = {{arrival_probability = 0.05}}\n")
    (folder / "pendulum.toml").write_text(text)
    out, path = io.StringIO(), folder / "gains.json"
    with redirect_stdout(out), pytest.MonkeyPatch.context() as patch:
        patch.setattr(synthesis, "design_for_box", designed)
        assert main(["design", str(folder / "pendulum.toml"), "-o", str(path), "--json"]) == 0
    return Pendulum(path, json.loads(out.getvalue()), *nominal)


def test_every_model_of_the_pendulums_box_does_better_than_the_worst_for_the_nominal_design(
    pendulum: Pendulum, capsys: pytest.CaptureFixture[str]
) -> None:
    """So it is no better proof alone: the nominal design has a model that is above what is proved of the other."""
    gains, nominal, ladder = Gains.load(pendulum.path), pendulum.nominal, pendulum.said["ladder"]
    box = box_in(gains.problem)
    assert box is not None
    assert box.corners == 4
    proved = ladder["proved_in_box"]
    assert worst_of(gains, box) <= proved == gamma_of(gains, box)
    assert ladder["nominal_in_box"] == pytest.approx(gamma_of(nominal, box), rel=1e-9)
    assert worst_of(nominal, box) > 1.03 * proved
    assert ladder["nominal_exact"] == nominal.gamma < gains.gamma < 1.02 * nominal.gamma
    assert main(["verify", str(pendulum.path)]) == 0
    assert f"gamma = {proved} is proved for every model of the box" in capsys.readouterr().out


def test_what_is_said_has_both_designs(pendulum: Pendulum) -> None:
    said = pendulum.said
    assert said["within"]["nominal"] == {
        "gamma": said["ladder"]["nominal_exact"],
        "proved": said["ladder"]["nominal_in_box"],
        "kept": False,
    }
    assert said["within"]["said"][-1].strip().startswith("against the nominal design -")
    printed = design_text(said)
    assert all(line in printed for line in (NOMINAL, NOMINAL_IN_BOX, *said["within"]["said"]))


def test_gains_are_ranked_by_what_is_proved_for_the_box(
    pendulum: Pendulum, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """There the nominal design comes after that for the box, though its own gamma is less."""
    other = tmp_path / "nominal.json"
    pendulum.nominal.save(other)
    problem = str(pendulum.path.with_name("pendulum.toml"))
    words = ["analyse", problem, "--gains", str(other), "--against", str(pendulum.path)]
    assert main([*words, "--against", "least-variance", "--json"]) == 0
    rows = {row["gains"]: row for row in json.loads(capsys.readouterr().out)["against"]}
    assert next(iter(rows)) == str(pendulum.path)
    ours, nominal = rows[str(pendulum.path)], rows[str(other)]
    assert ours["in_box"] == pendulum.said["ladder"]["proved_in_box"] < nominal["in_box"]
    assert nominal["gamma"] < min(ours["gamma"], rows["least-variance"]["gamma"])
    printed = table([Rank(**row) for row in rows.values()], in_box=True).splitlines()
    assert printed[0].split("  ")[0] == "proved for the box"
    assert [line.split("  ")[-1].strip() for line in printed[1:]] == list(rows)


# never worse
def test_a_descent_that_ignores_the_box_is_not_as_good(monkeypatch: pytest.MonkeyPatch) -> None:
    """It goes down for the nominal model once for every corner; what that gives is proved, and far above."""
    good = honest()
    monkeypatch.setattr(designing, "real", lambda problem, truth: real(problem, told(problem)))
    mutant = for_box()
    assert good.robust.gamma is not None
    assert good.robust.gamma < 0.98 * gamma_of(mutant.gains, box())
    assert gamma_of(mutant.gains, box()) <= gamma_of(nominal(), box())


@pytest.mark.parametrize("worse", [1.0, 2.0, math.inf])
def test_gains_of_which_no_less_is_proved_are_not_taken(worse: float, monkeypatch: pytest.MonkeyPatch) -> None:
    before = robust(nominal().problem, nominal().K, nominal().H, box())
    assert before.verdict is not None

    def proved(problem: Problem, K: Any, H: Any, box: Box, *, budget: Budget) -> Any:
        of_nominal = K is nominal().K
        verdict = (
            before.verdict
            if of_nominal or worse == 1.0
            else before.verdict._replace(  # type: ignore[union-attr]
                gamma=before.gamma * worse, holds=math.isfinite(worse)
            )
        )
        return before._replace(verdict=verdict)

    monkeypatch.setattr(designing, "robust", proved)
    found = for_box()
    assert found.gains is nominal()
    assert (found.better, found.robust) == (False, before)
    assert found.lines()[-1].strip().startswith("the nominal design is kept: nothing better was found; converged")
    assert found.document()["nominal"] == {"gamma": nominal().gamma, "proved": before.gamma, "kept": True}


@pytest.mark.parametrize("at", [1, 12])
def test_ctrl_c_keeps_what_was_best_and_proves_it(at: int) -> None:
    found = for_box(progress=interrupting(at))
    assert f"interrupted after {at} change" in found.searched
    assert found.robust.gamma == gamma_of(found.gains, box()) <= gamma_of(nominal(), box())


def test_ctrl_c_before_the_search_still_says_what_is_proved(monkeypatch: pytest.MonkeyPatch) -> None:
    interrupt = interrupting(1)

    def proved(*given: Any, budget: Budget) -> Any:
        interrupt()
        return robust(*given, budget=budget)

    monkeypatch.setattr(designing, "robust", proved)
    found = for_box()
    assert found.gains is nominal()
    assert found.robust.gamma == gamma_of(nominal(), box())
    stopped = design_in_box(nominal().problem, box(), progress=interrupting(1))
    assert stopped.gains.solver.status.startswith("interrupted")
    assert stopped.lines()[-1].strip() == "the nominal design is kept: interrupted, nothing else was tried"


def test_where_no_time_is_left_the_nominal_design_is_kept() -> None:
    found = for_box(budget=Budget(0.0))
    assert found.gains is nominal()
    assert "out of time after 0 changes" in found.searched


def test_gains_of_another_method_are_proved_and_kept() -> None:
    problem = nominal().problem
    found = design_in_box(problem, box(), method="least-variance")
    assert found.gains.method == "least-variance"
    assert found.lines()[-1].strip() == "the nominal design is kept: method least-variance does not design for a box"
    assert found.robust.gamma is not None


# how it is found
def test_a_horizon_that_is_too_short_is_doubled(monkeypatch: pytest.MonkeyPatch) -> None:
    good = honest().robust.gamma
    monkeypatch.setattr(designing, "_HORIZON", 2)
    horizons: list[int] = []

    def progress(at: Progress) -> None:
        horizons.append(at.horizon)

    found = for_box(progress=progress)
    assert good is not None
    assert found.robust.gamma == pytest.approx(good, rel=5e-3)
    assert (horizons[0], horizons[-1] >= 8) == (2, True)


def test_matrices_that_are_uncertain_are_designed_for(pendulum: Pendulum, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(designing, "_WEIGHTS", (9e-5,))
    gains = pendulum.nominal
    found = design_for_box(gains.problem, box_of(gains.problem, within(["B,D=1%"])), gains)
    assert any(found.robust.worst.signs)
    assert found.before.gamma is not None
    assert found.robust.gamma is not None
    assert found.robust.found < found.robust.gamma < found.before.gamma
    assert found.robust.found < found.before.found


@pytest.mark.parametrize("texts", [["probabilities=0.1"], ["A,B,C,D,M=0.3%"]])
def test_other_units_give_the_same_gains(texts: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """States, measurements and z in other powers of two: every bit that the search goes through is as it was."""
    before = honest().before
    monkeypatch.setattr(designing, "robust", lambda *_, **__: before)
    x, y, document = np.array([2.0**9, 2.0**-7])[: nominal().problem.nx], 2.0**5, nominal().problem.document()
    plant, rows = nominal().problem.plant, x[:, None]
    document["plant"] |= {
        "A": (plant.A * x / rows).tolist(),
        "B": (plant.B / rows).tolist(),
        "M": (plant.M * x * 8.0).tolist(),
    }
    for said, node in zip(document["node"], nominal().problem.nodes, strict=True):
        said |= {"C": (node.C * x / y).tolist(), "D": (node.D / y).tolist()}
    problem = Problem.from_document(document)
    K = {
        s: {i: {j: K_ij * x / rows for j, K_ij in of_i.items()} for i, of_i in of_s.items()}
        for s, of_s in nominal().K.items()
    }
    H = {
        s: {i: {j: H_ij * y / rows for j, H_ij in of_i.items()} for i, of_i in of_s.items()}
        for s, of_s in nominal().H.items()
    }
    there = nominal().model_copy(update={"problem": problem, "problem_digest": problem.digest(), "K": K, "H": H})
    monkeypatch.setattr(designing, "_WEIGHTS", (3e-3,))
    here, other = (
        designing._Search(
            gains.problem, box_of(gains.problem, within(texts)), gains, before, Budget(), interrupting(25)
        )
        for gains in (nominal(), there)
    )
    assert here.run() == other.run() == "interrupted"
    assert here.met == other.met
    assert len(here.met) == 2  # so the gains of the search have looked for a corner themselves
    assert not np.array_equal(here.v, here.begin)
    np.testing.assert_array_equal(here.v, other.v)


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--within", "probabilities=2"], '"2" is no tolerance'),
        (["--within", "gain=0.1"], "is none of"),
        (["--within", "transition=0.1", "--price"], "--within is for one design"),
    ],
)
def test_what_makes_no_sense_is_refused(
    words: list[str], sentence: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["design", "zhu2020-lossy", *words]) == 2
    assert sentence in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
