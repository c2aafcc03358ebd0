"""Built-in problems, each a problem.toml that says where its numbers come from."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Sequence
from importlib.resources import as_file, files
from pathlib import Path

from agent.contract.errors import InputError, listed
from agent.contract.problem import Problem
from designer.problems.settings import Setting, parse, revise

_SUFFIX = ".toml"


def names() -> tuple[str, ...]:
    """The built-in problems, in alphabetical order."""
    found = (entry.name for entry in files(__name__).iterdir())
    return tuple(sorted(name.removesuffix(_SUFFIX) for name in found if name.endswith(_SUFFIX)))


def is_built_in(problem: Problem) -> bool:
    """Whether it is one of these, number by number."""
    return problem.name in names() and _built_in(problem.name).digest() == problem.digest()


def is_another(problem: Problem) -> bool:
    """Whether it bears the name of a built-in problem, and is not that one."""
    return problem.name in names() and not is_built_in(problem)


def _built_in(name: str) -> Problem:
    with as_file(files(__name__) / f"{name}{_SUFFIX}") as path:
        return Problem.load(path)


def text_of(name: str) -> str:
    """The file of a built-in problem, with its comments."""
    return (files(__name__) / f"{name}{_SUFFIX}").read_text(encoding="utf-8")


def template(name: str) -> str:
    """The text of a problem file to begin with, of a problem of this name. InputError for one that none may have."""
    if name in names():
        raise InputError(f"{name} is the name of a built-in problem; peakmesh show {name} --toml prints that")
    text = (files(__name__) / "template.txt").read_text(encoding="utf-8")
    text = text.replace('name = "tank"', f"name = {json.dumps(name)}", 1).replace("NAME", name)
    Problem.from_document(tomllib.loads(text))
    return text


def find(text: str, settings: Sequence[str] = ()) -> Problem:
    """A built-in problem by its name, or the problem file at that path, with other values where `settings` say so.

    Raises InputError where there is neither, or a setting (settings.py) leads nowhere or makes it no problem.
    """
    if text in names():
        with as_file(files(__name__) / f"{text}{_SUFFIX}") as path:
            return _revised(path, text, settings)
    if not Path(text).exists():
        raise InputError(f'"{text}" is neither a problem file nor a built-in problem; built in are {listed(names())}')
    return _revised(Path(text), text, settings)


def _revised(path: Path, label: str, settings: Sequence[str]) -> Problem:
    parsed = [parse(setting) for setting in settings]
    if not parsed:
        return Problem.load(path)
    try:
        return Problem.load(path, lambda document: revise(document, parsed))
    except InputError as error:
        said = str(error).removeprefix(f"{path}: ")
        raise InputError(said if said.startswith("--set ") else f"{label} with {_options(parsed)}: {said}") from None


def _options(settings: Sequence[Setting]) -> str:
    return " ".join(f"--set {setting.text}" for setting in settings)
