"""The problem with what was observed in place of what was assumed, and how it is written down."""

from __future__ import annotations

import json
from typing import Any

from agent.contract.errors import InputError, counted
from agent.contract.problem import Problem
from designer.identify.counts import Counts


def observed(problem: Problem, counts: Counts) -> Problem:
    """Shares for probabilities; what was never tried stays as it was. InputError: no problem has such values."""
    document, names = problem.document(), problem.node_names
    nodes = [dict(node) for node in document["node"]]
    for node, count in zip(nodes, counts.arrivals, strict=True):
        if count.trials:
            if not count.hits:
                what = f'no measurement of node "{node["name"]}" arrived in {counted(count.trials, "step")}'
                raise InputError(f"{what}; a problem needs an arrival probability above 0")
            node["arrival_probability"] = count.share
    rho = {(link.receiver, link.sender): link.delivery_probability for link in problem.links or ()}
    for (i, j), count in counts.deliveries.items():
        link = (names[i], names[j])
        if count.trials and not count.hits:
            what = f'no message of node "{names[j]}" reached node "{names[i]}" in {counted(count.trials, "step")}'
            raise InputError(f"{what}; a problem needs a delivery probability above 0")
        if count.trials and (link in rho or count.hits < count.trials):
            rho[link] = count.share
    rows = [
        (exits / exits.sum()).tolist() if exits.sum() else row.tolist()
        for exits, row in zip(counts.transitions, problem.markov.transition, strict=True)
    ]
    changed = document | {"node": nodes, "markov": document["markov"] | {"transition": rows}}
    if rho:
        changed["link"] = [{"receiver": i, "sender": j, "delivery_probability": share} for (i, j), share in rho.items()]
    return Problem.from_document(changed)


def to_toml(problem: Problem, *, csv: str = "") -> str:
    """The text of a problem.toml; `csv` is the name of the file that has its disturbance, where that is a table."""
    document = problem.document()
    disturbance = document.get("disturbance")
    if disturbance is not None and disturbance["kind"] == "csv":
        document["disturbance"] = {"kind": "csv", "file": csv}
    plain = {key: value for key, value in document.items() if not _is_table(value)}
    lines = _entries(plain)
    for key, value in document.items():
        if isinstance(value, dict):
            lines += ["", f"[{key}]", *_entries(value)]
        elif _is_table(value):
            for entry in value:
                lines += ["", f"[[{key}]]", *_entries(entry)]
    return "\n".join(lines) + "\n"


def _is_table(value: Any) -> bool:
    return isinstance(value, dict) or (isinstance(value, list | tuple) and isinstance(value[0], dict))


def _entries(table: dict[str, Any]) -> list[str]:
    """Text, numbers, true and false, and lists of them are written in TOML as in JSON."""
    return [f"{key} = {json.dumps(value, ensure_ascii=False)}" for key, value in table.items() if value is not None]
