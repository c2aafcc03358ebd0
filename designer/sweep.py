"""A design for each of several values of one key of a problem: gamma as a curve."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from agent.contract.errors import InputError, Unattainable
from agent.contract.problem import Problem
from designer.ladder import ladder_of
from designer.problems import find
from designer.search.effort import default_method
from designer.synthesis import design
from designer.workers import each, greet_cluster

_MOST = 10_000  # values
_RANGE = re.compile(r"([^:]+):([^:]+):(\d+)")


class Range(NamedTuple):
    """The values of one key, from the first to the last in equal steps."""

    key: str
    values: tuple[float, ...]


class Point(NamedTuple):
    """The design for one value; numbers are None where there is none; `reason` says why, or what was cut short."""

    value: float
    gamma: float | None  # certified
    exact: float | None  # the upper end of the exact gain
    floor: float | None
    theorem2: float | None  # the LMI's bound, where it was solved, as a solver gave it
    theorem2_least: float | None  # proved: no gains have less by the LMI
    seconds: float | None
    reason: str | None


class _Job(NamedTuple):
    value: float
    problem: Problem
    method: str
    budget: float | None


def parse_range(text: str) -> Range | None:
    """KEY=a:b:n, n values from a to b; None for KEY=VALUE. Raises InputError for a range that is none."""
    key, _, value = text.partition("=")
    found = _RANGE.fullmatch(value.strip())
    if found is None:
        return None
    try:
        first, last, number = float(found[1]), float(found[2]), int(found[3][:9])
    except ValueError:
        return None  # text with colons
    if not (math.isfinite(first) and math.isfinite(last) and 2 <= number <= _MOST):
        raise InputError(f"--set {text}: KEY=a:b:n is n values from a to b, 2 to {_MOST} of them")
    return Range(key, tuple(np.linspace(first, last, number).tolist()))


def problems(problem: str, settings: Sequence[str]) -> tuple[Range, list[Problem]]:
    """A problem (a file or a built-in name) for every value of the one setting that is a range, KEY=a:b:n.

    The other settings hold for all. Raises InputError where there is no such range, or a value makes no problem.
    """
    ranges = [(number, found) for number, text in enumerate(settings) if (found := parse_range(text)) is not None]
    if len(ranges) != 1:
        raise InputError(
            f"a sweep needs one --set KEY=a:b:n, n values from a to b, such as 'node.*.arrival_probability=0.5:1:6'; "
            f"there are {len(ranges) or 'none'}"
        )
    at, over = ranges[0]
    before, after = settings[:at], settings[at + 1 :]
    return over, [find(problem, [*before, f"{over.key}={value!r}", *after]) for value in over.values]


def sweep(
    over: Range,
    problems: Sequence[Problem],
    *,
    method: str | None = None,
    budget: float | None = None,
    dask: str | None = None,
    processes: int | None = None,
    report: Callable[[int, int, str], None] = lambda done, of, what: None,
) -> list[Point]:
    """Design each of the problems, on the processes of `designer.workers.each`.

    `report` gets how many are done, of how many, and the last of them in words. InputError for an unknown method.
    """
    if dask is not None:
        greet_cluster(dask)
    jobs = [
        _Job(value, problem, method or default_method(problem), budget)
        for value, problem in zip(over.values, problems, strict=True)
    ]
    points = []
    for point in each(_designed, jobs, dask=dask, processes=processes):
        points.append(point)
        said = "; ".join(filter(None, ["" if point.gamma is None else f"gamma {point.gamma:.6g}", point.reason]))
        report(len(points), len(jobs), f"{over.key} = {point.value:g}: {said}")
    return points


def as_csv(over: Range, points: Sequence[Point]) -> str:
    """A line for each value under a line of names; what is None is empty."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([over.key, *Point._fields[1:]])
    writer.writerows(points)
    return text.getvalue()


def document(over: Range, points: Sequence[Point]) -> dict[str, Any]:
    """The same, for --json."""
    return {"key": over.key, "points": [point._asdict() for point in points]}


def _designed(job: _Job) -> Point:
    """The job's design; that there is no certificate is an answer."""
    try:
        gains = design(job.problem, method=job.method, budget=job.budget)
    except Unattainable as error:
        return Point(job.value, None, None, None, None, None, None, str(error))
    if gains.solver.status.startswith("interrupted"):  # the best gains so far are no point of the curve
        raise KeyboardInterrupt
    ladder = ladder_of(gains)
    exact = None if ladder.exact is None else ladder.exact[1]
    is_cut = gains.solver.status.startswith("out of time")
    unfinished = "the search was out of time; --budget gives it more" if is_cut else None
    return Point(
        job.value,
        ladder.gamma,
        exact,
        ladder.floor,
        ladder.theorem2,
        ladder.theorem2_least,
        gains.seconds["total"],
        unfinished,
    )
