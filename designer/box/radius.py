"""The robustness radius: the largest box of one shape for which gamma, a little raised, is still proved."""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from typing import Any, NamedTuple

from agent.contract.arrays import Array
from agent.contract.errors import InputError
from agent.contract.gains import LinkMatrices
from agent.contract.problem import Problem
from agent.contract.problem.uncertainty import Tolerance
from designer.box.extent import Box, box_of, corners, truth_at
from designer.box.natural import Side, sides
from designer.box.robust import models_of
from designer.box.sought import ends, sought
from designer.box.tail import invariant
from designer.box.weights import mixed, weights_of
from designer.box.worst import Worst, gain_of, model_of, there_of, worst
from designer.gain.exact import Operator
from designer.proof.ball_model import told
from designer.proof.by_vertices import ByVertices, prove
from designer.proof.cube import Cube

RAISED = 1.05
_LARGEST, _PARTS = Fraction(1, 2), 5000  # sizes that are tried: parts of 0.5, so four decimals are all
_FIRST = 64  # of them
_STEPS = 200  # in which the recursion has to end
_FEW_NODES, _LITTLE = 8, 2e4  # of S(Y), at all corners and in all modes, a number for each row that meets another


class Shape(NamedTuple):
    """Boxes of one shape: what varies, and whether sizes are parts of the values."""

    names: tuple[str, ...]
    relative: bool

    @property
    def name(self) -> str:
        return ", ".join(self.names)

    def text(self, size: float) -> str:
        return f"{100 * size:.2f} %" if self.relative else f"{size:.4f}"

    def box(self, problem: Problem, size: Fraction) -> Box:
        """Raises InputError where there is nothing that may vary, or too much."""
        return box_of(problem, dict.fromkeys(self.names, Tolerance(size, self.relative)))


# Of A and C nothing may be off where the plant is unstable: its state is then in the errors, and grows without end.
SHAPES = (
    Shape(("probabilities",), relative=False),
    Shape(("transition",), relative=False),
    Shape(("A", "B", "C", "D"), relative=True),
    Shape(("B", "D"), relative=True),
)


class Radius(NamedTuple):
    """For one shape: the size that is proved, 0 where the smallest is not, and the next that is not proved."""

    shape: Shape
    gamma: float
    proved: float
    beyond: float | None  # None: the largest that is tried is proved

    def line(self) -> str:
        """For people."""
        text, end = self.shape.text, "the largest that is tried"
        if self.beyond is not None:
            end = f"for {text(self.beyond)} that was not proved"
        if self.proved == 0.0 and self.beyond is not None:
            none = f"no gamma {RAISED:g} times as large was proved, nor for less"
            return f"{self.shape.name}: for +- {text(self.beyond)} {none}"
        size = f"{self.shape.name} +- {text(self.proved)}"
        return f"{size}: gamma = {self.gamma}, {RAISED:g} times as much, is proved; {end}"

    def document(self) -> dict[str, Any]:
        """For --json."""
        return {**self._asdict(), "shape": self.shape.name, "relative": self.shape.relative}


def radii(problem: Problem, K: LinkMatrices, H: LinkMatrices, gamma: float, *, dear: bool = True) -> list[Radius]:
    """Of every shape in which something of the problem may vary; gamma is proved for the problem itself.

    Without `dear` only of those shapes that take a second or so, and less closely.
    """
    found = []
    for shape in SHAPES[:-1] if problem.plant.spectral_radius < 1.0 else (*SHAPES[:2], SHAPES[-1]):
        try:
            box = shape.box(problem, _LARGEST)
        except InputError:  # nothing may vary, or too much
            continue
        if not dear and (problem.n > _FEW_NODES or _work(problem, box) > _LITTLE):
            continue
        found.append(_radius(problem, K, H, shape, gamma * RAISED, dear=dear))
    return found


def _work(problem: Problem, box: Box) -> float:
    order = (problem.n + 1) * problem.nx + problem.nw
    return float(box.corners * len(problem.topologies) * order**3)


def _radius(problem: Problem, K: LinkMatrices, H: LinkMatrices, shape: Shape, gamma: float, *, dear: bool) -> Radius:
    """As far as weights of the nominal model lead; if `dear` from there as a box that is asked for; then proved."""
    search = _Search(problem, K, H, shape, gamma)
    low, high = search.coarse()
    if dear:
        low, high = search.further(low, high)
    while low and not search.proves(low):
        low, high = low - 1, low
    return Radius(shape, gamma, float(_size(low)), float(_size(high)) if high <= _PARTS else None)


def _size(parts: int) -> Fraction:
    return _LARGEST * parts / _PARTS


class Attempt(NamedTuple):
    """What a proof takes."""

    by: ByVertices
    P: Array


class _Search:
    """The sizes of one shape that floats see an end of the recursion for, in parts."""

    def __init__(self, problem: Problem, K: LinkMatrices, H: LinkMatrices, shape: Shape, gamma: float) -> None:
        where, self.there = sides(problem, K, H, shape.box(problem, _LARGEST))
        self.where, self.shape, self.given, self.gamma = where, shape, gamma, gamma / where.output
        there, truth = there_of(*where[:4]), told(problem)._replace(carry=where.box.carry)
        self.nominal = model_of(there, truth)
        self.weights = weights_of(self.nominal, RAISED**2 - 1.0)
        self._worst: Worst | None = None

    def coarse(self) -> tuple[int, int]:
        """One size with an end and the next without, a fiftieth apart: four times as large, and then in halves."""
        low, high = 0, _FIRST
        while high <= _PARTS and self.plainly(high) is not None:
            low, high = high, min(4 * high, _PARTS) if high < _PARTS else _PARTS + 1
        return _halved(low, high, self.plainly)

    def further(self, low: int, high: int) -> tuple[int, int]:
        """The same by better weights, beginning there."""
        if high > _PARTS:
            return low, high
        while high <= _PARTS and self.by_rounds(high) is not None:
            low, high = high, min(high + max(1, high // 10), _PARTS) if high < _PARTS else _PARTS + 1
        return _halved(low, high, self.by_rounds)

    def proves(self, parts: int) -> bool:
        """Of the numbers that were given."""
        found = self.attempt(parts)
        if found is None:
            return False
        there = self.at(parts, self.there)
        by, P = there.taken_from(self.where, *found)
        return prove(by, there.problem.mode_names, self.given, P).holds

    def at(self, parts: int, side: Side) -> Side:
        """With the box of this size there."""
        return side._replace(box=self.shape.box(side.problem, _size(parts)))

    def attempt(self, parts: int) -> Attempt | None:
        return self.plainly(parts) or self.by_rounds(parts)

    def plainly(self, parts: int) -> Attempt | None:
        """With the weights of the nominal model; None: as far as floats tell gamma is not proved so."""
        if self.weights is None:
            return None
        problem, K, H, box = self.at(parts, self.where)[:4]
        T = there_of(problem, K, H, box).T
        models = [Cube(problem, K, H, corner, box.entries, T) for corner in corners(problem, box)]
        tail = invariant(ByVertices(models, self.weights), Operator(self.nominal))
        if tail is None:
            return None
        P, X = tail
        by = ByVertices(models, mixed(self.weights, X) if box.entries else self.weights, X)
        return Attempt(by, P) if ends(by, P, self.gamma**2, _STEPS) else None

    def by_rounds(self, parts: int) -> Attempt | None:
        """With those that `designer.box.robust` finds; None as well where the model that is worst has more."""
        side, gamma = self.at(parts, self.where), self.gamma
        problem, K, H, box = side[:4]
        if self._worst is None:  # other sizes are likely to have theirs in the same corner
            self._worst = worst(problem, K, H, box)
        rows = [min(k, len(found) - 1) for k, found in zip(self._worst.rows, box.rows, strict=True)]
        truth = truth_at(problem, box, self._worst.ends, rows, self._worst.signs)
        models, likely = models_of(side, truth)
        if not gain_of(problem, K, H, box, truth) < gamma:
            return None
        least = sought(models, likely, gamma**2, enough=gamma**2)
        return None if least is None or least.g > gamma**2 else Attempt(least.by, least.P)


def _halved(low: int, high: int, attempt: Callable[[int], Attempt | None]) -> tuple[int, int]:
    """Known to a fiftieth."""
    while high - low > max(1, low // 50):
        middle = (low + high) // 2
        low, high = (low, middle) if attempt(middle) is None else (middle, high)
    return low, high
