"""Any gains on any problem: what they guarantee, what attains it, and what does not fit."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from networks import random_gains, random_problem
from places import ROOT

from agent.contract.errors import InputError, Unattainable
from agent.contract.gains import Gains
from agent.contract.problem import Problem
from designer.analysis import GivenGains, analyse, certified, given_plain, load_given
from designer.cli import main
from designer.gain.exact import exact_gain
from designer.model.error_model import error_model, link_gains, stacked_gains
from designer.problems import find
from designer.proof.certificate import verify
from designer.proof.findings import Verdict
from designer.proof.prover import Prover
from designer.search.starts import ignoring, least_variance_gains

GOLDEN = ROOT / "recordings" / "golden" / "zhu2020-lossy.gains.json"
Document = dict[str, Any]


def plain(path: Path, gains: Any, **edits: Any) -> Path:
    """A JSON file with K and H alone."""
    document = {
        letter: {
            mode: {i: {j: np.asarray(gain).tolist() for j, gain in row.items()} for i, row in rows.items()}
            for mode, rows in getattr(gains, letter).items()
        }
        for letter in "KH"
    }
    path.write_text(json.dumps(document | edits))
    return path


def given(problem: Problem, seed: int, size: float) -> GivenGains:
    return GivenGains(*link_gains(problem, *random_gains(problem, seed, size=size)), "made up", None)


def test_a_gains_file_on_its_own_problem() -> None:
    """The exact gain is that of the error model; the worst fixed w, of energy 1, does no more."""
    problem = find("zhu2020-lossy")
    found = analyse(problem, load_given(GOLDEN, problem))
    gain = exact_gain(error_model(problem, *stacked_gains(Gains.load(GOLDEN))))
    assert (found.stable, found.foreign) == (True, False)
    assert found.ladder.exact == (gain.low, gain.high)
    assert found.ladder.floor == 0.0
    assert found.mode in problem.mode_names
    assert found.fixed is not None
    assert found.w is not None
    assert 0.5 * gain.low < found.fixed < gain.high
    assert np.linalg.norm(found.w) == pytest.approx(1.0)
    assert f'w = 0 until mode "{found.mode}", then w along [1], then' in found.text()
    assert f'from mode "{problem.markov.initial}" over {found.fixed_within} steps' in found.text()


def test_plain_gains_are_analysed_alike(tmp_path: Path) -> None:
    """A file with K and H alone gives what the gains file gives."""
    problem, gains = find("zhu2020-lossy"), Gains.load(GOLDEN)
    own, foreign = (
        analyse(problem, load_given(path, problem)).document()
        for path in (GOLDEN, plain(tmp_path / "mine.json", gains))
    )
    assert foreign["designed_for"] is None
    same = {"exact", "radius", "floor", "worst_policy", "worst_fixed"}
    assert {name: own[name] for name in same} == {name: foreign[name] for name in same}


def test_the_problem_decides() -> None:
    """Gains of the lossy example on the ideal one have the gain of that error model; the text says whose they are."""
    ideal = find("zhu2020-ideal")
    found = analyse(ideal, load_given(GOLDEN, ideal))
    gain = exact_gain(error_model(ideal, *stacked_gains(Gains.load(GOLDEN))))
    assert found.ladder.exact == (gain.low, gain.high)
    assert found.foreign
    assert "designed for another problem, zhu2020-lossy" in found.text()


def test_unstable_gains_have_no_gain() -> None:
    """Said with the radius, which is that of the error model; and no certificate is made."""
    problem = random_problem(3)
    wild = given(problem, 3, 3.0)
    found = analyse(problem, wild)
    assert not found.stable
    assert found.radius > 1.0
    assert found.ladder.exact is None
    assert (
        "NOT mean-square stable, proved: from some start the errors never die out; computed: in the long run each "
        f"step multiplies E|error|^2 by {found.radius:.9g}" in found.text()
    )
    with pytest.raises(Unattainable, match="are not mean-square stable"):
        certified(problem, wild)


def test_gains_beyond_float64_are_unstable(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Neither a warning of numpy nor a NaN in the JSON."""
    gains = {"linked": {"left": {"left": [[1e200]], "right": [[0.0]]}, "right": {"left": [[0.0]], "right": [[1e200]]}}}
    (tmp_path / "huge.json").write_text(json.dumps({"K": gains, "H": gains}))
    problem = find("two-nodes")
    analysis = analyse(problem, load_given(tmp_path / "huge.json", problem))
    assert not analysis.stable
    json.dumps(analysis.document(), allow_nan=False)
    assert "it is not known whether the errors are mean-square stable" in analysis.text()


def test_somebody_elses_gains_get_a_certificate() -> None:
    """It holds, and gamma is the exact gain."""
    problem = random_problem(2)
    gains = certified(problem, given(problem, 2, 0.1))
    assert verify(gains).holds
    assert gains.certificate.exact is not None
    assert gains.certificate.gamma == pytest.approx(gains.certificate.exact[1], rel=1e-6)
    assert Gains.from_bytes(gains.canonical(), source="memory") == gains


def test_what_is_proved_of_given_gains_is_on_the_ladder(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without any file being written; where it is not proved, why."""
    problem = random_problem(2)
    analysis = analyse(problem, given(problem, 2, 0.1))
    assert analysis.ladder.gamma == pytest.approx(analysis.ladder.exact[1], rel=1e-6)  # type: ignore[index]
    assert "gamma, certified" in analysis.text()
    assert analysis.document()["unproved"] is None
    monkeypatch.setattr(Prover, "exact", lambda self, gamma, most=0: Verdict(False, gamma, "none", "of the moon", {}))
    analysis = analyse(problem, given(problem, 2, 0.1))
    assert analysis.ladder.gamma is None
    assert "certified  no gamma: of the moon" in analysis.text()
    assert analysis.document()["unproved"] == "of the moon"


def test_a_certificate_of_given_gains_brings_the_worst_w_that_the_problem_asks_for() -> None:
    """Without it, `run` and `simulate` would refuse the file."""
    document = find("two-nodes").document() | {"disturbance": {"kind": "worst-case"}}
    problem = Problem.from_document(document)
    gains = certified(problem, given(problem, 1, 0.1))
    assert gains.worst_case is not None
    assert np.linalg.norm(gains.worst_case) == pytest.approx(1.0)


def drop_mode(document: Document) -> None:
    del document["K"]["2"]


def add_mode(document: Document) -> None:
    document["H"]["five"] = document["H"]["1"]


def drop_link(document: Document) -> None:
    del document["K"]["1"]["1"]["4"]


def add_link(document: Document) -> None:
    document["H"]["1"]["1"]["3"] = [[0.1], [0.1]]


def wrong_shape(document: Document) -> None:
    document["K"]["1"]["1"]["4"] = [[0.1], [0.1]]


def ragged(document: Document) -> None:
    document["K"]["1"]["1"]["4"] = [[0.1, 0.2], [0.1]]


def not_a_number(document: Document) -> None:
    document["H"]["1"]["1"]["4"] = [[0.1], ["x"]]


def drop_H(document: Document) -> None:
    del document["H"]


def add_key(document: Document) -> None:
    document["gamma"] = 1.0


@pytest.mark.parametrize(
    ("edit", "sentence"),
    [
        (drop_mode, 'does not fit zhu2020-lossy: K has gains for "1", "3" and "4"; the modes are'),
        (add_mode, 'H has gains for "1", "2", "3", "4" and "five"; the modes are "1", "2", "3" and "4"'),
        (drop_link, 'K: mode "1": node "1" has gains for "1"; the nodes that it hears in this mode are "1" and "4"'),
        (add_link, 'H: mode "1": node "1" has gains for "1", "4" and "3"; the nodes that it hears'),
        (wrong_shape, 'K: mode "1": node "1": from "4" is 2 x 1; it must be 2 x 2'),
        (ragged, "row 2 has 1 entry; row 1 has 2"),
        (not_a_number, "row 2 holds 'x', which is not a number"),
        (drop_H, '"H" is missing'),
        (add_key, "gamma: this key is not known here"),
    ],
)
def test_what_does_not_fit(tmp_path: Path, edit: Callable[[Document], None], sentence: str) -> None:
    """One sentence that names the file and the place."""
    path = plain(tmp_path / "mine.json", Gains.load(GOLDEN))
    document = json.loads(path.read_text())
    edit(document)
    path.write_text(json.dumps(document))
    with pytest.raises(InputError, match=re.escape(sentence)) as caught:
        load_given(path, find("zhu2020-lossy"))
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("content", ["[1, 2]", '{"k": 1}', '{"format": "other", "K": {}, "H": {}}'])
def test_a_file_without_gains(tmp_path: Path, content: str) -> None:
    (tmp_path / "mine.json").write_text(content)
    with pytest.raises(InputError, match=r"mine\.json (holds no gains|is not a gains file)"):
        load_given(tmp_path / "mine.json", find("two-nodes"))


def test_unbiased_problems_want_unbiased_gains(tmp_path: Path) -> None:
    """Gains whose sum over j of a_ij K_ij is not A are refused; those whose sum it is are analysed without x."""
    document = find("two-nodes").document() | {"unbiased": True}
    document["plant"]["A"] = [[1.25]]  # unstable: admissible, since no loss is hidden
    problem = Problem.from_document(document)
    gains = load_given(
        _scalars(tmp_path / "good.json", K={"left": 0.5, "right": 0.75}, H={"left": 0.6, "right": 0.45}), problem
    )
    found = analyse(problem, gains)
    assert found.stable
    assert found.ladder.exact is not None
    assert found.ladder.exact[0] < np.inf
    biased = _scalars(tmp_path / "bad.json", K={"left": 0.5, "right": 0.7}, H={"left": 0.6, "right": 0.45})
    with pytest.raises(InputError, match=r"the sum of a_ij K_ij differs from A by 0\.05"):
        load_given(biased, problem)


def test_a_plant_that_no_sensor_shows_is_said(tmp_path: Path) -> None:
    """Where the floor is infinite, no gains help; in JSON there is no floor."""
    document = find("two-nodes").document() | {"unbiased": True}
    document["plant"]["A"] = [[1.25]]
    for node in document["node"]:
        node["C"] = [[0.0]]
    problem = Problem.from_document(document)
    gains = _scalars(tmp_path / "any.json", K={"left": 0.5, "right": 0.75}, H={"left": 0.6, "right": 0.45})
    found = analyse(problem, load_given(gains, problem))
    assert not found.stable
    assert "no other gains do better" in found.text()
    assert json.loads(json.dumps(found.document(), allow_nan=False))["floor"] is None


def _scalars(path: Path, K: dict[str, float], H: dict[str, float]) -> Path:
    """The same gains at both nodes of two-nodes."""
    rows = {
        letter: {"linked": {i: {j: [[value]] for j, value in gains.items()} for i in ("left", "right")}}
        for letter, gains in (("K", K), ("H", H))
    }
    path.write_text(json.dumps(rows))
    return path


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Exit 0 with a gain and 1 without; -o writes a file that verifies."""
    monkeypatch.chdir(tmp_path)
    good = _scalars(tmp_path / "good.json", K={"left": 0.4, "right": 0.34}, H={"left": 0.288, "right": 0.216})
    assert main(["analyse", "two-nodes", "--gains", str(good), "-o", "gains.json", "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["stable"]
    assert facts["gamma"] == pytest.approx(facts["exact"][1], rel=1e-6)
    assert main(["verify", "gains.json"]) == 0
    capsys.readouterr()
    wild = _scalars(tmp_path / "wild.json", K={"left": 0.9, "right": 0.9}, H={"left": 0.0, "right": 0.0})
    assert main(["analyse", "two-nodes", "--gains", str(wild), "-o", "never.json"]) == 1
    assert "NOT mean-square stable" in capsys.readouterr().out
    assert not Path("never.json").exists()


def test_how_many_steps_show_the_lower_end_is_said_where_it_is_known() -> None:
    """One is singular; of errors that decay slowly it is not known."""
    problem = find("two-nodes")
    found = analyse(problem, GivenGains(*link_gains(problem, *ignoring(problem)), "mine", None))
    assert "proved: 1 step shows that it is no less\n" in found._replace(horizon=1, radius=0.5).text()
    assert "proved: 2 steps show that it is no less\n" in found._replace(horizon=2, radius=0.5).text()
    assert "no less" not in found._replace(horizon=2, radius=0.9999).text()


def test_what_is_proved_stable_is_not_called_unstable_where_floats_find_no_gain() -> None:
    """So it is with disturbances whose squares overflow."""
    problem = find("two-nodes")
    gains = link_gains(problem, *least_variance_gains(problem))
    analysis = analyse(problem.with_(plant={"B": [[1e90, 0.0, 0.0]], "M": [[1e90]]}), given_plain(problem, *gains))
    assert analysis.stable
    assert "mean-square stable, proved, but no gain was found" in analysis.text()
    assert "NOT" not in analysis.text()
