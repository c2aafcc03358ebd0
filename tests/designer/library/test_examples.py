"""The scripts of examples/ and the examples of docs/library.md run, and print what they say."""

from __future__ import annotations

import re
import runpy
import sys
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

import pytest
from places import GOLDEN, ROOT

EXAMPLES = ROOT / "examples"
PAGE = (ROOT / "docs" / "library.md").read_text()


def blocks(text: str) -> list[tuple[str, str]]:
    """Each piece of Python, with what it is to print."""
    return re.findall(r"```python\n(.*?)```(?:\n\n```text\n(.*?)```)?", text, flags=re.DOTALL)


def test_the_page_prints_what_it_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    found = blocks(PAGE)
    assert len(found) == 5
    for code, said in found:
        with redirect_stdout(StringIO()) as printed:
            exec(compile(code, "docs/library.md", "exec"), names)
        assert printed.getvalue() == said
    assert {"outputs", "errors", "topologies", "ladder"} <= set(names["figures"])
    assert {figure.get_figwidth() for figure in names["figures"].values()} == {3.5}
    assert {"gains.json", "run.mcap", "errors.pdf"} <= {path.name for path in tmp_path.iterdir()}


def test_the_readme_shows_lines_of_the_page() -> None:
    """So that they are run above."""
    section = (ROOT / "README.md").read_text().partition("\n## As a library\n")[2].partition("\n## ")[0]
    ((code, _),) = blocks(section)
    assert set(code.splitlines()) <= set(PAGE.splitlines())


def run(name: str, *arguments: object) -> tuple[list[str], int]:
    """What a script prints, and its exit code."""
    before, sys.argv = sys.argv, [name, *map(str, arguments)]
    code = 0
    try:
        with redirect_stdout(StringIO()) as printed:
            runpy.run_path(str(EXAMPLES / name), run_name="__main__")
    except SystemExit as end:
        code = int(end.code or 0)
    finally:
        sys.argv = before
    return printed.getvalue().splitlines(), code


def test_every_example_is_in_the_table() -> None:
    assert set(re.findall(r"`python (\w+\.py)", (EXAMPLES / "README.md").read_text())) == {
        path.name for path in EXAMPLES.glob("*.py")
    } == {"sweep.py", "live.py", "audit.py", "sensor.py", "plain_node.py", "paced_node.py"}  # fmt: skip


def test_sweep(tmp_path: Path) -> None:
    """Designed gains are never worse than those that were not."""
    rows, code = run("sweep.py", tmp_path / "sweep.png")
    numbers = [tuple(map(float, re.findall(r"\d\.\d+", row))) for row in rows]
    assert [row[0] for row in numbers] == [0.6, 0.8, 1.0]
    assert all(designed < mine for _, mine, designed in numbers)
    assert (tmp_path / "sweep.png").read_bytes().startswith(b"\x89PNG")
    assert code == 0


def test_live(tmp_path: Path) -> None:
    said, _ = run("live.py", tmp_path)
    assert f"{tmp_path / 'live.mcap'}: agrees" in said
    assert {path.name for path in tmp_path.iterdir()} == {"live.mcap", "outputs.pdf", "errors.pdf"}


def test_sensor() -> None:
    said, _ = run("sensor.py")
    assert 'sensors of their own: "left"; estimates are compared instead of errors' in said
    assert said[-1].startswith("y of left: [0.  ")


def test_audit(tmp_path: Path) -> None:
    """Of good recordings, then of a file that is none, too."""
    said, code = run("audit.py", GOLDEN)
    assert [line.split("; ")[0] for line in said] == ["zhu2020-ideal.mcap: agrees", "zhu2020-lossy.mcap: agrees"]
    assert code == 0
    (tmp_path / "none.mcap").write_text("none")
    said, code = run("audit.py", tmp_path)
    assert said[0].startswith(f"{tmp_path / 'none.mcap'} ")
    assert code == 2
