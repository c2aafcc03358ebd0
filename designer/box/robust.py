"""What gains guarantee for every model of a box: the worst model found, and the least gamma that is proved for all."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from agent.contract.arrays import Array
from agent.contract.gains import LinkMatrices
from agent.contract.problem import Problem
from designer.box.extent import Box, corners
from designer.box.worst import There, Worst, worst
from designer.decay import decay, is_positive
from designer.gain.exact import Operator, exact_gain
from designer.gain.sensitivity import sweep
from designer.invariants import scaled
from designer.model.error_model import ErrorModel
from designer.proof.ball_model import Truth, told
from designer.proof.by_vertices import ByVertices, prove, upper_bound
from designer.proof.cube import Cube
from designer.proof.findings import Verdict
from designer.proof.recursion import Arithmetic
from designer.proof.vertices_by_balls import VerticesByBalls

_WIDTH = 1e-5  # of gamma^2 of the weights' model
_HORIZON, _BEGINNING = 60, 30  # steps of the weights, and before them, from rest
_SETTLED, _BEYOND, _MOST_ROUNDS = 1e-3, 1e8, 300  # of the search for P
_ABOVE = (0.01, 0.1)  # gamma^2 of the weights above that of their model
_RIDGE = 1e-3
_MOST_STEPS = 2000
_CLOSE = 1e-4  # relative width of the search for g
_FAR = 100.0  # times the worst that was found: nothing is sought beyond
_MORE = (0.0, 0.1, 0.3, 0.6)  # growth beyond the mean of the corners, of which P is made
_CLAIMED = (1e-6, 1e-5, 1e-4, 1e-3)  # gamma beyond what floats find, until it is proved


class Robust(NamedTuple):
    """The answer for one box."""

    box: Box
    worst: Worst  # constant model that was found
    verdict: Verdict | None  # None: no P for all corners was found, or no gamma

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
    least = _sought(models, likely, Operator(likely[-1]), found.gain**2)
    if least is None:
        return Robust(box, found, None)
    g, by, P = least
    for more in _CLAIMED:
        verdict = prove(by, problem.mode_names, math.sqrt(g) * (1.0 + more), P)
        if verdict.holds:
            break
    if balls and verdict.holds:
        return Robust(box, found, proved_at(problem, K, H, box, found.truth, verdict.gamma, balls=True))
    return Robust(box, found, verdict)


def proved_at(
    problem: Problem, K: LinkMatrices, H: LinkMatrices, box: Box, truth: Truth, gamma: float, *, balls: bool = False
) -> Verdict | None:
    """Whether gamma holds for every model of the box, with what the search takes for the proof; None: it finds nothing.

    `truth`: a model of the box in which the worst w is like the worst of all. `balls`: in ball arithmetic.
    """
    models, likely = _models(problem, K, H, box, truth)
    middle, P, mean, verdict = Operator(likely[-1]), None, None, None
    for weights in (found for model in likely for above in _ABOVE if (found := weights_of(model, above)) is not None):
        by = ByVertices(models, weights, mean)
        if P is None:
            P, mean = invariant(by, middle), by.mean
        if P is not None and ends(by, P, gamma**2):
            arithmetic: Arithmetic = by
            if balls:
                arithmetic = VerticesByBalls(
                    problem, K, H, [model.truth for model in models], box.entries, by, T=models[0].T
                )
            verdict = prove(arithmetic, problem.mode_names, gamma, P)
            if verdict.holds:
                break
    return verdict


def _models(
    problem: Problem, K: LinkMatrices, H: LinkMatrices, box: Box, truth: Truth
) -> tuple[list[Cube], list[ErrorModel]]:
    """What stands at the corners, the likely worst first; and models whose worst w makes weights, the nominal last."""
    every = sorted(corners(problem, box), key=lambda corner: _differs(corner, truth))
    there = There.of(problem, K, H, box)
    likely = [there.model(each) for each in (truth, told(problem)._replace(carry=box.carry))]
    return [Cube(problem, K, H, corner, box.entries, there.T) for corner in every], likely


def _sought(
    models: list[Cube], likely: list[ErrorModel], middle: Operator, low: float
) -> tuple[float, ByVertices, Array] | None:
    """The least g, the weights that gave it, of those of each likely model, and P; as far as floats tell."""
    least: tuple[float, ByVertices, Array] | None = None
    P: Array | None = None
    mean: Array | None = None
    for model in likely:
        for above in _ABOVE:
            weights = weights_of(model, above)
            if weights is None:
                continue
            by = ByVertices(models, weights, mean)
            if P is None:
                P, mean = invariant(by, middle), by.mean
            g = None if P is None else _least(by, P, low, None if least is None else least[0])
            if g is not None and P is not None:
                least = g, by, P
    return least


def _differs(one: Truth, other: Truth) -> bool:
    return bool((one.beta != other.beta).any() or (one.rho != other.rho).any())


@np.errstate(all="ignore")  # what overflows is no P
def invariant(by: ByVertices, middle: Operator) -> Array | None:
    """P with (17) at every corner, as far as floats tell; None: not found.

    That of a model in the middle of the box, or of more growth than it has; else what grows as the box may.
    """
    n, modes = by.order, len(middle.MM)
    for more in () if any(corner.spreads for corner in by.corners) else _MORE:
        found = decay(lambda Y, more=more: (1.0 + more) * middle.corner(Y), modes, middle.units)  # type: ignore[misc]
        P = None if found.total is None or not found.dies_out else _scaled(by, found.total)
        if P is not None:
            return P
    U = np.broadcast_to(np.diag(middle.units**2), (modes, n, n))
    Z = U
    for _ in range(_MOST_ROUNDS):
        following = U + upper_bound(by.of(Z), by.mean)[:, :n, :n]
        change, Z = np.abs(following - Z).max() / np.abs(following).max(), following
        if not change > _SETTLED:
            return _scaled(by, Z)
        if not (Z.diagonal(axis1=1, axis2=2) < _BEYOND * middle.units**2).all():
            break
    return None


def _scaled(by: ByVertices, Z: Array) -> Array | None:
    """The largest multiple of Z that satisfies (17) at every corner; None: none does."""
    n, every = by.order, by.of(Z)
    rests = [Z - S[:, :n, :n] for S in every]
    if not all(is_positive(rest) for rest in rests):
        return None
    multiples = [scaled(lambda _, S=S: S, Z, rest) for S, rest in zip(every, rests, strict=True)]  # type: ignore[misc]
    return min(multiples, key=lambda P: float(np.trace(P, axis1=1, axis2=2).sum()))


def weights_of(model: ErrorModel, above: float) -> Array | None:
    """What [eta; w] is like, step by step from the last, while the worst w acts; (T, modes, n_eta + nw, the same).

    None: not mean-square stable.
    """
    operator = Operator(model)
    gain = exact_gain(model, width=_WIDTH)
    swept = sweep(operator, gain.high**2 * (1.0 + above), _HORIZON + _BEGINNING) if gain.stable else None
    if swept is None:
        return None
    n, modes = operator.size, len(operator.MM)
    X, joint = np.zeros((modes, n, n)), np.zeros((_HORIZON + _BEGINNING, modes, n + operator.nw, n + operator.nw))
    for k in range(len(joint) - 1, -1, -1):
        GX = swept.Gamma[k] @ X
        joint[k, :, :n, :n], joint[k, :, n:, :n], joint[k, :, :n, n:] = X, GX, GX.swapaxes(1, 2)
        joint[k, :, n:, n:] = GX @ swept.Gamma[k].swapaxes(1, 2) + swept.W_inverse[k] / np.abs(swept.W_inverse).max()
        X = operator.carry(joint[k])
    joint = joint[:_HORIZON]
    mean = joint.mean(axis=0)
    everywhere = mean.mean(axis=0)
    return np.asarray(joint + _RIDGE * (mean + everywhere + np.diag(_RIDGE * everywhere.diagonal())))


def _least(by: ByVertices, P: Array, low: float, best: float | None) -> float | None:
    """The least g at which the recursion comes to Y < g P, as far as floats tell; None: not below `best`."""
    high = low * 1.005 if best is None else best * (1.0 - 2.0 * _CLOSE)
    while not ends(by, P, high):
        if best is not None or high > _FAR * low:
            return None
        low, high = high, low + 2.5 * (high - low)
    while high > low * (1.0 + _CLOSE):
        middle = math.sqrt(low * high)
        low, high = (low, middle) if ends(by, P, middle) else (middle, high)
    return high


@np.errstate(all="ignore")  # what overflows does not end
def ends(by: ByVertices, P: Array, g: float, most: int = _MOST_STEPS) -> bool:
    """Whether the recursion at g comes to Y < g P, as far as floats tell."""
    Y, n = by.corners[0].ended(by.mean), by.order
    for steps in range(most):
        Z = by.upper(Y, steps)
        W, cross = g * np.eye(Z.shape[1] - n) - Z[:, n:, n:], Z[:, n:, :n]
        if not (np.isfinite(Z).all() and is_positive(W)):
            return False
        Y = Z[:, :n, :n] + cross.swapaxes(1, 2) @ np.linalg.solve(W, cross)
        if is_positive(g * P - Y):
            return True
    return False
