"""The numbers behind every picture, as CSV: one row for each step, every float in decimals that give it back."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from agent.contract.arrays import Array
from agent.contract.files import refuse_overwrite, write_whole
from agent.contract.problem import Problem
from designer.report.chart import Band, Chart, Level, Map


def of_chart(chart: Chart) -> str:
    """Columns: step, and one for each mark, two for a band; of a map one for each node."""
    named: list[tuple[str, Array]] = []
    if chart.rows is None:
        steps = max(
            len(mark.low if isinstance(mark, Band) else mark.values)
            for mark in chart.marks
            if not isinstance(mark, Level)
        )
        for mark in chart.marks:
            if isinstance(mark, Band):
                named += [(f"{mark.name}, lowest", mark.low), (f"{mark.name}, highest", mark.high)]
            else:
                named.append((mark.name, np.full(steps, mark.value) if isinstance(mark, Level) else mark.values))
    elif isinstance(chart.rows, Map):
        named = [(f"node {name}", chart.rows.values[:, i]) for i, name in enumerate(chart.rows.rows)]
    else:
        layers = chart.rows.layers
        named = [
            (f"node {node}, {name}", values[:, i])
            for name, _, values in layers
            for i, node in enumerate(chart.rows.rows)
        ]
    columns = [_cells(values, chart.categories) for _, values in named]
    return _csv(["step", *(name for name, _ in named)], ([k, *row] for k, row in enumerate(zip(*columns, strict=True))))


def of_topologies(problem: Problem) -> str:
    """A row for every link of every mode, but that of a node to itself."""
    names = problem.node_names
    rows = [
        [topology.name, names[i], names[j], topology.adjacency[i, j], problem.delivery[i, j]]
        for s, topology in enumerate(problem.topologies)
        for i in range(problem.n)
        for j in problem.neighbours(s, i)
        if i != j
    ]
    return _csv(["mode", "receiver", "sender", "weight", "delivery_probability"], rows)


def of_ladder(rungs: Iterable[tuple[str, float]]) -> str:
    return _csv(["rung", "value"], rungs)


def write(tables: dict[str, str], folder: Path, *, force: bool = False) -> list[Path]:
    """Every table as a file; nothing is written where one of them is in the way."""
    paths = {folder / f"{name}.csv": text for name, text in tables.items()}
    for path in paths:
        refuse_overwrite(path, force=force)
    for path, text in paths.items():
        write_whole(path, text.encode(), force=force)
    return list(paths)


def _cells(values: Array, categories: Sequence[str]) -> list[Any]:
    """Names where there are any; nothing where a number is not known."""
    if categories:
        return ["" if math.isnan(value) else categories[int(value)] for value in values.tolist()]
    return ["" if math.isnan(value) else value for value in values.astype(float).tolist()]


def _csv(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    return text.getvalue()
