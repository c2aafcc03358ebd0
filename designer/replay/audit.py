"""A replay's verdict as a layer of the log: what it found at every step, in topics of its own, at the recorded times.

Opened above the recording in a viewer, or merged with it, it shows gaps and margins below the signals that they belong
to. Losses, substitutions, missing messages and divergences are events and lines of a log, in the schemas that Foxglove
knows, `foxglove.Event` and `foxglove.Log`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from agent.contract.arrays import Array
from agent.contract.keys import estimate
from agent.contract.layout import column, foxglove_layout, layout, plot
from agent.contract.problem import Problem
from agent.contract.recording.layer import LayerWriter, writing_layer
from designer.replay import tolerance
from designer.replay.happenings import Happening, happenings
from designer.replay.log import Log
from designer.replay.proofs import Check
from designer.replay.times import Times
from designer.replay.trace import Trace
from designer.replay.verdict import Divergence, Verdict

STEP, EVENTS, LINES = "audit/step", "audit/event", "audit/log"
MOST_DIVERGENCES = 10_000  # that are written one by one; the others are counted

OF_STEP = {
    "error": "|z~(k)|, over all nodes, in the units of z",
    "gamma_path": "the gain from the recorded w to z~(k), with the recorded modes, losses and deliveries",
    "path_bound": "gamma_path(k) sqrt(energy), and what the initial error leaves of this run's error: proof 5 says "
    "that the error stays below it; in the units of z",
    "margin": "1 - error / path_bound: what is left of the bound",
    "mean_bound": "gamma sqrt(energy), and what an initial error leaves: bounds the root mean square over many runs, "
    "not this one; in the units of z",
    "energy": "sum over j < k of |w(j)|^2, in the units of w squared",
    "gap_1": "largest relative gap of proof 1, inputs and what nodes say",
    "gap_2": "largest relative gap of proof 2, one step of the model",
    "gap_3": "largest relative gap of proof 3, the model running freely",
    "tolerance": "what a gap may be by rounding",
}
OF_NODE = {
    "error": "|z(k) - z_hat_i(k)|, in the units of z",
    "gap": "largest relative gap of all proofs in what concerns this node",
}
_INFO, _ERROR = 2, 4  # levels of foxglove.Log
_TIME = {"type": "object", "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}}}
_PAIR = {"type": "object", "properties": {"key": {"type": "string"}, "value": {"type": "string"}}}
_EVENT_SCHEMA = {
    "title": "foxglove.Event",
    "type": "object",
    "properties": {"start_time": _TIME, "end_time": _TIME, "metadata": {"type": "array", "items": _PAIR}},
}
_LOG_SCHEMA = {
    "title": "foxglove.Log",
    "type": "object",
    "properties": {
        "timestamp": _TIME,
        "level": {"type": "integer"},
        "message": {"type": "string"},
        "name": {"type": "string"},
        "file": {"type": "string"},
        "line": {"type": "integer"},
    },
}


def node_topic(node: str) -> str:
    """Where what concerns one node is."""
    return f"audit/node/{node}"


class Audit(Trace):
    """What a replay finds at every step, and of every node; and each divergence."""

    def __init__(self, log: Log) -> None:
        super().__init__(log.steps)
        self.tolerance = tolerance(log.gains.problem)
        self.node_gaps: Array = np.full((log.steps, log.gains.problem.n), np.nan)
        self.divergences: list[Divergence] = []
        self.divergent = 0  # how many there are
        self._names = log.gains.problem.node_names

    def add(self, check: Check) -> None:
        super().add(check)
        now = slice(check.first, check.first + len(check.gap))
        for i in np.unique(check.owner[check.owner >= 0]):
            largest = np.fmax.reduce(check.gap[:, check.owner == i], axis=1)
            np.fmax(self.node_gaps[now, i], largest, out=self.node_gaps[now, i])
        seen: set[tuple[int, int]] = set()
        for row, place in np.argwhere(check.gap > self.tolerance).tolist():
            if (row, check.owner[place]) not in seen:  # of a vector the first entry
                seen.add((row, check.owner[place]))
                self.divergent += 1
                if len(self.divergences) < MOST_DIVERGENCES:
                    self.divergences.append(check.divergence(row, place, self._names))


def write_audit(log: Log, verdict: Verdict, audit: Audit, times: Times, output: Path, *, force: bool = False) -> None:
    """Write the layer of a log that was judged with `audit` as its trace, whole or not at all.

    Raises InputError where it cannot be written.
    """
    facts = {
        "recording": log.path.name,
        "run": log.run.get("run", ""),
        "gains": log.gains.digest(),
        "agrees": str(verdict.agrees).lower(),
        "finished": str(verdict.finished).lower(),
        "divergences": str(audit.divergent),
        "peakmesh": version("peakmesh"),
    }
    attachments = {"verdict.json": _finite(verdict.document()), "audit-layout.json": audit_layout(log.gains.problem)}
    began = int(times.steps[0]) if log.steps else 0
    with writing_layer(output, "audit", facts, attachments, time=began, force=force) as layer:
        _declare(layer, log.gains.problem)
        found = happenings(log, audit.divergences, times)
        happening = next(found, None)
        for k, (of_step, of_nodes) in enumerate(zip(_steps(log, audit, verdict), _nodes(log, audit), strict=True)):
            layer.add(STEP, int(times.steps[k]), of_step)
            for name, of_node in of_nodes.items():
                layer.add(node_topic(name), times.of(estimate(name), k), of_node)
            while happening is not None and happening.step == k:
                _tell(layer, happening)
                happening = next(found, None)
        last = max(log.steps - 1, 0)
        text = f"replay: {'agrees' if verdict.agrees else 'DIVERGES'}, {log.steps} of {log.planned} steps"
        _tell(layer, Happening("verdict", last, "", text, not verdict.agrees, times.last))


def audit_layout(problem: Problem) -> dict[str, Any]:
    """The recording's own layout, and below it errors and bounds, gaps, and the log of what happened."""
    own = foxglove_layout(problem)
    errors = {name: (STEP, name) for name in ("error", "path_bound", "mean_bound")}
    errors |= {f"error of {name}": (node_topic(name), "error") for name in problem.node_names}
    gaps = {name: (STEP, name) for name in ("gap_1", "gap_2", "gap_3", "tolerance")}
    panels = own["configById"] | {
        "Plot!errors": plot("errors and their bounds", errors),
        "Plot!gaps": plot("gaps of the replay", gaps),
        "RosOut!happenings": {"topicToRender": LINES, "minLogLevel": 1, "searchTerms": []},
    }
    below = column("Plot!errors", column("Plot!gaps", "RosOut!happenings"))
    return layout(panels, {"direction": "row", "first": own["layout"], "second": below})


def _declare(layer: LayerWriter, problem: Problem) -> None:
    layer.topic(STEP, "peakmesh.AuditStep", _schema("What replay found at a step.", OF_STEP))
    for name in problem.node_names:
        layer.topic(node_topic(name), "peakmesh.AuditNode", _schema("What replay found at a step of a node.", OF_NODE))
    layer.topic(EVENTS, "foxglove.Event", _EVENT_SCHEMA)
    layer.topic(LINES, "foxglove.Log", _LOG_SCHEMA)


def _schema(about: str, fields: Mapping[str, str]) -> dict[str, Any]:
    """Flat; what is not known is left out of a message."""
    numbers = {name: {"type": "number", "description": meaning} for name, meaning in fields.items()}
    step = {"step": {"type": "integer", "minimum": 0, "description": "k, counted from 0"}}
    return {
        "type": "object",
        "description": about,
        "properties": step | numbers,
        "required": ["step"],
        "additionalProperties": False,
    }


def _steps(log: Log, audit: Audit, verdict: Verdict) -> Iterator[dict[str, Any]]:
    """What STEP says of each step."""
    errors = log.error_norms() if log.is_simulated else np.full(log.steps, np.nan)
    energy, bound = audit.energy_before, audit.path_bound
    gamma = verdict.gamma.value if verdict.gamma.is_claimed else np.nan
    with np.errstate(divide="ignore", invalid="ignore"):
        values = {
            "error": errors,
            "gamma_path": (bound - audit.path_start) / np.sqrt(energy),
            "path_bound": bound,
            "margin": 1.0 - errors / bound,
            "mean_bound": gamma * np.sqrt(energy) + (np.nan if verdict.gamma.start is None else verdict.gamma.start),
            "energy": energy,
            **{f"gap_{number}": gaps for number, gaps in audit.gaps.items()},
            "tolerance": np.full(log.steps, audit.tolerance),
        }
    yield from _rows(values, log.steps)


def _nodes(log: Log, audit: Audit) -> Iterator[dict[str, dict[str, Any]]]:
    """What the topic of each node says of each step, by its name."""
    problem = log.gains.problem
    errors = np.linalg.norm(log.z[:, None] - log.z_hat.reshape(log.steps, problem.n, problem.nz), axis=2)
    each = [_rows({"error": errors[:, i], "gap": audit.node_gaps[:, i]}, log.steps) for i in range(problem.n)]
    for rows in zip(*each, strict=True):
        yield dict(zip(problem.node_names, rows, strict=True))


def _rows(values: Mapping[str, Array], steps: int) -> Iterator[dict[str, Any]]:
    """A message for each step, with what is known."""
    for k in range(steps):
        numbers = {name: float(of_all[k]) for name, of_all in values.items()}
        yield {"step": k} | {name: number for name, number in numbers.items() if math.isfinite(number)}


def _tell(layer: LayerWriter, happening: Happening) -> None:
    """As an event, and as a line of the log, where every viewer shows the words."""
    time = {"sec": happening.time // 10**9, "nsec": happening.time % 10**9}
    words = {"kind": happening.kind, "step": str(happening.step), "node": happening.who, "text": happening.text}
    pairs = [{"key": key, "value": value} for key, value in words.items() if value]
    layer.add(EVENTS, happening.time, {"start_time": time, "end_time": time, "metadata": pairs})
    line = {
        "timestamp": time,
        "level": _ERROR if happening.is_fault else _INFO,
        "message": f"step {happening.step}: {happening.text}",
        "name": happening.kind,
        "file": "",
        "line": 0,
    }
    layer.add(LINES, happening.time, line)


def _finite(document: Any) -> Any:
    """A document without infinity and NaN, which JSON has not: null in their place."""
    match document:
        case dict():
            return {name: _finite(value) for name, value in document.items()}
        case list() | tuple():
            return [_finite(value) for value in document]
        case float() if not math.isfinite(document):
            return None
    return document
