"""A box of models, as data: how far probabilities may be from those of the file, and its corners.

The gains, and the beta_j in filters that do not see their losses, are those of the file. beta and rho may be anywhere
in an interval, each by itself; a row of Pi anywhere within a total variation. They may change at every step, and
depend on all that happened before it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from fractions import Fraction
from itertools import product
from typing import NamedTuple

import numpy as np

from agent.contract.errors import InputError, counted, shortened
from agent.contract.problem import Problem
from designer.proof.ball_model import Truth, told

NAMES = {
    "probabilities": "arrival and delivery probabilities below 1, each +- so much: 0.02, or 2% of the value",
    "transition": "each row of the transition matrix within so much of total variation: 0.05",
}
MOST_CORNERS = 1024
Row = tuple[Fraction, ...]


class Tolerance(NamedTuple):
    """How far a number may be off: in its own units, or as a part of it."""

    size: Fraction
    relative: bool

    def of(self, value: float) -> Fraction:
        return self.size * abs(Fraction(value)) if self.relative else self.size


class Interval(NamedTuple):
    """Where one probability may be; the ends are rounded outwards, and cut at 0 and 1."""

    what: str
    matrix: str  # "beta" or "rho"
    at: tuple[int, ...]
    low: float
    high: float
    cut: bool


class Box(NamedTuple):
    """Every model for which gamma is asked."""

    intervals: tuple[Interval, ...]
    rows: tuple[tuple[Row, ...], ...]  # of each mode: the corners of what the row may be; one, where it is the file's
    extent: str

    @property
    def corners(self) -> int:
        """How many models decide: S(Y)(s) knows one row of Pi alone, so rows of several modes turn together."""
        return int(2 ** len(self.intervals)) * max(len(rows) for rows in self.rows)

    def remarks(self) -> list[str]:
        """What the box is not, though it was asked for."""
        return [f"{part.what} is cut to [{part.low:.6g}, {part.high:.6g}]" for part in self.intervals if part.cut]


def within(texts: Sequence[str]) -> dict[str, Tolerance]:
    """`name=size` of every option --within. Raises InputError."""
    found: dict[str, Tolerance] = {}
    for text in texts:
        name, _, size = text.partition("=")
        if name not in NAMES:
            raise InputError(f"--within {shortened(text)}: {shortened(name)} is none of {', '.join(NAMES)}")
        if name in found:
            raise InputError(f"--within: {name} is there twice; give it one tolerance")
        found[name] = _tolerance(text, size, relative=name != "transition")
    return found


def _tolerance(text: str, size: str, *, relative: bool) -> Tolerance:
    part, number = size.endswith("%"), size.removesuffix("%")
    try:
        about = float(number)  # a fraction of 1e999999999 would have as many digits
    except ValueError:
        about = math.nan
    if not 0.0 < about <= (100.0 if part else 1.0) or (part and not relative):
        like = "0.02 or 2%" if relative else "0.05"
        raise InputError(
            f'--within {shortened(text)}: "{size}" is no tolerance; it is above 0 and at most 1, like {like}'
        )
    return Tolerance(Fraction(number) / (100 if part else 1), part)


def box_of(problem: Problem, tolerances: dict[str, Tolerance]) -> Box:
    """The box around the problem. Raises InputError where there is nothing that may vary, or too much."""
    probabilities, transition = tolerances.get("probabilities"), tolerances.get("transition")
    intervals = () if probabilities is None else tuple(_intervals(problem, probabilities))
    if probabilities is not None and not intervals:
        raise InputError(f"--within probabilities: {problem.name} has no arrival or delivery probability below 1")
    if transition is not None and len(problem.topologies) == 1:
        raise InputError(f"--within transition: {problem.name} has one topology, so its transition matrix is certain")
    rows = tuple(
        (tuple(row),) if transition is None else row_corners(tuple(row), transition.size)
        for row in told(problem).transition
    )
    said = [f"{name} +- {_text(size)}" for name, size in tolerances.items()]
    box = Box(intervals, rows, ", ".join(said))
    if box.corners > MOST_CORNERS:
        raise InputError(
            f"--within: the box has {box.corners} corners, of {counted(len(intervals), 'probability')} and rows of "
            f"the transition matrix; up to {MOST_CORNERS} are looked at"
        )
    return box


def _text(tolerance: Tolerance) -> str:
    return f"{float(100 * tolerance.size):g} %" if tolerance.relative else f"{float(tolerance.size):g}"


def _intervals(problem: Problem, tolerance: Tolerance) -> Iterator[Interval]:
    for j, node in enumerate(problem.nodes):
        if node.arrival_probability < 1.0:
            yield _interval(f'arrival at node "{node.name}"', "beta", (j,), node.arrival_probability, tolerance)
    for link in problem.links or ():
        if link.delivery_probability < 1.0:
            at = problem.node_index(link.receiver), problem.node_index(link.sender)
            what = f'delivery from "{link.sender}" to "{link.receiver}"'
            yield _interval(what, "rho", at, link.delivery_probability, tolerance)


def _interval(what: str, matrix: str, at: tuple[int, ...], value: float, tolerance: Tolerance) -> Interval:
    low, high = Fraction(value) - tolerance.of(value), Fraction(value) + tolerance.of(value)
    cut = low < 0 or high > 1
    low, high = max(low, Fraction(0)), min(high, Fraction(1))
    below, above = float(low), float(high)
    below = below if Fraction(below) <= low else math.nextafter(below, 0.0)
    above = above if Fraction(above) >= high else math.nextafter(above, 1.0)
    return Interval(what, matrix, at, below, above, cut)


def row_corners(row: Row, distance: Fraction) -> tuple[Row, ...]:
    """The corners of {pi >= 0, sum pi = 1, sum |pi - row| / 2 <= distance}.

    A linear function of pi is largest where mass `distance` went to one entry, from the others in turn: each gives all
    that it has before the next gives any.
    """
    found: dict[Row, None] = {}

    def take(pi: Row, left: Fraction, t: int) -> None:
        givers = [s for s, mass in enumerate(pi) if s != t and mass > 0]
        if left == 0 or not givers:
            found[pi] = None
            return
        for s in givers:
            moved, following = min(left, pi[s]), list(pi)
            following[s] -= moved
            following[t] += moved
            take(tuple(following), left - moved, t)

    for t in range(len(row)):
        take(row, distance, t)
    return tuple(found)


def truth_at(problem: Problem, box: Box, ends: Sequence[bool], rows: Sequence[int]) -> Truth:
    """The model with these intervals at their upper ends, and these corners of the rows of Pi."""
    beta, rho = np.array(problem.beta), np.array(problem.delivery)
    for part, upper in zip(box.intervals, ends, strict=True):
        (beta if part.matrix == "beta" else rho)[part.at] = part.high if upper else part.low
    return Truth(beta, rho, [list(of_mode[k]) for of_mode, k in zip(box.rows, rows, strict=True)])


def corners(problem: Problem, box: Box) -> list[Truth]:
    """Models of which those of one mode s are all corners of what S(Y)(s) depends on."""
    turns = range(max(len(rows) for rows in box.rows))
    return [
        truth_at(problem, box, ends, [min(turn, len(rows) - 1) for rows in box.rows])
        for ends in product((False, True), repeat=len(box.intervals))
        for turn in turns
    ]
