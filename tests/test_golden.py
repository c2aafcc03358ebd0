"""The golden recordings come back: the command that made them makes them again, and what they hold has not changed."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from arithmetic import fingerprint
from places import GOLDEN, ROOT
from runs import answer, peakmesh

from designer.compare import compare
from designer.replay import replay

COMMANDS = dict(
    re.findall(
        r"^\| `golden/(\S+\.mcap)` \| `peakmesh (run .*)` \|$", (ROOT / "recordings/README.md").read_text(), re.M
    )
)


def test_every_golden_recording_has_its_command() -> None:
    assert sorted(COMMANDS) == sorted(path.name for path in GOLDEN.glob("*.mcap"))


@pytest.mark.parametrize("name", COMMANDS)
def test_a_golden_recording_comes_back(name: str, tmp_path: Path) -> None:
    """Bit for bit where matrix products add up as they did when it was made, else up to rounding."""
    *words, output = COMMANDS[name].split()
    assert output == f"recordings/golden/{name}"
    path = tmp_path / name
    assert answer(peakmesh(*words, path, "--json", cwd=ROOT))["missing"] == 0
    found = compare(GOLDEN / name, path)
    assert all(a == b for a, b in found.facts.values()), found.text()
    assert (found.messages, *map(sum, map(dict.values, found.only))) == (600, 0, 0)
    assert set(found.draws().values()) == {True}, found.text()
    assert max(gap.absolute for gap in found.gaps.values()) < 1e-13, found.text()  # the numbers are of order 1
    assert all(gap.ulp or not gap.differ for gap in found.gaps.values()), found.text()
    if fingerprint() == (GOLDEN / "arithmetic").read_text().strip():
        assert found.identical, found.text()


@pytest.mark.parametrize("name", COMMANDS)
def test_a_golden_recording_agrees(name: str) -> None:
    verdict = replay(GOLDEN / name)
    assert (verdict.agrees, verdict.finished, verdict.steps) == (True, True, 60)
