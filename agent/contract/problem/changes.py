"""A problem as Python says it: from arrays, and as a copy of another with some values changed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from agent.contract.errors import InputError, listed
from agent.contract.frozen import plain

EVERY = "*"  # a name that stands for all of them
_REPLACED = {"disturbance"}  # not merged: what one kind says means nothing to another
_INSTEAD = {"hears": "adjacency", "adjacency": "hears"}  # who says one does not say the other
_NAMED = {"node", "topology"}  # lists of tables, told apart by their names


def from_arrays(
    name: str,
    *,
    A: Any,
    B: Any,
    M: Any,
    C: Mapping[str, Any],
    D: Mapping[str, Any],
    arrival_probability: float | Mapping[str, float],
    adjacency: Mapping[str, Any],
    transition: Any,
    initial: str | None,
    others: Mapping[str, Any],
) -> dict[str, Any]:
    """The document of a problem; nodes and modes are named by the keys of `C` and `adjacency`."""
    if C.keys() != D.keys():
        raise InputError(f"C has the nodes {listed(C)}, D has {listed(D)}; both need the same ones")
    arrives = arrival_probability
    if not isinstance(arrives, Mapping):
        arrives = dict.fromkeys(C, arrives)
    if arrives.keys() != C.keys():
        raise InputError(f"arrival_probability has the nodes {listed(arrives)}; C has {listed(C)}")
    if not adjacency:
        raise InputError("adjacency is empty; it needs a matrix for each mode")
    nodes = [{"name": node, "C": C[node], "D": D[node], "arrival_probability": arrives[node]} for node in C]
    document = {
        "name": name,
        "plant": {"A": A, "B": B, "M": M},
        "node": nodes,
        "topology": [{"name": mode, "adjacency": matrix} for mode, matrix in adjacency.items()],
        "markov": {"transition": transition, "initial": next(iter(adjacency)) if initial is None else initial},
    }
    return dict(plain(document | dict(others)))


def changed(document: dict[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """The document with some values changed: tables key by key, nodes and topologies by their names, "*" for all."""
    found = dict(document)
    for key, value in changes.items():
        if key in _NAMED and isinstance(value, Mapping):
            found[key] = _each(key, document[key], value)
        elif isinstance(value, Mapping) and isinstance(document.get(key), dict) and key not in _REPLACED:
            found[key] = document[key] | plain(dict(value))
        else:
            found[key] = plain(dict(value) if isinstance(value, Mapping) else value)
    return found


def _each(kind: str, tables: list[dict[str, Any]], changes: Mapping[str, Mapping[str, Any]]) -> list[dict[str, Any]]:
    names = [table["name"] for table in tables]
    for name in changes:
        if name != EVERY and name not in names:
            raise InputError(f'{kind} "{name}" does not exist; there are {listed(names)}, and "{EVERY}" for all')
    return [_table(table, changes.get(EVERY, {}), changes.get(table["name"], {})) for table in tables]


def _table(table: dict[str, Any], *changes: Mapping[str, Any]) -> dict[str, Any]:
    for change in changes:
        kept = {key: value for key, value in table.items() if _INSTEAD.get(key) not in change}
        table = kept | plain(dict(change))
    return table
