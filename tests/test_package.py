"""What pyproject.toml says of the package is so. `.ci/package` builds, installs and runs it."""

from __future__ import annotations

import ast
import re
import sys
import tomllib
from collections.abc import Iterable
from importlib.metadata import packages_distributions

from places import ROOT

from agent.contract.extras import EXTRAS

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
VERSIONS = re.findall(r"Python :: (3\.\d+)", "\n".join(PROJECT["project"]["classifiers"]))
OURS = {"agent", "designer"}  # in which the library stands, too
NOT_REQUIRED = {"pytest"}  # who has it loads the plugin
USED = sorted(set(EXTRAS.values()))  # by the package itself; the others are for those who work on it
OPTIONAL = {"scs"}  # asked where it is installed; cvxpy brings it


def outside(source: str) -> set[str]:
    """What a module imports, wherever it does, that is neither Python's nor ours: top-level names."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module.split(".")[0])
    return names - sys.stdlib_module_names - OURS - {"peakmesh"}


def undeclared(imports: Iterable[str]) -> set[str]:
    """What no requirement brings."""
    extras = PROJECT["project"]["optional-dependencies"]
    requirements = [*PROJECT["project"]["dependencies"], *(line for extra in USED for line in extras[extra])]
    declared = {re.split("[<>=]", requirement)[0] for requirement in requirements}
    provided = packages_distributions()
    return {name for name in imports if not declared & {found.lower() for found in provided.get(name, [])}} - OPTIONAL


def test_every_import_is_required() -> None:
    """Also one that waits in a function until somebody asks for it."""
    imports = {
        name for package in OURS for path in (ROOT / package).rglob("*.py") for name in outside(path.read_text())
    }
    assert {"numpy", "rich", "distributed"} <= imports
    assert undeclared(imports) == NOT_REQUIRED
    assert undeclared(outside("import numpy\ndef f():\n    from hypothesis.extra import numpy\n")) == {"hypothesis"}


def test_the_pythons_are_the_same_everywhere() -> None:
    """The lowest is what is required and what lint and types hold to; the documents name those of the classifiers."""
    lowest = VERSIONS[0]
    assert PROJECT["project"]["requires-python"] == f">={lowest}"
    assert PROJECT["tool"]["mypy"]["python_version"] == lowest
    assert PROJECT["tool"]["ruff"]["target-version"] == f"py{lowest.replace('.', '')}"
    said = f"Python {', '.join(VERSIONS[:-1])} or {VERSIONS[-1]}"
    assert said in (ROOT / "README.md").read_text()
    assert said in (ROOT / "CONTRIBUTING.md").read_text()
