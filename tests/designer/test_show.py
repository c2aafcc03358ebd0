"""`show` says what a file is, or in one sentence why it is nothing."""

from __future__ import annotations

import json
import re
from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest
import rewriting
from here import here
from made_recordings import random_gains, random_problem, real_problem, record, simulate
from places import ROOT
from runs import answer

from agent.contract.errors import InputError
from agent.contract.gains import Gains
from agent.contract.layout import foxglove_layout
from designer import show
from designer.problems import find

GAINS = random_gains(random_problem(3))
STEPS = 12
GOLDEN = ROOT / "recordings" / "golden" / "zhu2020-lossy.mcap"


def test_a_built_in_problem_is_described_by_name_and_by_path() -> None:
    facts = show.describe("zhu2020-lossy")
    assert facts["kind"] == "problem"
    assert facts["nodes"] == ["1", "2", "3", "4"]
    assert facts["arrival_probability"] == [0.79, 0.85, 0.78, 0.92]
    assert (facts["states"], len(facts["modes"]), len(facts["digest"])) == (2, 4, 64)
    by_path = show.describe(show.PROBLEMS / "zhu2020-lossy.toml")
    assert by_path.pop("file").endswith("zhu2020-lossy.toml")
    assert by_path == facts


def test_what_real_networks_have_is_described(tmp_path: Path) -> None:
    problem = real_problem(1, ny=(1, 1, 1), modes=1)
    assert [(link.receiver, link.sender) for link in problem.links or ()] == [("n1", "n2")]
    facts = show._problem(problem)
    assert facts["sees_its_losses"] == ["n1", "n2"]
    assert facts["lossy_links"] == {"n2 to n1": 0.6}
    assert facts["unbiased"] is True
    text = show.text(facts)
    assert re.search("sees its losses +n1, n2\n", text)
    assert re.search("lossy links +n2 to n1: 0.6\n", text)
    assert re.search("unbiased +yes\n", text)
    plain = show.text(show.describe("zhu2020-lossy"))
    assert re.search("sees its losses +-\nlossy links +-\nunbiased +no\n", plain)


def test_what_is_said_beside_the_numbers_is_described() -> None:
    problem = find("zhu2020-lossy").with_(
        plant={"initial_error": [0.1, 0.0], "tolerance": {"A": "1%"}},
        node={"2": {"weight": 0.1, "tolerance": {"arrival_probability": [0.05, "2%"], "D": [[0.1]]}}},
        markov={"tolerance": {"transition": 0.05}},
        uncertainty={"probabilities": 0.02},
    )
    text = show.text(show._problem(problem))
    assert re.search("weights +2: 0.1\n", text)
    assert re.search("initial error +0.1, 0\n", text)
    said = ("A of plant: 1%", "D of 2: 0.1", "arrival_probability of 2: 0.05, 2%", "transition of markov: 0.05")
    assert re.search(f"tolerances +{'; '.join((*said, 'all probabilities: 0.02'))}\n", text)
    plain = show.text(show.describe("zhu2020-lossy"))
    assert not re.search("weights|initial error|tolerances", plain)


def test_without_a_file_the_built_in_problems_are_listed() -> None:
    facts = show.describe()
    assert facts["problems"]["zhu2020-ideal"] == "4 nodes, 2 states, 4 modes"
    assert "zhu2020-lossy      4 nodes" in show.text(facts)


def test_gains_are_described(tmp_path: Path) -> None:
    path = tmp_path / "gains.json"
    GAINS.save(path)
    facts = show.describe(str(path))
    assert (facts["kind"], facts["method"], facts["gamma"], facts["holds"]) == ("gains", "random", 1.0, False)
    assert facts["digest"] == GAINS.digest()
    text = show.text(facts)
    assert "none 0: none, 0 iterations" in text
    assert re.search("gamma +not claimed", text)


def test_what_gains_claim_is_shown_as_a_claim(tmp_path: Path) -> None:
    """Nothing but `verify` can say that it holds: the file may have been edited since."""
    document = Gains.load(GOLDEN.with_suffix(".gains.json")).document()
    document["certificate"] |= {"exact": None, "floor": None}
    gamma, path = document["certificate"]["gamma"], tmp_path / "gains.json"
    Gains.model_validate(document).save(path)
    facts = show.describe(path)
    assert (facts["holds"], facts["exact"]) == (True, None)
    text = show.text(facts)
    assert re.search(rf'gamma +claimed {gamma}, by design; "peakmesh verify" checks it', text)
    assert not re.search("^(holds|verified|exact|floor)", text, re.MULTILINE)
    assert "theorem1 gamma" not in text
    more = {"exact": [0.25, 0.5], "floor": 0.125, "lmi_gamma": 0.75, "kind": "exact", "theorem1_gamma": 0.875}
    document["certificate"] |= more
    Gains.model_validate(document).save(path, force=True)
    text = show.text(show.describe(path))
    assert re.search("exact +claimed between 0.25 and 0.5", text)
    assert re.search("floor +claimed 0.125", text)
    assert re.search("lmi gamma +claimed 0.75", text)
    assert re.search("theorem1 gamma +claimed 0.875", text)
    assert f'claimed {gamma}, by design; "peakmesh replay" checks it' in show.text(show.describe(GOLDEN))


def test_a_recording_is_described(tmp_path: Path) -> None:
    sent = simulate(GAINS, steps=STEPS)
    facts = show.describe(record(tmp_path / "run.mcap", GAINS, sent, steps=STEPS))
    assert facts["kind"] == "recording"
    assert facts["messages"] == Counter(message.topic for message in sent)
    assert (facts["run"], facts["seed"], facts["steps"], facts["status"]) == ("test", 1, 12, "finished")
    assert facts["damage"] == ""
    assert f"node/*/estimate: {4 * STEPS}" in show.text(facts)
    json.dumps(facts, allow_nan=False)


def test_a_cut_recording_says_so(tmp_path: Path) -> None:
    sent = simulate(GAINS, steps=STEPS)
    facts = show.describe(record(tmp_path / "run.mcap", GAINS, sent, steps=STEPS, whole=False))
    assert facts["status"] == "cut: it has no end"
    assert facts["complete_steps"] is None
    assert "cut or damaged" in facts["damage"]


def test_what_is_none_of_these_is_refused_in_one_sentence(tmp_path: Path) -> None:
    gains = GAINS.canonical()
    recording = record(tmp_path / "run.mcap", GAINS, simulate(GAINS, steps=STEPS), steps=STEPS).read_bytes()
    for name, data, why in (
        ("photo.png", b"\x89PNG\r\n\x1a\n", "is neither a problem"),
        ("empty", b"", "is neither a problem"),
        ("cut.json", gains[: len(gains) // 2], "is not valid JSON"),
        ("other.json", b'{"format": "other"}', "is not a gains file"),
        ("cut.mcap", recording[:100], "cut or damaged before its first message"),
        ("bad.toml", b"name = ", "is not valid TOML"),
        ("other.toml", b'name = "x"\n[tool]\na = 1\n', "this key is not known here"),
    ):
        path = tmp_path / name
        path.write_bytes(data)
        with pytest.raises(InputError, match=why) as raised:
            show.describe(path)
        assert str(path) in str(raised.value)
        assert "\n" not in str(raised.value)
    with pytest.raises(InputError, match=r'does not exist, nor is it a built-in problem; these are .*"zhu2020-lossy"'):
        show.describe(tmp_path / "nowhere")
    with pytest.raises(InputError, match="could not be read"):
        show.describe(tmp_path)


# attachments
@pytest.mark.parametrize("name", ["gains.json", "problem.json", "layout.json"])
def test_an_attachment_is_taken_out(name: str, tmp_path: Path) -> None:
    """As somebody else's reader finds it in the file."""
    from mcap.reader import make_reader

    with GOLDEN.open("rb") as file:
        attached = {found.name: found.data for found in make_reader(file).iter_attachments()}
    assert show.attachment(GOLDEN, name) == attached[name]
    done = here("show", GOLDEN, "--get", name, "-o", tmp_path / "out.json", "--json")
    assert answer(done) == {"attachment": name, "output": str(tmp_path / "out.json"), "bytes": len(attached[name])}
    assert (tmp_path / "out.json").read_bytes() == attached[name]
    assert here("show", GOLDEN, "--get", name).stdout.encode() == attached[name]


def test_gains_that_were_taken_out_are_the_runs_own(tmp_path: Path) -> None:
    """Whatever else is attached under that name."""
    contents = rewriting.read(GOLDEN)
    foreign = ("gains.json", b'{"pid": [1, 2]}'), ("layout.json", b"{}")
    path = rewriting.write(tmp_path / "run.mcap", replace(contents, attachments=(*foreign, *contents.attachments)))
    assert show.attachment(path, "gains.json") == Gains.load(GOLDEN.with_suffix(".gains.json")).canonical()


def test_a_layout_that_was_left_out_is_made_anew(tmp_path: Path) -> None:
    contents = rewriting.read(GOLDEN)
    kept = tuple(attached for attached in contents.attachments if attached[0] != "layout.json")
    path = rewriting.write(tmp_path / "run.mcap", replace(contents, attachments=kept))
    assert json.loads(show.attachment(path, "layout.json")) == foxglove_layout(find("zhu2020-lossy"))


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            [GOLDEN, "--get", "camera.png"],
            'has no attachment "camera.png"; it has "gains.json", "layout.json" and "problem.json"',
        ),
        ([GOLDEN.with_suffix(".gains.json"), "--get", "layout.json"], "is not a recording"),
        (["--get", "layout.json"], "name the recording"),
        ([GOLDEN, "-o", "out.json"], "--output is for --get"),
        ([GOLDEN, "--get", "gains.json", "-o", "."], "is a folder"),
    ],
)
def test_what_cannot_be_taken_out_is_refused(words: list[object], said: str, tmp_path: Path) -> None:
    done = here("show", *words, cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert said in done.stderr
    assert list(tmp_path.iterdir()) == []
