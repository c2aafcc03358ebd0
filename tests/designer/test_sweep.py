"""A design for each of several values."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest

from agent.contract.errors import InputError
from designer.cli import main
from designer.problems import find
from designer.sweep import Range, parse_range, problems, sweep
from designer.synthesis import design

KEY = "node.*.arrival_probability"


def test_a_range_has_both_ends_and_equal_steps() -> None:
    assert parse_range("a.b=0.5:1:3") == Range("a.b", (0.5, 0.75, 1.0))
    assert parse_range("a=1:0:2") == Range("a", (1.0, 0.0))
    assert parse_range("a=1") is parse_range("a=b:c:2") is parse_range("link.A:B.x=1") is None
    for text in ("a=0:1:1", "a=0:inf:3", "a=0:1:10001", "a=nan:1:3"):
        with pytest.raises(InputError, match="KEY=a:b:n is n values from a to b"):
            parse_range(text)


def test_every_point_is_the_design_of_its_problem() -> None:
    """The other settings held."""
    over, revised = problems("two-nodes", [f"{KEY}=0.5:1:2", "plant.A.1.1=0.5"])
    assert [problem.plant.A.tolist() for problem in revised] == [[[0.5]], [[0.5]]]
    points = sweep(over, revised, method="decomposed", processes=1)
    assert [point.value for point in points] == [0.5, 1.0]
    for point in points:
        gains = design(find("two-nodes", [f"{KEY}={point.value}", "plant.A.1.1=0.5"]), method="decomposed")
        assert point.gamma == gains.certificate.gamma
        assert point.floor == gains.certificate.floor


def test_a_value_without_gains_is_a_point_with_its_reason() -> None:
    """One measurement in ten is not enough for an unstable plant, nine in ten are."""
    settings = [f"{KEY}=0.1:0.9:2", "plant.A.1.1=1.2", "unbiased=true", "node.*.loss=seen"]
    few, many = sweep(*problems("two-nodes", settings), method="decomposed", processes=1)
    assert (few.gamma, few.exact) == (None, None)
    assert few.reason
    assert many.gamma is not None


def test_a_search_that_was_cut_short_says_so() -> None:
    """Its numbers hold, and are no point of the curve that more time would give."""
    (cut, _) = sweep(*problems("two-nodes", [f"{KEY}=0.5:1:2"]), method="exact", budget=1e-9, processes=1)
    assert cut.gamma is not None
    assert cut.reason == "the search was out of time; --budget gives it more"


@pytest.mark.parametrize("settings", [[], [f"{KEY}=0.5"], [f"{KEY}=0.5:1:2", "plant.A.1.1=0.1:0.2:2"]])
def test_a_sweep_is_over_one_key(settings: list[str]) -> None:
    with pytest.raises(InputError, match="a sweep needs one --set KEY=a:b:n"):
        problems("two-nodes", settings)


def test_a_value_that_makes_no_problem_is_refused_before_any_design() -> None:
    with pytest.raises(InputError, match=r"two-nodes with --set node.\*.arrival_probability=2.0: "):
        problems("two-nodes", [f"{KEY}=1:2:2"])


def test_the_command_writes_a_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """As CSV to stdout or a file, or as JSON; the same numbers."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("os.sched_getaffinity", lambda _: {0})  # in this process
    words = ["sweep", "two-nodes", "--set", f"{KEY}=0.5:1:2", "--method", "decomposed"]
    assert main([*words, "-o", "curve.csv", "--json", "--figures", "figures", "--format", "svg"]) == 0
    told = json.loads(capsys.readouterr().out)
    points = told["points"]
    assert told["figures"] == ["figures/sweep-one-column.svg", "figures/sweep-two-columns.svg"]
    assert all(Path(figure).read_bytes().startswith(b"<?xml") for figure in told["figures"])
    with Path("curve.csv").open() as file:
        header, *rows = csv.reader(file)
    assert header[:2] == [KEY, "gamma"]
    assert [[float(entry) for entry in row[:2]] for row in rows] == [[p["value"], p["gamma"]] for p in points]
    assert main([*words, "-o", "curve.csv"]) == 2
    assert main([*words, "--figures", "figures", "--format", "svg"]) == 2  # before any design
    assert main([*words, "--format", "svg"]) == 2
    assert "1 of 2 designs" not in capsys.readouterr().err
    assert main(["sweep", "two-nodes", *words[2:], "--set", "node.*.loss=lost"]) == 2
