"""What is to be cited, in the two places that say so."""

from __future__ import annotations

import re
import tomllib

import pytest
from places import ROOT

from designer.cli import main

FILE = (ROOT / "CITATION.cff").read_text()
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def test_the_file_is_of_this_version() -> None:
    facts = dict(re.findall(r"^([a-z-]+): (.+)$", FILE, flags=re.MULTILINE))
    assert facts["cff-version"] == "1.2.0"
    assert (facts["title"], facts["version"], facts["license"]) == tuple(
        PROJECT[key] for key in ("name", "version", "license")
    )


def test_show_cites_the_same(capsys: pytest.CaptureFixture[str]) -> None:
    """The paper by the same DOI and pages; two entries of BibTeX, each with its braces closed."""
    assert main(["show", "--cite"]) == 0
    printed = capsys.readouterr().out
    assert len(re.findall(r"^@\w+\{\w+,$", printed, flags=re.MULTILINE)) == 2
    assert printed.count("{") == printed.count("}")
    assert f"version = {{{PROJECT['version']}}}" in printed
    (doi,) = re.findall(r"doi: (\S+)", FILE)
    assert f"doi = {{{doi}}}" in printed
    pages = re.findall(r"(?:start|end): (\d+)", FILE)
    assert f"pages = {{{'--'.join(pages)}}}" in printed
    for author in re.findall(r"family-names: (\w+)", FILE):
        assert f"{author}, " in printed
