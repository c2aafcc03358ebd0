"""What a gains file claims of its problem's box: made, proved again by `verify`, and refused where it is wrong."""

from __future__ import annotations

import json
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import peakmesh
import pytest

from agent.contract.errors import InputError
from agent.contract.gains import Gains
from agent.contract.problem import Problem
from agent.contract.problem.matrices import Matrices
from designer.analysis import certified, given
from designer.box import claim
from designer.box.claim import again, with_claim
from designer.box.extent import box_in, box_of, within
from designer.box.robust import robust
from designer.box.worst import real_model
from designer.cli import main
from designer.gain.exact import exact_gain
from designer.ladder import FOUND_IN_BOX, PROVED_IN_BOX, ladder_of
from designer.model.error_model import model_of_gains
from designer.problems.written import to_toml
from designer.proof.ball_model import Truth


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


def test_where_the_file_does_not_say_how_weights_are_made_they_are_sought(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """And names another model as the worst: what stands there proves nothing, and the claim is as true as before."""
    changes: dict[str, Any] = {"rounds": [], "signs": [1, -1, 1], "ends": [True]}
    path, gamma = edited(tmp_path, **changes), claimed().certificate.box_gamma
    assert main(["verify", str(path)]) == 0
    assert f"gamma = {gamma} is proved for every model of the box" in capsys.readouterr().out
    assert main(["verify", str(edited(tmp_path, **changes, gamma=0.9999 * gamma))]) == 1  # type: ignore[operator]
    monkeypatch.setattr(claim, "robust", lambda *_, **__: again(claimed())._replace(verdict=None))  # type: ignore[union-attr]
    assert main(["verify", str(path)]) == 1


@pytest.mark.parametrize("size", [1e-9, 1e-3])
def test_the_worst_that_is_found_has_no_less_than_the_model_of_the_file(size: float) -> None:
    """However near all of the box are to it."""
    gains = claimed()
    problem = gains.problem.certain()
    exact = exact_gain(model_of_gains(problem, gains.K, gains.H))
    found = robust(problem, gains.K, gains.H, box_of(problem, within([f"A={size}"])))
    assert exact.low * (1.0 - 1e-6) <= found.found


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
        ({"rounds": [[1e300, 0.4]]}, "rounds number 1 number 1: must be less than 1e"),
        ({"rounds": [[1.0, 1.5]]}, "rounds number 1 number 2: must be at most 1, got 1.5"),
        ({"rounds": [[1.0, 0.4]] * 101}, "rounds: .* 100 items"),
    ],
)
def test_a_claim_that_is_not_about_the_box_is_refused(changes: dict[str, Any], sentence: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=sentence):
        again(Gains.load(edited(tmp_path, **changes)))


@pytest.mark.parametrize("lie", [0.1, 10.0, None])
def test_the_worst_that_is_said_to_be_found_is_computed_again(lie: float | None, tmp_path: Path) -> None:
    found = again(Gains.load(edited(tmp_path, found=lie)))
    assert found is not None
    assert found.found == pytest.approx(claimed().certificate.box.found, rel=1e-4)  # type: ignore[union-attr]


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


# the library
def test_the_library_designs_verifies_and_analyses_for_the_box_as_the_commands_do(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    problem, path, file = scalar(), tmp_path / "gains.json", tmp_path / "problem.toml"
    file.write_text(to_toml(problem))
    gains = peakmesh.design(problem, method="least-variance")
    assert main(["design", str(file), "-o", str(path), "--json", "--method", "least-variance"]) == 0
    by_command = Gains.load(path).certificate
    said = json.loads(capsys.readouterr().out)
    assert gains.certificate.box == by_command.box
    assert gains.gamma == by_command.gamma

    proved = peakmesh.verify(path)
    assert proved.holds
    assert proved.within is not None
    assert proved.within.gamma == said["within"]["proved"] == by_command.box_gamma
    assert main(["verify", str(path), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said.keys() >= set(peakmesh.verify(path)._fields)
    assert said["within"] == proved.within.document()

    wider = {"probabilities": 0.05, "A,C": "2%"}
    assert main(["verify", str(path), "--within", "probabilities=0.05", "--within", "A,C=2%", "--json"]) == 0
    asked = peakmesh.verify(gains, within=wider).within
    assert asked is not None
    assert asked.document() == json.loads(capsys.readouterr().out)["within"]
    analysed = peakmesh.analyse(problem, gains, within=wider).robust
    assert analysed is not None
    assert analysed.gamma == asked.gamma
    with pytest.raises(InputError, match="is none of"):
        peakmesh.design(problem, within={"E": 0.1})


def test_the_library_refuses_a_claim_that_is_false(tmp_path: Path) -> None:
    found = claimed().certificate.box.found  # type: ignore[union-attr]
    proved = peakmesh.verify(edited(tmp_path, gamma=0.999 * found))  # type: ignore[operator]
    assert not proved.holds
    assert proved.failure is not None
    assert "for every model of its box" in proved.failure


def test_the_model_that_was_found_is_told_and_has_the_gain_that_is_said() -> None:
    """From its numbers alone, by the recursion for one model."""
    gains = claimed()
    found = again(gains)
    assert found is not None
    told = found.document()["worst_model"]
    matrices = Matrices(
        *(np.array(told[letter]) for letter in "ABM"), *(tuple(map(np.array, told[letter])) for letter in "CD")
    )
    transition = [[Fraction(pi) for pi in row] for row in told["transition"]]
    truth = Truth(np.array(told["arrival"]), np.array(told["delivery"]), transition, matrices, carry=True)
    gain = exact_gain(real_model(gains.problem, gains.K, gains.H, truth))
    assert gain.low == pytest.approx(found.found, rel=1e-4)
