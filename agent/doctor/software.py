"""What is installed: Python, the packages that every run needs, and those that some commands need."""

from __future__ import annotations

import platform
import re
import sys
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, requires, version

from agent.doctor.findings import Finding, State

TESTED = ((3, 11), (3, 12), (3, 13))
_REQUIREMENT = re.compile(r"([\w.-]+) *>=([\d.]+) *(?:; *extra == [\"'](\w+)[\"'])?")
_OF_DEVELOPERS = ("test", "check")  # extras that no command needs


def python() -> Finding:
    """Its version, and what it runs on."""
    found = f"{platform.python_version()} on {platform.system()} {platform.machine()}"
    if platform.system() != "Linux":
        return Finding("python", State.WRONG, f"{found}; peakmesh runs on Linux")
    if sys.version_info[:2] not in TESTED:
        names = ", ".join(".".join(map(str, each)) for each in TESTED)
        return Finding("python", State.WARNING, f"{found}; peakmesh is tested with {names}")
    return Finding("python", State.GOOD, found)


def packages() -> Iterator[Finding]:
    """What a run needs, then every extra: whether its packages are there, and new enough."""
    by_extra: dict[str, list[tuple[str, str]]] = {"": []}
    for line in requires("peakmesh") or ():
        found = _REQUIREMENT.fullmatch(line)
        if found is not None:
            by_extra.setdefault(found[3] or "", []).append((found[1], found[2]))
    for extra, wanted in by_extra.items():
        if extra not in _OF_DEVELOPERS:
            yield _packages(extra, wanted)


def _packages(extra: str, wanted: list[tuple[str, str]]) -> Finding:
    name = f"peakmesh[{extra}]" if extra else "packages"
    there, lacking, old = [], [], []
    for package, least in wanted:
        try:
            found = version(package)
        except PackageNotFoundError:
            lacking.append(package)
            continue
        there.append(f"{package} {found}")
        if _numbers(found) < _numbers(least):
            old.append(f"{package} {found} is older than {least}")
    remedy = f"pip install --upgrade 'peakmesh[{extra}]'" if extra else "pip install --upgrade peakmesh"
    if lacking or old:
        missing = [f"{', '.join(lacking)} not installed"] if lacking else []
        state = State.ABSENT if extra and not old else State.WARNING if extra else State.WRONG
        return Finding(name, state, f"{'; '.join([*missing, *old])}: {remedy}")
    return Finding(name, State.GOOD, ", ".join(there))


def _numbers(version: str) -> list[int]:
    """Of 2.11.7: [2, 11, 7]."""
    return [int(number) for number in re.findall(r"\d+", version.partition("+")[0])]
