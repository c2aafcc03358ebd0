"""How a problem is written down."""

from __future__ import annotations

import json
from typing import Any

from agent.contract.problem import Problem


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
    return [f"{key} = {_value(value)}" for key, value in table.items() if value is not None]


def _value(value: Any) -> str:
    """Text, numbers, true and false, and lists of them are written in TOML as in JSON; a table within a line is not."""
    if isinstance(value, dict):
        return f"{{ {', '.join(_entries(value))} }}"
    return json.dumps(value, ensure_ascii=False)
