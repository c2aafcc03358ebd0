"""What is not installed, or too old, is found by name."""

from __future__ import annotations

import platform
import sys
from importlib.metadata import PackageNotFoundError, version

import pytest

from agent.doctor import software
from agent.doctor.findings import Finding, State

REQUIRES = [
    "numpy>=1.26",
    "mcap>=1.6",
    'scipy>=1.13.1; extra == "design"',
    "rich >=13 ; extra == 'design'",
    'ruff>=9; extra == "check"',
]


def found(monkeypatch: pytest.MonkeyPatch, **versions: str) -> list[Finding]:
    """Where these are installed, and nothing else."""

    def of(name: str) -> str:
        if name not in versions:
            raise PackageNotFoundError(name)
        return versions[name]

    monkeypatch.setattr(software, "requires", lambda name: REQUIRES)
    monkeypatch.setattr(software, "version", of)
    return list(software.packages())


NEW = {"numpy": "2.0", "mcap": "1.10.0", "scipy": "1.13.1", "rich": "13.0.0rc1"}


@pytest.mark.parametrize(
    ("versions", "states", "said"),
    [
        (NEW, ["good", "good"], "numpy 2.0, mcap 1.10.0"),
        ({**NEW, "mcap": "1.5.9"}, ["wrong", "good"], "mcap 1.5.9 is older than 1.6: pip install --upgrade peakmesh"),
        ({"numpy": "2.0"}, ["wrong", "absent"], "mcap not installed: pip install --upgrade peakmesh"),
        ({**NEW, "scipy": "1.13.0"}, ["good", "warning"], "scipy 1.13.0 is older than 1.13.1"),
        (
            {"numpy": "2.0", "mcap": "1.6", "rich": "14"},
            ["good", "absent"],
            "scipy not installed: pip install --upgrade 'peakmesh[design]'",
        ),
    ],
)
def test_versions(versions: dict[str, str], states: list[str], said: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """What developers need is not asked for; what an extra brings may be absent."""
    findings = found(monkeypatch, **versions)
    assert [finding.what for finding in findings] == ["packages", "peakmesh[design]"]
    assert [finding.state for finding in findings] == states
    assert said in " ".join(finding.said for finding in findings)


def test_what_is_installed_here_is_found() -> None:
    """Every requirement of the package is read."""
    first, *extras = software.packages()
    assert first.state is State.GOOD
    assert f"numpy {version('numpy')}" in first.said
    assert {extra.what for extra in extras} >= {"peakmesh[design]", "peakmesh[dask]"}


def test_python(monkeypatch: pytest.MonkeyPatch) -> None:
    assert software.python().state is State.GOOD
    monkeypatch.setattr(sys, "version_info", (3, 99, 0))
    assert software.python().state is State.WARNING
    monkeypatch.setattr(platform, "system", lambda: "Darwin")
    assert software.python().state is State.WRONG
