"""What the README says is so."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest
from places import ROOT

from agent.contract.errors import InputError
from agent.contract.problem import Problem
from designer.analysis import analyse, load_given
from designer.box.extent import box_in
from designer.cli import main
from designer.problems.notes import notes

README = (ROOT / "README.md").read_text()


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README, flags=re.DOTALL)


def test_its_problem_is_a_problem() -> None:
    """The example of a problem file loads, and the example of a refusal is what it says."""
    text = blocks("toml")[0]
    document = tomllib.loads(text)
    assert Problem.from_document(document).node_names == ("inflow", "level")
    document["node"][0]["C"] = [[1.0]]
    with pytest.raises(InputError) as caught:
        Problem.from_document(document)
    assert f"peakmesh: tank.toml: {caught.value}\n" in README


def test_its_example_of_a_real_network_is_one() -> None:
    """What it adds to the problem is read, and lets the plant be unstable."""
    text, added, _ = map(tomllib.loads, blocks("toml"))
    document = text | {"unbiased": added["unbiased"], "link": added["link"]}
    document["node"][0] |= added["node"][0]
    problem = Problem.from_document(document)
    assert (problem.carries_plant, problem.delivery.tolist()) == (False, [[1.0, 1.0], [0.95, 1.0]])
    document["plant"]["A"][0][0] = 1.02
    Problem.from_document(document)


def test_its_tolerances_are_a_box_of_its_problem() -> None:
    text, _, added = map(tomllib.loads, blocks("toml"))
    document = text | {"uncertainty": added["uncertainty"]}
    document["node"][0] |= added["node"][0]
    box = box_in(Problem.from_document(document))
    assert box is not None
    assert (len(box.intervals), [len(rows) for rows in box.rows]) == (1, [2, 2])
    assert {(entry.matrix, entry.node) for entry in box.entries} == {("A", 0), ("C", 0)}


def test_its_problem_has_a_column_of_w_for_each_noise() -> None:
    """Whoever copies it has independent noises."""
    assert notes(Problem.from_document(tomllib.loads(blocks("toml")[0]))) == []


def test_its_plain_gains_are_analysed_as_it_says(tmp_path: Path) -> None:
    """The example of gains in a plain JSON fits the example of a problem; what analyse says of both is in the text."""
    (gains,) = blocks("json")
    (tmp_path / "mine.json").write_text(gains)
    problem = Problem.from_document(tomllib.loads(blocks("toml")[0]))
    said = analyse(problem, load_given(tmp_path / "mine.json", problem)).text()
    assert said.replace(str(tmp_path / "mine.json"), "mine.json") in README


def test_its_table_has_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    """And no other."""
    with pytest.raises(SystemExit):
        main(["--help"])
    known = set(re.findall(r"^    (\w+)", capsys.readouterr().out, flags=re.MULTILINE))
    rows = README.partition("| command | does | prints |\n|---|---|---|\n")[2].partition("\n\n")[0].splitlines()
    table = {name for row in rows for name in re.findall(r"`(\w+)", row.split(" | ")[0])}
    assert table == known


def test_its_pictures_are_there_and_small() -> None:
    pictures = re.findall(r"!\[[^]]+\]\(([^)]+)\)", README)
    assert len(pictures) >= 2
    assert all((ROOT / picture).stat().st_size < 100_000 for picture in pictures)


def test_its_sensor_is_the_script() -> None:
    """The sensor in the README is docs/sensor.py to the letter."""
    text, *_ = blocks("python")
    assert text == (ROOT / "docs" / "sensor.py").read_text()


def test_it_shows_the_commands_of_a_whole_run() -> None:
    """Held by tests/test_docs.py, every command of every document exists."""
    shown = set(re.findall(r"peakmesh (\w+)", "\n".join(blocks("sh"))))
    assert {"show", "design", "verify", "run", "replay", "coordinator", "node", "plant", "recorder"} <= shown


def test_ci_runs_its_test_command() -> None:
    """`.ci/run` takes the test command from here, `.ci/package` the one that installs; there is one of each."""
    for where, command in ((".ci/run", "bin/pytest"), (".ci/package", "bin/pip install --quiet '")):
        assert len([line for line in README.splitlines() if command in line]) == 1
        assert f"'{command.partition(' --')[0]}" in (ROOT / where).read_text()
