"""Built-in problems, each a problem.toml that says where its numbers come from."""

from __future__ import annotations

from importlib.resources import as_file, files
from pathlib import Path

from agent.contract.errors import InputError, listed
from agent.contract.problem import Problem

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


def find(text: str) -> Problem:
    """A built-in problem by its name, or the problem file at that path. Raises InputError where there is neither."""
    if text in names():
        return _built_in(text)
    if not Path(text).exists():
        raise InputError(f'"{text}" is neither a problem file nor a built-in problem; built in are {listed(names())}')
    return Problem.load(Path(text))
