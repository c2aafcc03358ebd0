"""What gains guarantee for every model of a box: the worst model found, and the least gamma that is proved for all."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import islice
from typing import Any, NamedTuple

import numpy as np

from agent.contract.arrays import Array
from agent.contract.errors import counted
from agent.contract.gains import LinkMatrices
from agent.contract.problem import Problem
from designer.box.extent import Box, corners
from designer.box.passes import step
from designer.box.tail import invariant
from designer.box.weights import Recipe, Round, mixed, moved, starts
from designer.box.worst import Worst, real_model, there_of, worst
from designer.decay import is_positive
from designer.gain.exact import Operator
from designer.model.error_model import ErrorModel
from designer.proof.ball_model import Truth, told
from designer.proof.by_vertices import ByVertices, prove
from designer.proof.cube import Cube
from designer.proof.findings import Verdict
from designer.proof.recursion import Arithmetic
from designer.proof.vertices_by_balls import VerticesByBalls

_MOST_STEPS = 2000
_CLOSE = 1e-4  # relative width of the search for g
_FAR = 100.0  # times the worst that was found: nothing is sought beyond
_CLAIMED = (1e-6, 1e-5, 1e-4, 1e-3)  # gamma beyond what floats find, until it is proved
_SHARE, _LEAST_SHARE = 0.4, 0.1  # how far the first round of the weights goes, and the last
_BEYOND = (0.02, 0.02, 0.01, 0.01, 0.005, 0.005, 0.002, 0.002)  # g of every round, beyond the least


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
            f"box        {self.box.extent}; {self.box.corners} corners; constant, or changing at every step",
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


def robust(problem: Problem, K: LinkMatrices, H: LinkMatrices, box: Box, *, balls: bool = False) -> Robust:
    """The worst model that a search finds, and the least gamma for all: sought in floats, then proved.

    `balls`: and proved once more in ball arithmetic.
    """
    found = worst(problem, K, H, box)
    if not math.isfinite(found.gain):
        return Robust(box, found, None)
    models, likely = _models(problem, K, H, box, found.truth)
    least = _sought(models, likely, found.gain**2)
    if least is None:
        return Robust(box, found, None)
    for more in _CLAIMED:
        verdict = prove(least.by, problem.mode_names, math.sqrt(least.g) * (1.0 + more), least.P)
        if verdict.holds:
            break
    gamma, recipe = verdict.gamma, least.recipe
    if balls and verdict.holds:
        return Robust(box, found, proved_at(problem, K, H, box, found.truth, gamma, recipe, balls=True), recipe)
    return Robust(box, found, verdict, recipe)


def proved_at(
    problem: Problem,
    K: LinkMatrices,
    H: LinkMatrices,
    box: Box,
    truth: Truth,
    gamma: float,
    recipe: Recipe,
    *,
    balls: bool = False,
) -> Verdict | None:
    """Whether gamma holds for every model of the box, with the weights of the recipe; None: there are none.

    `truth`: a model of the box in which the worst w is like the worst of all. `balls`: in ball arithmetic.
    """
    models, likely = _models(problem, K, H, box, truth)
    ends_by = next(islice(_begun(models, likely), recipe.start, None), None)
    if ends_by is None:
        return None
    by, P = ends_by
    for to in recipe.rounds:
        weights = moved(by, Operator(likely[-1]).units, to)
        if weights is None:
            return None
        by = ByVertices(models, weights, by.mean)
    arithmetic: Arithmetic = by
    if balls:
        arithmetic = VerticesByBalls(problem, K, H, [model.truth for model in models], box.entries, by, T=models[0].T)
    return prove(arithmetic, problem.mode_names, gamma, P)


def _models(
    problem: Problem, K: LinkMatrices, H: LinkMatrices, box: Box, truth: Truth
) -> tuple[list[Cube], list[ErrorModel]]:
    """What stands at the corners, the likely worst first; and models whose worst w makes weights, the nominal last."""
    every = sorted(corners(problem, box), key=lambda corner: _differs(corner, truth))
    there = there_of(problem, K, H, box)
    likely = [
        real_model(there.problem, there.K, there.H, each) for each in (truth, told(problem)._replace(carry=box.carry))
    ]
    return [Cube(problem, K, H, corner, box.entries, there.T) for corner in every], likely


class _Least(NamedTuple):
    """The least g that was found, what a proof of it takes, and how that was made."""

    g: float
    by: ByVertices
    P: Array
    recipe: Recipe


def _begun(models: list[Cube], likely: list[ErrorModel]) -> Iterator[tuple[ByVertices, Array]]:
    """The weights to begin with, and P; none where no P is found."""
    tail: tuple[Array, Array] | None = None
    spreads = models[0].spreads
    for weights in starts(likely, spreads=spreads):
        tail = tail or invariant(ByVertices(models, weights), Operator(likely[-1]))
        if tail is None:
            return
        P, X = tail
        yield ByVertices(models, mixed(weights, X) if spreads else weights, X), P


def _sought(models: list[Cube], likely: list[ErrorModel], low: float) -> _Least | None:
    """From the best of the weights to begin with, where entries are off, to better ones; as far as floats tell."""
    least: _Least | None = None
    for start, (by, P) in enumerate(_begun(models, likely)):
        g = _less(by, P, low, None if least is None else least.g)
        if g is not None:
            least = _Least(g, by, P, Recipe(start, ()))
    if least is None:
        return None
    share, units = _SHARE, Operator(likely[-1]).units
    for beyond in _BEYOND[:: 1 if len(models) == 1 else 2] if models[0].spreads else ():
        to = Round(math.sqrt(least.g * (1.0 + beyond)), share)
        weights = moved(least.by, units, to)
        if weights is None:
            break
        by = ByVertices(models, weights, least.by.mean)
        g = _less(by, least.P, low, least.g)
        if g is None:
            share /= 2.0
            if share < _LEAST_SHARE:
                break
        else:
            share = min(1.5 * share, 1.0)
            least = _Least(g, by, least.P, least.recipe._replace(rounds=(*least.recipe.rounds, to)))
    return least


def _differs(one: Truth, other: Truth) -> bool:
    return bool((one.beta != other.beta).any() or (one.rho != other.rho).any())


def _less(by: ByVertices, P: Array, low: float, best: float | None) -> float | None:
    """The least g at which the recursion comes to Y < g P, as far as floats tell; None: not below `best`."""
    high = low * 1.005 if best is None else best * (1.0 - 2.0 * _CLOSE)
    while not ends(by, P, high):
        if best is not None or high > _FAR * low:
            return None
        low, high = high, low + 2.5 * (high - low)
    fall = 2.0 * _CLOSE
    while (lower := high * (1.0 - fall)) > low and ends(by, P, lower):
        high, fall = lower, 3.0 * fall
    low = max(low, lower)
    while high > low * (1.0 + _CLOSE):
        middle = math.sqrt(low * high)
        low, high = (low, middle) if ends(by, P, middle) else (middle, high)
    return high


@np.errstate(all="ignore")  # what overflows does not end
def ends(by: ByVertices, P: Array, g: float, most: int = _MOST_STEPS) -> bool:
    """Whether the recursion at g comes to Y < g P, as far as floats tell."""
    Y = by.corners[0].ended(by.mean)
    for steps in range(most):
        taken = step(by.upper(Y, steps), by.order, g)
        if taken is None:
            return False
        Y = taken.Y
        if is_positive(g * P - Y):
            return True
    return False
