"""What a gains file claims of its problem's box: made, proved again by `verify`, and refused where it is wrong."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agent.contract.errors import InputError
from agent.contract.gains import Gains
from agent.contract.problem import Problem
from designer.analysis import certified, given
from designer.box.claim import again, with_claim
from designer.box.extent import box_in
from designer.box.robust import robust
from designer.cli import main
from designer.ladder import FOUND_IN_BOX, PROVED_IN_BOX, ladder_of
from designer.problems.written import to_toml


def scalar(**more: Any) -> Problem:
    """One node that measures a stable plant, loses measurements, and knows neither quite."""
    return Problem.from_document(
        {
            "name": "scalar",
            "plant": {"A": [[0.8]], "B": [[1.0, 0.0]], "M": [[1.0]], "tolerance": {"A": "1%", "M": 0.01}},
            "node": [{"name": "a", "C": [[1.0]], "D": [[0.0, 0.5]], "arrival_probability": 0.9}],
            "topology": [{"name": "m", "adjacency": [[1]]}],
            "markov": {"transition": [[1.0]], "initial": "m"},
            "uncertainty": {"probabilities": 0.03, "C": "2%"},
            **more,
        }
    )


@cache
def claimed() -> Gains:
    problem = scalar()
    K, H = {"m": {"a": {"a": np.array([[0.8]])}}}, {"m": {"a": {"a": np.array([[0.4]])}}}
    box = box_in(problem)
    assert box is not None
    return with_claim(certified(problem, given(problem, K, H, source="test", file=None)), robust(problem, K, H, box))


def edited(folder: Path, **changes: Any) -> Path:
    document = json.loads(claimed().canonical())
    document["certificate"]["box"] |= changes
    path = folder / "gains.json"
    path.write_text(json.dumps(document))
    return path


def test_a_claim_is_between_the_worst_that_was_found_and_a_little_more_and_is_proved_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    gains = claimed()
    box = gains.certificate.box
    assert box is not None
    assert box.gamma is not None
    assert box.found is not None
    assert gains.certificate.gamma < box.found < box.gamma < 1.02 * box.found
    names = [name for name, _ in ladder_of(gains).rungs()]
    assert names[-2:] == [FOUND_IN_BOX, PROVED_IN_BOX]
    assert main(["verify", str(edited(tmp_path))]) == 0
    assert f"gamma = {box.gamma} is proved for every model of the box" in capsys.readouterr().out


def test_balls_prove_the_same_claim() -> None:
    found = again(claimed(), balls=True)
    assert found is not None
    assert found.gamma == claimed().certificate.box_gamma
    assert "ball arithmetic" in found.verdict.arithmetic  # type: ignore[union-attr]


@pytest.mark.parametrize("balls", [[], ["--balls"]])
def test_a_claim_below_what_a_model_of_the_box_has_is_refused(
    balls: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = claimed().certificate.box.found  # type: ignore[union-attr]
    assert main(["verify", str(edited(tmp_path, gamma=0.999 * found)), *balls]) == 1  # type: ignore[operator]
    assert "is not proved for" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"signs": [1]}, "signs has 1 entries"),
        ({"ends": []}, "ends has 0 entries"),
        ({"rows": [1]}, "names a corner that a row of the transition matrix does not have"),
        ({"signs": [2, 1, 1]}, "signs are -1, 0 or 1"),
    ],
)
def test_a_claim_that_is_not_about_the_box_is_refused(changes: dict[str, Any], sentence: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=sentence):
        again(Gains.load(edited(tmp_path, **changes)))


def test_a_claim_without_tolerances_is_refused() -> None:
    gains = claimed()
    problem = gains.problem.certain()
    plain = gains.model_copy(update={"problem": problem, "problem_digest": problem.digest()})
    with pytest.raises(InputError, match="the problem has no tolerances"):
        again(plain)


def test_verify_proves_the_box_of_the_problem_that_it_is_given(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Wider tolerances than those of the file are asked for; other numbers are another problem."""
    problem = tmp_path / "problem.toml"
    problem.write_text(to_toml(scalar(uncertainty={"probabilities": 0.06})))
    assert main(["verify", str(edited(tmp_path)), str(problem), "--json"]) == 0
    wider = json.loads(capsys.readouterr().out)
    assert wider["within"]["intervals"] == [['arrival at node "a"', pytest.approx(0.84), pytest.approx(0.96)]]
    assert main(["verify", str(edited(tmp_path)), str(problem), "--set", "node.a.arrival_probability=0.8"]) == 1


def test_a_box_of_which_nothing_is_claimed_is_looked_at_and_fails_only_who_asked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """0.8 and 30 % of it are unstable, which does not make the nominal gamma false."""
    problem = scalar(uncertainty={"A": "30%"}, plant={"A": [[0.8]], "B": [[1.0, 0.0]], "M": [[1.0]]})
    document = json.loads(claimed().canonical())
    document |= {"problem": problem.document(), "problem_digest": problem.digest()}
    del document["certificate"]["box"]
    path = tmp_path / "gains.json"
    path.write_text(json.dumps(document))
    assert main(["verify", str(path)]) == 0
    assert "no gamma is proved for the box" in capsys.readouterr().out
    assert main(["verify", str(path), "--within", "A=30%"]) == 1
