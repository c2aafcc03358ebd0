"""`--set KEY=VALUE`: a problem file read with other values in it, without another file.

A key is a path through the file with dots between: `plant.A.1.2` is the first row's second entry, `node.left.loss` what
node "left" has of that name, `node.*.arrival_probability` that of every node, `link.A:B.delivery_probability` that of
the link on which A hears B. A value is what TOML has after the equals sign; what is none, such as seen, is text.
"""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from difflib import get_close_matches
from typing import Any, NamedTuple

from agent.contract.errors import InputError, counted, listed

EVERY = "*"


class Setting(NamedTuple):
    """One value, and where it goes."""

    text: str  # as it was given
    path: tuple[str, ...]
    value: Any


def parse(text: str) -> Setting:
    """What `--set` takes. Raises InputError where it is not KEY=VALUE."""
    key, equals, value = text.partition("=")
    path = tuple(step.strip() for step in key.split("."))
    if not (equals and value.strip() and all(path)):
        raise InputError(f"--set {text}: write KEY=VALUE, such as node.*.arrival_probability=0.7")
    return Setting(text, path, _value(value.strip()))


def _value(text: str) -> Any:
    try:
        document = tomllib.loads(f"value = {text}")
    except ValueError:
        return text
    return document["value"] if len(document) == 1 else text


def revise(document: dict[str, Any], settings: Sequence[Setting]) -> None:
    """Put the values into the document of a problem file, in their order. Raises InputError for a path to nowhere."""
    for setting in settings:
        for holder, key in _places(document, setting):
            holder[key] = setting.value


def _places(document: dict[str, Any], setting: Setting) -> list[tuple[Any, Any]]:
    """The tables or rows, each with its key, that the path of a setting leads to."""
    holders: list[Any] = [document]
    for number, step in enumerate(setting.path, 1):
        is_last, places = number == len(setting.path), []
        for holder in holders:
            keys = _keys(holder, step, is_last)
            if not keys:
                where = ".".join(setting.path[: number - 1])
                raise InputError(f"--set {setting.text}: {_nowhere(holder, step, where)}")
            places += [(holder, key) for key in keys]
        holders = [] if is_last else [holder[key] for holder, key in places]
    return places


def _keys(at: Any, step: str, is_last: bool) -> list[Any]:
    """The keys of a table, or the indices of a list, that a step means; none where it means nothing there."""
    if isinstance(at, dict):
        if step == EVERY:
            return list(at)
        return [step] if step in at or is_last else []  # a key that is optional may not be there yet
    if not isinstance(at, list):
        return []
    return [k for k, name in enumerate(_names(at)) if step in (name, EVERY)]


def _names(entries: list[Any]) -> list[str]:
    """What each entry of a list is called: tables by name, links by receiver and sender, the rest by number from 1."""
    return [
        str(number)
        if not isinstance(entry, dict)
        else f"{entry.get('receiver')}:{entry.get('sender')}"
        if "receiver" in entry
        else str(entry.get("name"))
        for number, entry in enumerate(entries, 1)
    ]


def _nowhere(at: Any, step: str, where: str) -> str:
    place = where or "the problem"
    if isinstance(at, dict):
        near = get_close_matches(step, list(at), n=1)
        hint = f'; did you mean "{near[0]}"?' if near else f"; it has {listed(at)}"
        return f'{place} has no "{step}"{hint}'
    if not isinstance(at, list):
        return f"{place} is a single value, and has nothing inside"
    if at and not isinstance(at[0], dict):
        return f'{place} has {counted(len(at), "entry")}, and no "{step}"; they are counted from 1'
    return f'{place} has no "{step}"; it has {listed(_names(at))}, and {EVERY} means all'
