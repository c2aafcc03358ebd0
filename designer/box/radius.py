"""The robustness radius: the largest box of one shape for which gamma, a little raised, is still proved."""

from __future__ import annotations

from fractions import Fraction
from typing import Any, NamedTuple

from agent.contract.arrays import Array
from agent.contract.errors import InputError
from agent.contract.gains import LinkMatrices
from agent.contract.problem import Problem
from agent.contract.problem.uncertainty import Tolerance
from designer.box.extent import Box, box_of, corners
from designer.box.robust import ends
from designer.box.tail import invariant
from designer.box.weights import mixed, weights_of
from designer.box.worst import real_model, there_of
from designer.gain.exact import Operator
from designer.model.error_model import ErrorModel
from designer.proof.ball_model import told
from designer.proof.by_vertices import ByVertices, prove
from designer.proof.cube import Cube

RAISED = 1.05
_LARGEST, _PARTS = Fraction(1, 2), 1000  # sizes that are tried: parts of 0.5, so four decimals are all
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

    Without `dear` only of those shapes that take a few seconds.
    """
    found = []
    for shape in SHAPES[:-1] if problem.plant.spectral_radius < 1.0 else (*SHAPES[:2], SHAPES[-1]):
        try:
            box = shape.box(problem, _LARGEST)
        except InputError:  # nothing may vary, or too much
            continue
        if not dear and (problem.n > _FEW_NODES or _work(problem, box) > _LITTLE):
            continue
        found.append(_radius(problem, K, H, shape, gamma * RAISED))
    return found


def _work(problem: Problem, box: Box) -> float:
    order = (problem.n + 1) * problem.nx + problem.nw
    return float(box.corners * len(problem.topologies) * order**3)


def _radius(problem: Problem, K: LinkMatrices, H: LinkMatrices, shape: Shape, gamma: float) -> Radius:
    """Four times as large as long as floats see an end, then in halves until it is known to a fiftieth; then proved."""
    largest = shape.box(problem, _LARGEST)
    there, truth = there_of(problem, K, H, largest), told(problem)._replace(carry=largest.carry)
    nominal = real_model(there.problem, there.K, there.H, truth)
    weights = weights_of(nominal, RAISED**2 - 1.0)

    def size(parts: int) -> Fraction:
        return _LARGEST * parts / _PARTS

    def attempt(parts: int) -> Attempt | None:
        box = shape.box(problem, size(parts))
        return None if weights is None else attempted(problem, K, H, box, gamma, nominal, weights)

    low, high = 0, 1
    while high <= _PARTS and attempt(high) is not None:
        low, high = high, min(4 * high, _PARTS) if high < _PARTS else _PARTS + 1
    while high - low > max(1, low // 50):
        middle = (low + high) // 2
        low, high = (low, middle) if attempt(middle) is None else (middle, high)
    while low and not ((found := attempt(low)) and prove(found.by, problem.mode_names, gamma, found.P).holds):
        low, high = low - 1, low
    return Radius(shape, gamma, float(size(low)), float(size(high)) if high <= _PARTS else None)


class Attempt(NamedTuple):
    """What a proof takes."""

    by: ByVertices
    P: Array


def attempted(
    problem: Problem,
    K: LinkMatrices,
    H: LinkMatrices,
    box: Box,
    gamma: float,
    nominal: ErrorModel,
    weights: Array,
) -> Attempt | None:
    """With the weights of the nominal model; None: as far as floats tell this gamma is not proved so."""
    T = there_of(problem, K, H, box).T
    models = [Cube(problem, K, H, corner, box.entries, T) for corner in corners(problem, box)]
    tail = invariant(ByVertices(models, weights), Operator(nominal))
    if tail is None:
        return None
    P, X = tail
    by = ByVertices(models, mixed(weights, X) if box.entries else weights, X)
    return Attempt(by, P) if ends(by, P, gamma**2, _STEPS) else None
