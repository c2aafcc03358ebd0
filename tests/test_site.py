"""The documentation builds into a site, and its tutorials do what they say."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

import pytest
from places import ROOT

DOCS = ROOT / "docs"
TUTORIALS = sorted((DOCS / "tutorials").glob("*.md"))


def built(source: Path, site: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", str(source), str(site)]
    return subprocess.run(command, capture_output=True, text=True, timeout=600)


def test_the_site_builds_without_a_warning(tmp_path: Path) -> None:
    """Every page is in it, and every name of the reference exists."""
    found = built(DOCS, tmp_path / "site")
    assert (found.returncode, found.stderr) == (0, "")
    pages = {path.relative_to(DOCS).with_suffix(".html") for path in DOCS.rglob("*.md")}
    assert {path.relative_to(tmp_path / "site") for path in (tmp_path / "site").rglob("*.html")} >= pages
    reference = (tmp_path / "site" / "reference.html").read_text()
    assert "peak_slack" in reference
    assert "with a proved gamma" in reference


def test_a_page_that_nobody_reaches_is_found(tmp_path: Path) -> None:
    """So that the test above means something."""
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs" / "conf.py").write_text('extensions = ["myst_parser"]\n')
    (tmp_path / "docs" / "index.md").write_text("# Begin\n")
    (tmp_path / "docs" / "lost.md").write_text("# Lost\n")
    assert built(tmp_path / "docs", tmp_path / "site").returncode != 0


@pytest.mark.parametrize("tutorial", TUTORIALS, ids=lambda path: path.stem)
def test_a_tutorial_does_what_it_says(tutorial: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Block by block in one folder: commands succeed, and Python prints what stands below it."""
    monkeypatch.chdir(tmp_path)
    environment = os.environ | {"PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"}
    names: dict[str, Any] = {}
    blocks = re.findall(r"```(python|sh)\n(.*?)```(?:\n\n```text\n(.*?)```)?", tutorial.read_text(), flags=re.DOTALL)
    assert len(blocks) > 2
    for language, text, said in blocks:
        if language == "sh":
            found = subprocess.run(
                ["sh", "-e", "-c", text], env=environment, capture_output=True, text=True, timeout=300
            )
            assert found.returncode == 0, found.stderr
            continue
        with redirect_stdout(StringIO()) as printed:
            exec(compile(text, tutorial.name, "exec"), names)
        assert printed.getvalue() == said
