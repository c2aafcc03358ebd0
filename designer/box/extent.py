"""A box of models, as data: how far numbers may be from those of the file, and its corners.

The gains, and beta_j, C_j and M in the filters, are those of the file. beta and rho may be anywhere in an interval,
each by itself; a row of Pi anywhere within a total variation; entries of A, B, C, D, M off by up to a radius, each by
itself. They may change at every step, and depend on all that happened before it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from fractions import Fraction
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from agent.contract.arrays import Array
from agent.contract.errors import InputError, counted, shortened
from agent.contract.problem import Problem
from agent.contract.problem.matrices import Matrices, matrices_of
from agent.contract.problem.uncertainty import Tolerance, tolerance
from designer.box.rows import Row, row_corners
from designer.coordinates import Coordinates
from designer.proof.ball_model import Truth, told
from designer.proof.deviations import Entry

NAMES = {
    "probabilities": "arrival and delivery probabilities below 1, each +- so much: 0.02, or 2% of the value",
    "transition": "each row of the transition matrix within so much of total variation: 0.05",
    **{
        letter: f"each entry of {letter}{' of all nodes' if letter in 'CD' else ''} +- so much: 0.02, or 2% of it"
        for letter in "ABCDM"
    },
}
MATRICES = ("A", "B", "C", "D", "M")
MOST_CORNERS, MOST_ENTRIES, MOST_STATES = 1024, 400, 120


_LOST = (
    "M nearly cancels, which takes digits where entries of A, B, C or M may be off: the worst is found less exactly, "
    "and gamma proved less closely, or not at all"
)


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
    entries: tuple[Entry, ...] = ()
    carry: bool = False  # x feeds the errors of some model, though not those of the file's
    cancels: bool = False  # M does, and no coordinates help: what is off is one entry in those of the file alone

    @property
    def corners(self) -> int:
        """How many models decide: S(Y)(s) knows one row of Pi alone, so rows of several modes turn together."""
        return int(2 ** len(self.intervals)) * max(len(rows) for rows in self.rows)

    @property
    def meets_states(self) -> bool:
        """Whether entries may be off that have to do with the states: other coordinates of these would mix them."""
        return any(entry.matrix != "D" for entry in self.entries)

    def remarks(self) -> list[str]:
        """What the box is not, though it was asked for."""
        cut = [f"{part.what} is cut to [{part.low:.6g}, {part.high:.6g}]" for part in self.intervals if part.cut]
        return [*cut, _LOST] if self.cancels else cut


def within(texts: Sequence[str]) -> dict[str, Tolerance]:
    """`name=size` of every option --within. Raises InputError."""
    found: dict[str, Tolerance] = {}
    for text in texts:
        names, _, size = text.partition("=")
        for name in names.split(","):
            if name not in NAMES:
                raise InputError(f"--within {shortened(text)}: {shortened(name)} is none of {', '.join(NAMES)}")
            if name in found:
                raise InputError(f"--within: {name} is there twice; give it one tolerance")
            found[name] = _tolerance(text, size, name)
    return found


def _tolerance(text: str, size: str, name: str) -> Tolerance:
    relative, most = name != "transition", math.inf if name in MATRICES else 1.0
    try:
        found = tolerance(size if size.endswith("%") else float(size), most)
    except ValueError:
        found = None
    if found is None or not found.size or (found.relative and not relative):
        like = "0.02 or 2%" if relative else "0.05"
        limit = "above 0" if math.isinf(most) else "above 0 and at most 1"
        raise InputError(f'--within {shortened(text)}: "{size}" is no tolerance; it is {limit}, like {like}')
    return found if found.relative else found._replace(size=Fraction(size))


def box_of(problem: Problem, tolerances: Mapping[str, Tolerance]) -> Box:
    """The box of these tolerances. Raises InputError where there is nothing that may vary, or too much."""
    said = ", ".join(f"{name} +- {_text(size)}" for name, size in tolerances.items())
    box = _Sizes(problem, tolerances, own=False).box(said, where="--within")
    if "probabilities" in tolerances and not box.intervals:
        raise InputError(f"--within probabilities: {problem.name} has no arrival or delivery probability below 1")
    if "transition" in tolerances and len(problem.topologies) == 1:
        raise InputError(f"--within transition: {problem.name} has one topology, so its transition matrix is certain")
    for letter in tolerances.keys() & set(MATRICES):
        if not any(entry.matrix == letter for entry in box.entries):
            raise InputError(f"--within {letter}: every entry of {letter} is 0, and a part of that is nothing")
    return box


def box_in(problem: Problem) -> Box | None:
    """The box that the problem says itself: `uncertainty`, and every `tolerance`. None: it is certain of all it says.

    Raises InputError where too much may vary.
    """
    said = {} if problem.uncertainty is None else problem.uncertainty.document()
    general = {name: tolerance(size) for name, size in said.items()}
    box = _Sizes(problem, general, own=True).box("tolerances of the problem file", where="uncertainty")
    return box if box.corners > 1 or box.entries else None


def asked(problem: Problem, texts: Sequence[str]) -> Box | None:
    """The box of these `name=size`, or where there are none that of the problem. Raises InputError as both do."""
    return box_of(problem, within(texts)) if texts else box_in(problem)


def _text(size: Tolerance) -> str:
    return f"{float(100 * size.size):g} %" if size.relative else f"{float(size.size):g}"


class _Sizes:
    """How far each number may be off: `own`, as it says itself, and else as `general` says of its kind."""

    def __init__(self, problem: Problem, general: Mapping[str, Tolerance], *, own: bool) -> None:
        self.problem, self.general, self.own = problem, general, own

    def box(self, extent: str, *, where: str) -> Box:
        box = Box(tuple(self._intervals()), tuple(self._rows()), extent, tuple(self._entries()))
        cancels = box.meets_states and Coordinates.of(self.problem) is not None
        box = box._replace(carry=self._carries(box), cancels=cancels)
        if box.corners > MOST_CORNERS:
            raise InputError(
                f"{where}: the box has {box.corners} corners, of {counted(len(box.intervals), 'probability')} and "
                f"rows of the transition matrix; up to {MOST_CORNERS} are looked at"
            )
        if len(box.entries) > MOST_ENTRIES:
            raise InputError(f"{where}: the box has {len(box.entries)} entries; up to {MOST_ENTRIES} are looked at")
        states = (self.problem.n + 1) * self.problem.nx
        if box.entries and states > MOST_STATES:
            raise InputError(
                f"{where}: with entries of matrices up to {MOST_STATES} states of plant and errors are looked at; "
                f"{self.problem.name} has {states}"
            )
        return box

    def _carries(self, box: Box) -> bool:
        hidden = any(part.matrix == "beta" and not self.problem.nodes[part.at[0]].seen for part in box.intervals)
        return not self.problem.carries_plant and (hidden or any(entry.matrix in "ACM" for entry in box.entries))

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

    def _entries(self) -> Iterator[Entry]:
        plant, found = self.problem.plant, matrices_of(self.problem)
        for letter in ("A", "B", "M"):
            yield from self._matrix(letter, 0, getattr(found, letter), self._said(plant, letter))
        for j, node in enumerate(self.problem.nodes):
            yield from self._matrix("C", j, node.C, self._said(node, "C"))
            yield from self._matrix("D", j, node.D, self._said(node, "D"))

    def _matrix(self, letter: str, node: int, values: Array, given: Any) -> Iterator[Entry]:
        general = self.general.get(letter)
        if given is None and general is None:
            return
        for (row, column), value in np.ndenumerate(values):
            if given is None:
                assert general is not None
                size = general
            else:
                size = tolerance(given[row][column] if isinstance(given, list) else given)
            radius = _outwards(Fraction(0), size.of(float(value)))[1]
            if radius > 0.0:
                yield Entry(letter, node, row, column, radius)

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


def truth_at(problem: Problem, box: Box, ends: Sequence[bool], rows: Sequence[int], signs: Sequence[int] = ()) -> Truth:
    """The model with these intervals at their upper ends, and these corners of the rows of Pi.

    `signs`: +1, -1 or 0 for each entry, which is so many radii off; without them none is.
    """
    beta, rho = np.array(problem.beta), np.array(problem.delivery)
    for part, upper in zip(box.intervals, ends, strict=True):
        (beta if part.matrix == "beta" else rho)[part.at] = part.high if upper else part.low
    transition = [list(of_mode[k]) for of_mode, k in zip(box.rows, rows, strict=True)]
    return Truth(beta, rho, transition, _matrices(problem, box, signs) if signs else None, box.carry)


def _matrices(problem: Problem, box: Box, signs: Sequence[int]) -> Matrices:
    A, B, M, C, D = matrices_of(problem)
    moved = Matrices(A.copy(), B.copy(), M.copy(), tuple(c.copy() for c in C), tuple(d.copy() for d in D))
    for entry, sign in zip(box.entries, signs, strict=True):
        of_letter = getattr(moved, entry.matrix)
        matrix = of_letter[entry.node] if entry.matrix in "CD" else of_letter
        matrix[entry.row, entry.column] += sign * entry.radius
    return moved


def corners(problem: Problem, box: Box) -> list[Truth]:
    """Models of which those of one mode s are all corners of what S(Y)(s) depends on, but for entries of matrices."""
    turns = range(max(len(rows) for rows in box.rows))
    return [
        truth_at(problem, box, ends, [min(turn, len(rows) - 1) for rows in box.rows])
        for ends in product((False, True), repeat=len(box.intervals))
        for turn in turns
    ]
