"""`--set`, `new` and `show --toml`: a problem with other values, one to begin with, and one as its file."""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path

import pytest
from places import ROOT

from agent.contract.errors import InputError
from agent.contract.gains import Gains
from agent.contract.problem import Problem
from designer.cli import main
from designer.problems import find, names, template, text_of
from designer.problems.notes import notes


def test_a_value_goes_where_its_path_says() -> None:
    """To one node, to all, to an entry of a matrix, to a key that was not there; the last of two holds."""
    changed = find("zhu2020-lossy", ["node.*.arrival_probability=0.7", "node.3.arrival_probability=0.5"])
    assert changed.beta.tolist() == [0.7, 0.7, 0.5, 0.7]
    changed = find("zhu2020-lossy", ["plant.A.1.2=0.25", "node.2.loss=seen", "disturbance.amplitude=2"])
    assert changed.plant.A.tolist() == [[-0.6, 0.25], [0.0, -0.8]]
    assert [node.loss for node in changed.nodes] == [None, "seen", None, None]
    assert changed.disturbance.document()["amplitude"] == 2.0
    changed = find("two-nodes", ["name=mine", "node.*.C.1.*=0.5", 'disturbance={kind = "white", deviation = 0.1}'])
    assert (changed.name, [node.C.tolist() for node in changed.nodes]) == ("mine", [[[0.5]], [[0.5]]])
    links = find("inverted-pendulum").links
    assert links
    key = f"link.{links[0].receiver}:{links[0].sender}.delivery_probability"
    changed = find("inverted-pendulum", [f"{key}=0.5"])
    assert changed.links
    assert [link.delivery_probability for link in changed.links] == [
        0.5, *(link.delivery_probability for link in links[1:])
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ("node", "--set node: write KEY=VALUE, such as node.*.arrival_probability=0.7"),
        ("node..C=1", "--set node..C=1: write KEY=VALUE, "),
        ("nodes.1.C=1", '--set nodes.1.C=1: the problem has no "nodes"; did you mean "node"?'),
        ("node.5.D=1", '--set node.5.D=1: node has no "5"; it has "1", "2", "3" and "4", and * means all'),
        ("plant.A.1.3=2", '--set plant.A.1.3=2: plant.A.1 has 2 entries, and no "3"; they are counted from 1'),
        ("plant.A.0.1=2", '--set plant.A.0.1=2: plant.A has 2 entries, and no "0"; they are counted from 1'),
        ("name.x=2", "--set name.x=2: name is a single value, and has nothing inside"),
        ("link.*.delivery_probability=1", '--set link.*.delivery_probability=1: the problem has no "link"; it has "na'),
        ("node.2.arrival_probability=2", 'zhu2020-lossy with --set node.2.arrival_probability=2: node "2": arriv'),
        ("node.2.arrival_probability=0.5\nC=1", "zhu2020-lossy with --set node.2.arrival_probability=0.5\nC=1: node"),
        ("plant.A.1.1=much", "zhu2020-lossy with --set plant.A.1.1=much: plant: A: row 1 holds 'much', which is not a"),
        ("plant.A.1.1=0.5:1:3", "zhu2020-lossy with --set plant.A.1.1=0.5:1:3: plant: A: row 1 holds '0.5:1:3', whi"),
    ],
)
def test_a_wrong_path_or_value_is_a_sentence(setting: str, said: str) -> None:
    """With what would be right."""
    with pytest.raises(InputError) as caught:
        find("zhu2020-lossy", [setting])
    assert str(caught.value).startswith(said)


def test_commands_take_it_where_there_is_a_problem(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """And refuse it where there are gains already."""
    monkeypatch.chdir(tmp_path)
    half = ("--set", "node.*.arrival_probability=0.5")
    assert main(["design", "two-nodes", *half, "-o", "half.json", "--method", "decomposed"]) == 0
    assert Gains.load(Path("half.json")).problem.beta.tolist() == [0.5, 0.5]
    assert main(["verify", "half.json", "two-nodes", *half]) == 0
    assert main(["verify", "half.json", "two-nodes"]) == 1
    capsys.readouterr()
    assert main(["analyse", "two-nodes", *half, "--gains", "half.json", "--json"]) == 0
    analysed = json.loads(capsys.readouterr().out)["ladder"]["gamma"]
    assert analysed == pytest.approx(Gains.load(Path("half.json")).certificate.gamma, rel=1e-6)
    assert main(["show", "two-nodes", *half, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["arrival_probability"] == [0.5, 0.5]
    for words in (["verify", "half.json"], ["show", "half.json"], ["show"], ["run", "half.json"]):
        assert main([*words, *half]) == 2
        assert capsys.readouterr().err.startswith("peakmesh: --set node.*.arrival_probability=0.5 ")


def test_new_writes_the_problem_of_the_readme_with_comments(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Under its own name, with a column of w for each noise; nothing is replaced."""
    monkeypatch.chdir(tmp_path)
    shown = tomllib.loads(re.findall(r"```toml\n(.*?)```", (ROOT / "README.md").read_text(), flags=re.DOTALL)[0])
    assert main(["new", "mine"]) == 0
    made = Problem.load(Path("mine.toml"))
    assert made == Problem.from_document(shown | {"name": "mine"})
    assert notes(made) == []
    assert main(["new", "mine"]) == 2
    for name in ("no name", "two-nodes"):
        with pytest.raises(InputError):
            template(name)


def test_what_the_template_leaves_out_is_as_it_says() -> None:
    """Without the # in front, every optional key that it names is one."""
    text = re.sub(r"^# (?=\S+ = |\[\[link)", "", template("mine"), flags=re.MULTILINE)
    problem = Problem.from_document(tomllib.loads(text))
    assert problem.unbiased
    assert problem.nodes[0].seen
    assert problem.links


@pytest.mark.parametrize("name", names())
def test_show_prints_a_built_in_problem_as_its_file(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    """To the letter; and with a value set, the same problem but for that."""
    assert main(["show", name, "--toml"]) == 0
    assert capsys.readouterr().out == text_of(name)
    assert main(["show", name, "--toml", "--set", "name=other"]) == 0
    printed = capsys.readouterr().out
    assert Problem.from_document(tomllib.loads(printed)) == find(name, ["name=other"])


def test_show_refuses_what_is_no_problem(capsys: pytest.CaptureFixture[str]) -> None:
    golden = ROOT / "recordings" / "golden"
    assert main(["show", str(golden / "zhu2020-lossy.gains.json"), "--toml"]) == 0
    assert Problem.from_document(tomllib.loads(capsys.readouterr().out)) == find("zhu2020-lossy")
    for words in ([str(golden / "zhu2020-lossy.mcap")], ["nothing.toml"], [], ["two-nodes", "--json"]):
        assert main(["show", "--toml", *words]) == 2
