"""What gains guarantee for every model of a box: the worst model found, and the least gamma that is proved for all."""

from __future__ import annotations

import math
from itertools import islice
from typing import Any, NamedTuple

from agent.contract.errors import counted
from agent.contract.gains import LinkMatrices
from agent.contract.problem import Problem
from designer.box.extent import Box, corners, truth_at
from designer.box.natural import Side, sides
from designer.box.sought import begun, sought
from designer.box.weights import Recipe, moved
from designer.box.worst import Worst, model_of, there_of, worst
from designer.gain.exact import Operator
from designer.model.error_model import ErrorModel
from designer.patience import Budget
from designer.proof.ball_model import Truth, told
from designer.proof.by_vertices import ByVertices, prove
from designer.proof.cube import Cube
from designer.proof.findings import Verdict
from designer.proof.recursion import Arithmetic
from designer.proof.vertices_by_balls import VerticesByBalls

_SHARE_OF_WORST = 0.5  # of the time there is, before weights are sought
_CLAIMED = (1e-6, 1e-5, 1e-4, 1e-3)  # gamma beyond what floats find, until it is proved


class Robust(NamedTuple):
    """The answer for one box."""

    box: Box
    worst: Worst  # constant model that was found
    verdict: Verdict | None  # None: no P for all corners was found, or no gamma
    recipe: Recipe = Recipe(0, ())  # of the weights that prove it

    @property
    def found(self) -> float:
        """The exact gain of the worst constant model that was found; infinite: it is not stable."""
        return self.worst.gain

    @property
    def gamma(self) -> float | None:
        """Proved for every model of the box."""
        return self.verdict.gamma if self.verdict is not None and self.verdict.holds else None

    def document(self) -> dict[str, Any]:
        """For --json."""
        return {
            "box": self.box.extent,
            "corners": self.box.corners,
            "intervals": [[part.what, part.low, part.high] for part in self.box.intervals],
            "worst_found": self.found if math.isfinite(self.found) else None,
            "worst_model": self.worst.document(),
            "proved": self.gamma,
            "why_not": None if self.gamma is not None else self.why_not,
        }

    def lines(self) -> list[str]:
        """For people, below the ladder."""
        lines = [
            f"box        {self.box.extent}; {counted(self.box.corners, 'corner')}; constant, or changing at every step",
            *(f"           {remark}" for remark in self.box.remarks()),
        ]
        if self.box.intervals and math.isfinite(self.found):
            at = ", ".join(
                f"{part.what} {part.high if upper else part.low:.4g}"
                for part, upper in zip(self.box.intervals, self.worst.ends, strict=True)
            )
            lines.append(f"           worst found at {at}")
        if self.box.entries:
            off = counted(len(self.box.entries), "entry")
            lines.append(f"           worst found with {off} of matrices off by all they may; --json has the model")
        if self.gamma is None:
            lines.append(f"           no gamma is proved for the box: {self.why_not}")
        return lines

    def of_verify(self) -> list[str]:
        """For people, among what `verify` has proved."""
        if self.gamma is None:
            return [f"within  {self.box.extent}: no gamma is proved for the box: {self.why_not}", *self._cuts()]
        said = f"gamma = {self.gamma} is proved for every model of the box, one model or another at every step"
        return [f"within  {self.box.extent}: {said}; the worst found has {self.found:.6g}", *self._cuts()]

    def _cuts(self) -> list[str]:
        return [f"        {remark}" for remark in self.box.remarks()]

    @property
    def why_not(self) -> str:
        """Where none is proved."""
        if not math.isfinite(self.found):
            return "a model in it is not mean-square stable, as far as floats tell"
        if self.verdict is None:
            return "no P was found that satisfies (17) at every corner and ends the recursion"
        return str(self.verdict.failure)


def robust(
    problem: Problem, K: LinkMatrices, H: LinkMatrices, box: Box, *, balls: bool = False, budget: Budget | None = None
) -> Robust:
    """The worst model that a search finds, and the least gamma for all: sought in floats, then proved.

    `balls`: and proved once more in ball arithmetic. Where the `budget` is over, what was found by then is proved.
    """
    budget = Budget() if budget is None else budget
    where, there = sides(problem, K, H, box)
    budget.goes_on("looking for the worst model of the box")
    over = budget.over_after(_SHARE_OF_WORST, "to look at more models of the box, for the worst")
    near = worst(*where[:4], over)
    truth = truth_at(problem, box, near.ends, near.rows, near.signs)
    found = near._replace(truth=truth, gain=near.gain * where.output)
    if not math.isfinite(near.gain):
        return Robust(box, found, None)
    models, likely = models_of(where, near.truth)
    budget.goes_on("looking for the least gamma for every model of the box")
    over = budget.over_after(1.0, "a gamma for the box as low as floats find it")
    least = sought(models, likely, near.gain**2, over=over)
    if least is None:
        return Robust(box, found, None)
    budget.goes_on("proving gamma for every model of the box")
    by, P = there.taken_from(where, least.by, least.P)
    for more in _CLAIMED:
        verdict = prove(by, problem.mode_names, math.sqrt(least.g) * where.output * (1.0 + more), P)
        if verdict.holds:
            break
    recipe = least.recipe.times(where.output)
    if balls and verdict.holds:
        return Robust(box, found, proved_at(problem, K, H, box, found, verdict.gamma, recipe, balls=True), recipe)
    return Robust(box, found, verdict, recipe)


def proved_at(
    problem: Problem,
    K: LinkMatrices,
    H: LinkMatrices,
    box: Box,
    near: Worst,
    gamma: float,
    recipe: Recipe,
    *,
    balls: bool = False,
) -> Verdict | None:
    """Whether gamma holds for every model of the box, with the weights of the recipe; None: there are none.

    `near`: a model of the box in which the worst w is like the worst of all. `balls`: in ball arithmetic.
    """
    where, there = sides(problem, K, H, box)
    models, likely = models_of(where, truth_at(where.problem, where.box, near.ends, near.rows, near.signs))
    ends_by = next(islice(begun(models, likely), recipe.start, None), None)
    if ends_by is None:
        return None
    by, P = ends_by
    for to in recipe.times(1.0 / where.output).rounds:
        weights = moved(by, Operator(likely[-1]).units, to)
        if weights is None:
            return None
        by = ByVertices(models, weights, by.mean)
    by, P = there.taken_from(where, by, P)
    arithmetic: Arithmetic = by
    if balls:
        T, every = by.corners[0].T, [model.truth for model in by.corners]
        arithmetic = VerticesByBalls(there.problem, there.K, there.H, every, there.box.entries, by, T=T)
    return prove(arithmetic, problem.mode_names, gamma, P)


def models_of(side: Side, truth: Truth) -> tuple[list[Cube], list[ErrorModel]]:
    """What stands at the corners, the likely worst first; and models whose worst w makes weights, the nominal last."""
    problem, K, H, box = side[:4]
    every = sorted(corners(problem, box), key=lambda corner: _differs(corner, truth))
    there = there_of(problem, K, H, box)
    likely = [model_of(there, each) for each in (truth, told(problem)._replace(carry=box.carry))]
    return [Cube(problem, K, H, corner, box.entries, there.T) for corner in every], likely


def _differs(one: Truth, other: Truth) -> bool:
    return bool((one.beta != other.beta).any() or (one.rho != other.rho).any())
