"""What gains guarantee for every model of a box: the worst model found, and the least gamma that is proved for all."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from agent.contract.arrays import Array
from agent.contract.gains import LinkMatrices
from agent.contract.problem import Problem
from designer.box.extent import Box, corners, truth_at
from designer.decay import decay, is_positive, scaled
from designer.gain.exact import Operator, exact_gain
from designer.gain.sensitivity import sweep
from designer.model.error_model import ErrorModel, stacked_links
from designer.model.mismatch import error_model_of
from designer.proof.ball_model import Truth
from designer.proof.by_floats import ByFloats
from designer.proof.by_vertices import ByVertices, prove
from designer.proof.findings import Verdict

_WIDTH = 1e-5  # of gamma^2: models are compared by that
_ROUNDS = 3
_HORIZON = 60  # steps of the weights
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
    found: float  # the exact gain of the worst constant model that was found; infinite: it is not stable
    worst: list[float]  # the probabilities of that model, as the intervals have them
    verdict: Verdict | None  # None: no P for all corners was found, or no gamma

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
            "why_not": None if self.gamma is not None else self._why_not,
        }

    def lines(self) -> list[str]:
        """For people, below the ladder."""
        lines = [
            f"box        {self.box.extent}; {self.box.corners} corners; constant, or changing at every step",
            *(f"           {remark}" for remark in self.box.remarks()),
        ]
        if self.box.intervals and math.isfinite(self.found):
            at = ", ".join(
                f"{part.what} {value:.4g}" for part, value in zip(self.box.intervals, self.worst, strict=True)
            )
            lines.append(f"           worst found at {at}")
        if self.gamma is None:
            lines.append(f"           no gamma is proved for the box: {self._why_not}")
        return lines

    def of_verify(self) -> list[str]:
        """For people, among what `verify` has proved."""
        if self.gamma is None:
            return [f"within  {self.box.extent}: no gamma is proved for the box: {self._why_not}", *self._cuts()]
        said = f"gamma = {self.gamma} is proved for every model of the box, one model or another at every step"
        return [f"within  {self.box.extent}: {said}; the worst found has {self.found:.6g}", *self._cuts()]

    def _cuts(self) -> list[str]:
        return [f"        {remark}" for remark in self.box.remarks()]

    @property
    def _why_not(self) -> str:
        if not math.isfinite(self.found):
            return "a model in it is not mean-square stable, as far as floats tell"
        if self.verdict is None:
            return "no P was found that satisfies (17) at every corner and ends the recursion"
        return str(self.verdict.failure)


def robust(problem: Problem, K: LinkMatrices, H: LinkMatrices, box: Box) -> Robust:
    """The worst model that a search finds, and the least gamma for all: sought in floats, then proved."""
    upper, rows, gain = worst(problem, K, H, box)
    truth = truth_at(problem, box, upper, rows)
    values = [float((truth.beta if part.matrix == "beta" else truth.rho)[part.at]) for part in box.intervals]
    if not math.isfinite(gain):
        return Robust(box, gain, values, None)
    every = sorted(corners(problem, box), key=lambda corner: _differs(corner, truth))  # the worst first
    models = [ByFloats(problem, K, H, corner) for corner in every]
    nominal = error_model_of(problem, problem.beta, *stacked_links(problem, K, H))
    P = invariant(ByVertices(models, np.zeros(0)), Operator(nominal).units)
    least = None if P is None else _sought(models, [_model(problem, K, H, truth), nominal], P, gain**2)
    if P is None or least is None:
        return Robust(box, gain, values, None)
    g, by = least
    for more in _CLAIMED:
        verdict = prove(by, problem.mode_names, math.sqrt(g) * (1.0 + more), P)
        if verdict.holds:
            break
    return Robust(box, gain, values, verdict)


def _sought(models: list[ByFloats], likely: list[ErrorModel], P: Array, low: float) -> tuple[float, ByVertices] | None:
    """The least g, and the weights that gave it, of those of each likely model; as far as floats tell."""
    least: tuple[float, ByVertices] | None = None
    for model in likely:
        for above in _ABOVE:
            weights = weights_of(model, above)
            if weights is None:
                continue
            by = ByVertices(models, weights)
            g = _least(by, P, low, None if least is None else least[0])
            least = least if g is None else (g, by)
    return least


def _differs(one: Truth, other: Truth) -> bool:
    return bool((one.beta != other.beta).any() or (one.rho != other.rho).any())


def _model(problem: Problem, K: LinkMatrices, H: LinkMatrices, truth: Truth) -> ErrorModel:
    """Its error model in floats."""
    return error_model_of(problem_at(problem, truth), problem.beta, *stacked_links(problem, K, H))


def problem_at(problem: Problem, truth: Truth) -> Problem:
    """The problem whose file says the truth. Probabilities of 0 or 1 are nearly that: a file has none of the former."""
    document = problem.document()
    for j, node in enumerate(document["node"]):
        node["arrival_probability"] = truth.beta[j] if truth.beta[j] == problem.beta[j] else _inside(truth.beta[j])
    for link in document.get("link", []):
        at = problem.node_index(link["receiver"]), problem.node_index(link["sender"])
        link["delivery_probability"] = max(float(truth.rho[at]), _inside(0.0))
    document["markov"]["transition"] = [[float(pi) for pi in row] for row in truth.transition]
    return Problem.from_document(document)


def _inside(probability: float) -> float:
    return min(max(float(probability), float(np.finfo(float).tiny)), 1.0 - 2.0**-53)


def worst(problem: Problem, K: LinkMatrices, H: LinkMatrices, box: Box) -> tuple[list[bool], list[int], float]:
    """A corner that no change of a single probability, or row, makes worse; and its exact gain."""
    choices = [2] * len(box.intervals) + [len(rows) for rows in box.rows]
    split = len(box.intervals)

    def gain_at(at: list[int]) -> float:
        truth = truth_at(problem, box, [bool(k) for k in at[:split]], at[split:])
        gain = exact_gain(_model(problem, K, H, truth), width=_WIDTH)
        return gain.low if gain.stable else math.inf

    at = [0] * len(choices)
    most = gain_at(at)
    for _ in range(_ROUNDS):
        before = list(at)
        for place, number in enumerate(choices):
            for k in range(number):
                tried = [*at[:place], k, *at[place + 1 :]]
                gain = gain_at(tried) if k != at[place] and math.isfinite(most) else 0.0
                if gain > most:
                    at, most = tried, gain
        if at == before:
            break
    return [bool(k) for k in at[:split]], at[split:], most


@np.errstate(all="ignore")  # what overflows is no P
def invariant(by: ByVertices, units: Array) -> Array | None:
    """P with (17) at every corner, as far as floats tell: of the mean of the corners, and of more than that."""
    n, modes = by.order, by.corners[0].model.modes
    for more in _MORE:
        found = decay(lambda Y, more=more: (1.0 + more) * by.of(Y).mean(axis=0)[:, :n, :n], modes, units)  # type: ignore[misc]
        if found.total is None or not found.dies_out:
            return None
        Z, every = found.total, by.of(found.total)
        rests = [Z - S[:, :n, :n] for S in every]
        if all(is_positive(rest) for rest in rests):
            multiples = [scaled(lambda _, S=S: S, Z, rest) for S, rest in zip(every, rests, strict=True)]  # type: ignore[misc]
            return min(multiples, key=lambda P: float(np.trace(P, axis1=1, axis2=2).sum()))
    return None


def weights_of(model: ErrorModel, above: float) -> Array | None:
    """What [eta; w] is like, step by step from the last, while the worst w acts; (T, modes, n_eta + nw, the same)."""
    operator = Operator(model)
    swept = sweep(operator, exact_gain(model, width=_WIDTH).high ** 2 * (1.0 + above), _HORIZON)
    if swept is None:
        return None
    n, modes = operator.size, len(operator.MM)
    X, joint = np.zeros((modes, n, n)), np.zeros((_HORIZON, modes, n + operator.nw, n + operator.nw))
    for k in range(_HORIZON - 1, -1, -1):
        GX = swept.Gamma[k] @ X
        joint[k, :, :n, :n], joint[k, :, n:, :n], joint[k, :, :n, n:] = X, GX, GX.swapaxes(1, 2)
        joint[k, :, n:, n:] = GX @ swept.Gamma[k].swapaxes(1, 2) + swept.W_inverse[k] / np.abs(swept.W_inverse).max()
        X = operator.carry(joint[k])
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
def ends(by: ByVertices, P: Array, g: float) -> bool:
    Y, n = by.corners[0].start(up=True), by.order
    for steps in range(_MOST_STEPS):
        Z = by.upper(Y, steps)
        W, cross = g * np.eye(Z.shape[1] - n) - Z[:, n:, n:], Z[:, n:, :n]
        if not (np.isfinite(Z).all() and is_positive(W)):
            return False
        Y = Z[:, :n, :n] + cross.swapaxes(1, 2) @ np.linalg.solve(W, cross)
        if is_positive(g * P - Y):
            return True
    return False
