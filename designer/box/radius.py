"""The robustness radius: the largest box of one shape for which gamma, a little raised, is still proved."""

from __future__ import annotations

from fractions import Fraction
from typing import Any, NamedTuple

from agent.contract.errors import InputError
from agent.contract.gains import LinkMatrices
from agent.contract.problem import Problem
from agent.contract.problem.uncertainty import Tolerance
from designer.box.extent import NAMES, Box, box_of, corners
from designer.box.robust import ends, invariant, weights_of
from designer.gain.exact import Operator
from designer.model.error_model import error_model, stacked_links
from designer.proof.by_floats import ByFloats
from designer.proof.by_vertices import ByVertices, prove

RAISED = 1.05
_LARGEST, _PARTS = Fraction(1, 2), 1000  # sizes that are tried: parts of 0.5, so four decimals are all


class Radius(NamedTuple):
    """For one shape: the size that is proved, 0 where the smallest is not, and the next that is not proved."""

    name: str
    gamma: float
    proved: float
    beyond: float | None  # None: the largest that is tried is proved

    def line(self) -> str:
        """For people."""
        end = "the largest that is tried" if self.beyond is None else f"for {self.beyond:.4f} that was not proved"
        return f"{self.name} +- {self.proved:.4f}: gamma = {self.gamma}, {RAISED:g} times as much, is proved; {end}"

    def document(self) -> dict[str, Any]:
        """For --json."""
        return self._asdict()


def radii(problem: Problem, K: LinkMatrices, H: LinkMatrices, gamma: float) -> list[Radius]:
    """Of every shape in which something of the problem may vary; gamma is proved for the problem itself."""
    found = []
    for name in NAMES:
        try:
            box_of(problem, {name: Tolerance(_LARGEST, relative=False)})
        except InputError:  # nothing may vary, or too much
            continue
        found.append(_radius(problem, K, H, name, gamma * RAISED))
    return found


def _radius(problem: Problem, K: LinkMatrices, H: LinkMatrices, name: str, gamma: float) -> Radius:
    def size(parts: int) -> Fraction:
        return _LARGEST * parts / _PARTS

    def holds(parts: int) -> bool:
        return proves(problem, K, H, box_of(problem, {name: Tolerance(size(parts), relative=False)}), gamma)

    low, high = 0, _PARTS + 1
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if holds(middle) else (low, middle)
    return Radius(name, gamma, float(size(low)), float(size(high)) if high <= _PARTS else None)


def proves(problem: Problem, K: LinkMatrices, H: LinkMatrices, box: Box, gamma: float) -> bool:
    """Whether this gamma is proved for every model of the box, with the weights of the nominal one."""
    nominal = error_model(problem, *stacked_links(problem, K, H))
    weights = weights_of(nominal, RAISED**2 - 1.0)
    if weights is None:
        return False
    by = ByVertices([ByFloats(problem, K, H, corner) for corner in corners(problem, box)], weights)
    P = invariant(by, Operator(nominal).units)
    return P is not None and ends(by, P, gamma**2) and prove(by, problem.mode_names, gamma, P).holds
