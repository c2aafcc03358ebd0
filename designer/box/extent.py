"""A box of models, as data: how far numbers may be from those of the file, and its corners.

The gains, and the beta_j in filters that do not see their losses, are those of the file. beta and rho may be anywhere
in an interval, each by itself; a row of Pi anywhere within a total variation. They may change at every step, and
depend on all that happened before it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from fractions import Fraction
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from agent.contract.errors import InputError, counted, shortened
from agent.contract.problem import Problem
from agent.contract.problem.uncertainty import Tolerance, tolerance
from designer.box.rows import Row, row_corners
from designer.proof.ball_model import Truth, told

NAMES = {
    "probabilities": "arrival and delivery probabilities below 1, each +- so much: 0.02, or 2% of the value",
    "transition": "each row of the transition matrix within so much of total variation: 0.05",
}
MOST_CORNERS = 1024


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
    try:
        found = tolerance(size if size.endswith("%") else float(size), most=1.0)
    except ValueError:
        found = None
    if found is None or not found.size or (found.relative and not relative):
        like = "0.02 or 2%" if relative else "0.05"
        raise InputError(
            f'--within {shortened(text)}: "{size}" is no tolerance; it is above 0 and at most 1, like {like}'
        )
    return found if found.relative else found._replace(size=Fraction(size))


def box_of(problem: Problem, tolerances: Mapping[str, Tolerance]) -> Box:
    """The box of these tolerances. Raises InputError where there is nothing that may vary, or too much."""
    said = ", ".join(f"{name} +- {_text(size)}" for name, size in tolerances.items())
    box = _Sizes(problem, tolerances, own=False).box(said, where="--within")
    if "probabilities" in tolerances and not box.intervals:
        raise InputError(f"--within probabilities: {problem.name} has no arrival or delivery probability below 1")
    if "transition" in tolerances and len(problem.topologies) == 1:
        raise InputError(f"--within transition: {problem.name} has one topology, so its transition matrix is certain")
    return box


def box_in(problem: Problem) -> Box | None:
    """The box that the problem says itself: `uncertainty`, and every `tolerance`. None: it is certain of all it says.

    Raises InputError where too much may vary.
    """
    said = {} if problem.uncertainty is None else problem.uncertainty.document()
    for name, parts in (("A, B or M", [problem.plant]), ("C or D", problem.nodes)):
        own = [part.tolerance.document().keys() - {"arrival_probability"} for part in parts if part.tolerance]
        if any(own) or said.keys() - {"probabilities", "transition"}:
            raise InputError(f"{problem.name}: a tolerance of {name} is not proved yet; leave it out")
    general = {name: tolerance(size) for name, size in said.items()}
    box = _Sizes(problem, general, own=True).box("tolerances of the problem file", where="uncertainty")
    return box if box.corners > 1 else None


def _text(size: Tolerance) -> str:
    return f"{float(100 * size.size):g} %" if size.relative else f"{float(size.size):g}"


class _Sizes:
    """How far each number may be off: `own`, as it says itself, and else as `general` says of its kind."""

    def __init__(self, problem: Problem, general: Mapping[str, Tolerance], *, own: bool) -> None:
        self.problem, self.general, self.own = problem, general, own

    def box(self, extent: str, *, where: str) -> Box:
        box = Box(tuple(self._intervals()), tuple(self._rows()), extent)
        if box.corners > MOST_CORNERS:
            raise InputError(
                f"{where}: the box has {box.corners} corners, of {counted(len(box.intervals), 'probability')} and "
                f"rows of the transition matrix; up to {MOST_CORNERS} are looked at"
            )
        return box

    def _said(self, part: Any, name: str) -> Any:
        """What the part's own `tolerance` says of it."""
        return getattr(part.tolerance, name, None) if self.own else None

    def _rows(self) -> Iterator[tuple[Row, ...]]:
        rows, given = told(self.problem).transition, self._said(self.problem.markov, "transition")
        if given is None:
            sizes = [self.general["transition"].size if "transition" in self.general else Fraction(0)] * len(rows)
        else:
            sizes = [tolerance(size).size for size in (given if isinstance(given, list) else [given] * len(rows))]
        for row, size in zip(rows, sizes, strict=True):
            yield row_corners(tuple(row), size)

    def _intervals(self) -> Iterator[Interval]:
        problem = self.problem
        for j, node in enumerate(problem.nodes):
            what, value = f'arrival at node "{node.name}"', node.arrival_probability
            yield from self._interval(what, "beta", (j,), value, self._said(node, "arrival_probability"))
        for link in problem.links or ():
            at = problem.node_index(link.receiver), problem.node_index(link.sender)
            what, value = f'delivery from "{link.sender}" to "{link.receiver}"', link.delivery_probability
            yield from self._interval(what, "rho", at, value, self._said(link, "delivery_probability"))

    def _interval(self, what: str, matrix: str, at: tuple[int, ...], value: float, given: Any) -> Iterator[Interval]:
        """A probability of 1 is certain, unless it says itself that it is not."""
        if given is not None:
            below, above = [tolerance(side) for side in (given if isinstance(given, list) else [given, given])]
        elif "probabilities" in self.general and value < 1.0:
            below = above = self.general["probabilities"]
        else:
            return
        low, high = Fraction(value) - below.of(value), Fraction(value) + above.of(value)
        if low < high:
            ends = _outwards(max(low, Fraction(0)), min(high, Fraction(1)))
            yield Interval(what, matrix, at, *ends, cut=low < 0 or high > 1)


def _outwards(low: Fraction, high: Fraction) -> tuple[float, float]:
    """The floats next to both, on the outside."""
    below, above = float(low), float(high)
    return (
        below if Fraction(below) <= low else math.nextafter(below, -math.inf),
        above if Fraction(above) >= high else math.nextafter(above, math.inf),
    )


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
