"""The worst constant model of a box that a search finds, and its error model: in floats, a gain that the box has."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from agent.contract.arrays import Array
from agent.contract.gains import LinkMatrices
from agent.contract.problem import Problem
from agent.contract.problem.matrices import matrices_of
from designer.box.deviating import worst_constant
from designer.box.extent import Box, truth_at
from designer.coordinates import There
from designer.gain.exact import exact_gain
from designer.model.error_model import ErrorModel, stacked_links
from designer.model.mismatch import Real, real_error_model
from designer.patience import Over, never
from designer.proof.ball_model import Truth, told
from designer.proof.cube import Cube

_WIDTH, _CLOSE = 1e-5, 1e-6  # of gamma^2: models are compared by the one, and the worst is told by the other
_ROUNDS = 3
_TURNS = 2  # probabilities and entries, each for the others


class Worst(NamedTuple):
    """A corner that no change of a single probability or row makes worse, nor a step along the slope of the entries.

    `ends`, `rows` and `signs` are those of `designer.box.extent.truth_at`, which gives `truth` for them.
    """

    truth: Truth
    gain: float  # exact; infinite: not mean-square stable
    ends: tuple[bool, ...]
    rows: tuple[int, ...]
    signs: tuple[int, ...]

    def document(self) -> dict[str, Any]:
        """The model, for --json: nodes and modes in the order of the problem; matrices, where entries may be off."""
        truth = self.truth
        said = {"arrival": truth.beta, "delivery": truth.rho, "transition": real_transition(truth)}
        if truth.matrices is not None:
            said |= {letter: getattr(truth.matrices, letter) for letter in "ABM"}
        found: dict[str, Any] = {name: numbers.tolist() for name, numbers in said.items()}
        if truth.matrices is not None:
            found |= {letter: [of.tolist() for of in getattr(truth.matrices, letter)] for letter in "CD"}
        return found


def there_of(problem: Problem, K: LinkMatrices, H: LinkMatrices, box: Box) -> There:
    """All as it was where entries but those of D may be off: what is one among the states is none of T x."""
    return There(problem, K, H, None) if box.meets_states else There.of(problem, K, H)


def model_of(there: There, truth: Truth) -> ErrorModel:
    """Of [T x; T e], where of the matrices nothing but D is off; else as it was."""
    if there.T is not None and truth.matrices is not None:
        truth = truth._replace(matrices=matrices_of(there.problem)._replace(D=truth.matrices.D))
    return real_model(there.problem, there.K, there.H, truth)


def real_model(problem: Problem, K: LinkMatrices, H: LinkMatrices, truth: Truth) -> ErrorModel:
    """Its error model in floats, with filters as the problem has them."""
    carry = truth.carry or problem.carries_plant
    return real_error_model(problem, problem.beta, real(problem, truth), *stacked_links(problem, K, H), carry=carry)


def real(problem: Problem, truth: Truth) -> Real:
    """The same in floats."""
    return Real(truth.beta, truth.rho, real_transition(truth), truth.matrices or matrices_of(problem))


def real_transition(truth: Truth) -> Array:
    """Pi in floats."""
    return np.array([[float(pi) for pi in row] for row in truth.transition])


def _ascent(
    gain_at: Callable[[list[int]], float], at: list[int], most: float, choices: list[list[int]], over: Over
) -> tuple[list[int], float]:
    """One change after the other, as long as one makes it worse."""
    for _ in range(_ROUNDS):
        before = list(at)
        for place, options in enumerate(choices):
            for k in options:
                if k == at[place] or not math.isfinite(most):
                    continue
                if over():
                    return at, most
                tried = [*at[:place], k, *at[place + 1 :]]
                gain = gain_at(tried)
                if gain > most:
                    at, most = tried, gain
        if at == before:
            break
    return at, most


def worst(problem: Problem, K: LinkMatrices, H: LinkMatrices, box: Box, over: Over = never) -> Worst:
    """Probabilities and rows first, with the matrices of the file; then all entries at once; then both again.

    Where it is `over`, the worst of those that were looked at.
    """
    split, last = len(box.intervals), len(box.intervals) + len(box.rows)
    choices: list[list[int]] = [[0, 1]] * split + [list(range(len(rows))) for rows in box.rows]
    choices += [[-1, 1]] * len(box.entries)
    there = there_of(problem, K, H, box)

    def truth(at: list[int]) -> Truth:
        return truth_at(problem, box, [bool(k) for k in at[:split]], at[split:last], at[last:])

    def gain_at(at: list[int]) -> float:
        return _gain(there, truth(at))

    at = [0] * len(choices)
    at, most = _ascent(gain_at, at, gain_at(at), choices[:last], over)
    for _ in range(_TURNS if any(len(options) > 1 for options in choices[:last]) else 1):
        if not (box.entries and math.isfinite(most)) or over():
            break
        cube = Cube(problem, K, H, truth_at(problem, box, *_corner(at, split, last)), box.entries, there.T)
        tried = at[:last] + list(worst_constant(cube, most).signs(cube))
        gain = gain_at(tried)
        if not gain > most:
            break
        at, most = _ascent(gain_at, tried, gain, choices[:last], over)
    nominal = told(problem)._replace(carry=box.carry)  # which the box holds too
    most = max(_gain(there, model, width=_CLOSE) for model in (truth(at), nominal)) if math.isfinite(most) else most
    return Worst(truth(at), most, *_corner(at, split, last), tuple(at[last:]))


def gain_of(problem: Problem, K: LinkMatrices, H: LinkMatrices, box: Box, truth: Truth) -> float:
    """The exact gain of one model, from below; infinite: not mean-square stable."""
    return _gain(there_of(problem, K, H, box), truth)


def _gain(there: There, truth: Truth, *, width: float = _WIDTH) -> float:
    gain = exact_gain(model_of(there, truth), width=width)
    return gain.low if gain.stable else math.inf


def _corner(at: list[int], split: int, last: int) -> tuple[tuple[bool, ...], tuple[int, ...]]:
    return tuple(bool(k) for k in at[:split]), tuple(at[split:last])
