"""What the documents name is there, and what the code says of the documents."""

from __future__ import annotations

import importlib
import os
import re
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from types import ModuleType

import pytest
from places import ROOT

import agent
import designer
from designer.cli import main

DOCUMENTS = {path.name: path.read_text() for path in [*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")]}
DOCUMENTS["recordings/README.md"] = (ROOT / "recordings" / "README.md").read_text()
FILES = {
    path.relative_to(ROOT).as_posix(): path.read_text()
    for folder in ("agent", "designer", "benchmarks", "docs", "examples", "tests", "tools")
    for path in (ROOT / folder).rglob("*.py")
}


def exists(name: str) -> bool:
    """Whether a dotted name is a module, or what is in one."""
    parts = name.split(".")
    for split in range(len(parts), 0, -1):
        try:
            found: object = importlib.import_module(".".join(parts[:split]))
        except ModuleNotFoundError:
            continue
        for attribute in parts[split:]:
            if not hasattr(found, attribute):
                return attribute in getattr(found, "model_fields", {}) or attribute in getattr(
                    found, "__annotations__", {}
                )
            found = getattr(found, attribute)
        return True
    return False


def test_what_does_not_exist_is_found() -> None:
    """So that the tests below mean something."""
    assert exists("designer.lmi.theorem2.solve")
    assert not exists("designer.lmi.theorem2.no_such_name")
    assert not exists("designer.no_such_module")


@pytest.mark.parametrize("document", DOCUMENTS)
def test_names_of_the_code_exist(document: str) -> None:
    """`designer.module.name`, `agent.module`, and `file.py`."""
    named = re.findall(r"`((?:designer|agent)(?:\.\w+)+)`", DOCUMENTS[document])
    assert [name for name in named if not exists(name)] == []
    files = re.findall(r"`(?:python )?([\w/]+\.py)\b", DOCUMENTS[document])
    assert [name for name in files if not any(f"/{path}".endswith(f"/{name}") for path in FILES)] == []


def unknown(command: str, rest: str) -> list[str]:
    """The command, or those of its options, that the program does not know."""
    with redirect_stdout(StringIO()) as said, redirect_stderr(StringIO()), pytest.raises(SystemExit) as caught:
        main([command, *(rest.split()[:1] if command == "keys" else []), "--help"])
    known = re.findall(r"--[\w-]+", said.getvalue())
    return (
        [option for option in re.findall(r"--[\w-]+", rest) if option not in known]
        if not caught.value.code
        else [command]
    )


@pytest.mark.parametrize("document", DOCUMENTS)
def test_pictures_exist(document: str) -> None:
    """`docs/name.svg`, shown or named."""
    named = re.findall(r"\bdocs/\w+\.svg\b", DOCUMENTS[document])
    assert [name for name in named if not (ROOT / name).exists()] == []


@pytest.mark.parametrize("document", ["README.md", "CONTRIBUTING.md", "recordings/README.md", "security.md"])
def test_commands_exist(document: str) -> None:
    """Every `peakmesh COMMAND --option` and every `.ci/script`."""
    found = re.findall(r"(?:`|^ *(?:\S*/)?)peakmesh (\w+)([^`\n#]*)", DOCUMENTS[document], flags=re.MULTILINE)
    assert len(found) > 1
    assert [part for command, rest in found for part in unknown(command, rest)] == []
    assert unknown("design", "--force --without-nodes 1") == ["--without-nodes"]
    assert unknown("desing", "") == ["desing"]
    assert unknown("keys", "renew FOLDER --problem P") == ["--problem"]
    assert [
        script for script in re.findall(r"\.ci/\w+", DOCUMENTS[document]) if not os.access(ROOT / script, os.X_OK)
    ] == []


def sections(document: str) -> set[str]:
    """The numbers of its headings."""
    return set(re.findall(r"^## (\d+)\. ", DOCUMENTS[document], flags=re.MULTILINE))


def test_sections_that_are_referred_to_exist() -> None:
    """From the code, from other documents and from theory.md itself."""
    numbers = sections("theory.md")
    assert numbers == {str(number) for number in range(1, len(numbers) + 1)}
    text = " ".join("\n".join(FILES.values()).split() + "\n".join(DOCUMENTS.values()).split())
    elsewhere = re.findall(r"theory\.md\)?,? sections? ([\d to]*\d)", text)
    within = re.findall(r"[Ss]ection (\d+)", DOCUMENTS["theory.md"])
    assert len(elsewhere) > 5
    assert {number for found in [*elsewhere, *within] for number in found.split(" to ")} <= numbers


@pytest.mark.parametrize("package", [agent, designer], ids=lambda package: package.__name__)
def test_the_map_of_a_package_has_every_module(package: ModuleType) -> None:
    """And no other."""
    files = Path(package.__path__[0]).iterdir()
    modules = {path.stem for path in files if path.suffix == ".py" or (path / "__init__.py").exists()}
    text = (package.__doc__ or "").partition("\n\n")[2]
    named = {word for line in text.splitlines() for word in re.findall(r"\w+", line[16:])}
    assert modules - {"__init__", "__main__"} <= named
    known = re.findall(r"(?:^|; |, )(?:and )?(\w+):", "\n".join(line[16:] for line in text.splitlines()), re.MULTILINE)
    assert set(known) <= modules
