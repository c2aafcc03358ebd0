"""How a problem is written down: problem.toml, the CSV file of its disturbance, `hears` in place of `adjacency`."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import numpy as np

from agent.contract.errors import InputError, listed, shortened
from agent.contract.files import kind_of, read_bytes
from agent.contract.problem.consistency import refuse_duplicates
from agent.contract.problem.parts import is_legal


def read_toml(path: Path) -> dict[str, Any]:
    """What problem.toml says, as plain dicts and lists. Raises InputError where it is no TOML."""
    data = read_bytes(path, kind="problem file")
    try:
        return tomllib.loads(data.decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:
        kind = kind_of(data)
        why = f"it is {kind}" if kind in ("a recording", "a gains file") else f"it is not valid TOML: {error}"
        raise InputError(f"{path} is not a problem file: {why}") from None


def read_csv(document: dict[str, Any], *, folder: Path) -> None:
    """Put the numbers of `disturbance.file` into the document, so that a problem is whole without the file."""
    disturbance = document.get("disturbance")
    if not (isinstance(disturbance, dict) and disturbance.get("kind") == "csv" and "file" in disturbance):
        return
    path = folder / str(disturbance["file"])
    text = read_bytes(path, kind="CSV file of the disturbance").decode("utf-8-sig", errors="replace")
    rows: list[list[float]] = []
    for number, line in enumerate(text.splitlines(), 1):
        try:
            rows.append([float(entry) for entry in line.split(",")])
        except ValueError:
            raise InputError(f"disturbance: {path}, row {number} is not all numbers: {shortened(line)}") from None
    if not rows:
        raise InputError(f"disturbance: {path} is empty; it needs a row of numbers for each step")
    disturbance["values"] = rows


def adjacency_from_hears(document: Any) -> Any:
    """The document with `adjacency` in every topology. Raises ValueError where `hears` cannot be understood."""
    if not isinstance(document, dict) or not isinstance(document.get("topology"), list):
        return document
    nodes = document.get("node")
    nodes = [node.get("name") for node in nodes if isinstance(node, dict)] if isinstance(nodes, list | tuple) else []
    if not nodes or not all(map(is_legal, nodes)):
        return {**document, "topology": []}  # that is the fault to report, not the names that nobody has
    refuse_duplicates("node", tuple(nodes))  # before names are looked up among them
    topologies = [_with_adjacency(topology, nodes) for topology in document["topology"]]
    return {**document, "topology": topologies}


def _with_adjacency(topology: Any, nodes: list[Any]) -> Any:
    """A topology that says `hears = { "1" = ["4"] }`, as one that says `adjacency`."""
    if not isinstance(topology, dict) or "hears" not in topology:
        return topology
    where = f'topology "{topology.get("name", "?")}": hears'
    if "adjacency" in topology:
        raise ValueError(f"{where} and adjacency are both given; keep one of them")
    hears = topology["hears"]
    if not (isinstance(hears, dict) and all(isinstance(heard, list) for heard in hears.values())):
        raise ValueError(f'{where} must map a node to a list of nodes, such as {{ "1" = ["4"] }}')
    adjacency = np.eye(len(nodes))
    for receiver, heard in hears.items():
        for sender in (receiver, *heard):
            if sender not in nodes:
                name = f'"{sender}"' if isinstance(sender, str) else shortened(sender)
                raise ValueError(f"{where}: node {name} does not exist; the nodes are {listed(nodes)}")
            adjacency[nodes.index(receiver), nodes.index(sender)] = 1.0
    return {key: value for key, value in topology.items() if key != "hears"} | {"adjacency": adjacency.tolist()}


def refuse_unbiased_in_tables(document: Any) -> None:
    """TOML puts a key that stands below a table into that table: easily done, and hard to see."""
    for name, table in document.items() if isinstance(document, dict) else ():
        entries = table if isinstance(table, list) else [table]
        if any(isinstance(entry, dict) and "unbiased" in entry for entry in entries):
            raise ValueError(f"unbiased stands in the table {name}; it belongs at the top, before every table")
