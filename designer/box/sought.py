"""The least gamma that a proof for a box may have, in floats: weights to begin with, and rounds to better ones.

docs/theory.md, section 13. Nothing is proved here; what a proof takes is found.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from agent.contract.arrays import Array
from designer.box.passes import step
from designer.box.tail import invariant
from designer.box.weights import Recipe, Round, mixed, moved, starts
from designer.decay import is_positive
from designer.gain.exact import Operator
from designer.model.error_model import ErrorModel
from designer.patience import Over, never
from designer.proof.by_vertices import ByVertices
from designer.proof.cube import Cube

_MOST_STEPS = 2000
_CLOSE = 1e-4  # relative width of the search for g
_FAR = 100.0  # times the worst that was found: nothing is sought beyond
_SHARE, _LEAST_SHARE = 0.4, 0.1  # how far the first round of the weights goes, and the last
_BEYOND = (0.02, 0.02, 0.01, 0.01, 0.005, 0.005, 0.002, 0.002)  # g of every round, beyond the least


class Least(NamedTuple):
    """The least g that was found, what a proof of it takes, and how that was made."""

    g: float
    by: ByVertices
    P: Array
    recipe: Recipe


def begun(models: list[Cube], likely: list[ErrorModel]) -> Iterator[tuple[ByVertices, Array]]:
    """The weights to begin with, and P; none where no P is found."""
    tail: tuple[Array, Array] | None = None
    spreads = models[0].spreads
    for weights in starts(likely, spreads=spreads):
        tail = tail or invariant(ByVertices(models, weights), Operator(likely[-1]))
        if tail is None:
            return
        P, X = tail
        yield ByVertices(models, mixed(weights, X) if spreads else weights, X), P


def sought(
    models: list[Cube], likely: list[ErrorModel], low: float, *, enough: float = 0.0, over: Over = never
) -> Least | None:
    """From the best of the weights to begin with, where entries are off, to better ones; as far as floats tell.

    `low`: no less is looked for. `enough`: where this g is reached the search ends; nothing else is asked. Where it is
    `over`, the least so far, if there is one.
    """
    least: Least | None = None
    for start, (by, P) in enumerate(begun(models, likely)):
        if least is not None and over():
            break
        if enough and ends(by, P, enough):
            return Least(enough, by, P, Recipe(start, ()))
        if enough and not by.corners[0].spreads:  # no rounds follow, for which the least would be worth its time
            continue
        g = _less(by, P, low, None if least is None else least.g, over)
        if g is not None:
            least = Least(g, by, P, Recipe(start, ()))
    if least is None:
        return None
    share, units = _SHARE, Operator(likely[-1]).units
    for beyond in _BEYOND[:: 1 if len(models) == 1 else 2] if models[0].spreads else ():
        if over():
            break
        to = Round(math.sqrt(least.g * (1.0 + beyond)), share)
        weights = moved(least.by, units, to)
        if weights is None:
            break
        by = ByVertices(models, weights, least.by.mean)
        if enough and ends(by, least.P, enough):
            return Least(enough, by, least.P, least.recipe._replace(rounds=(*least.recipe.rounds, to)))
        g = _less(by, least.P, low, least.g, over)
        if g is None:
            share /= 2.0
            if share < _LEAST_SHARE:
                break
        else:
            share = min(1.5 * share, 1.0)
            least = Least(g, by, least.P, least.recipe._replace(rounds=(*least.recipe.rounds, to)))
    return least


def _less(by: ByVertices, P: Array, low: float, best: float | None, over: Over) -> float | None:
    """The least g at which the recursion comes to Y < g P, as far as floats tell; None: not below `best`.

    Where it is `over`, the least so far.
    """
    high = low * 1.005 if best is None else best * (1.0 - 2.0 * _CLOSE)
    while not ends(by, P, high, over=never if best is None else over):
        if best is not None or high > _FAR * low:
            return None
        low, high = high, low + 2.5 * (high - low)
    fall = 2.0 * _CLOSE
    while (lower := high * (1.0 - fall)) > low and ends(by, P, lower, over=over):
        high, fall = lower, 3.0 * fall
    low = max(low, lower)
    while high > low * (1.0 + _CLOSE):
        middle = math.sqrt(low * high)
        low, high = (low, middle) if ends(by, P, middle, over=over) else (middle, high)
    return high


@np.errstate(all="ignore")  # what overflows does not end
def ends(by: ByVertices, P: Array, g: float, most: int = _MOST_STEPS, over: Over = never) -> bool:
    """Whether the recursion at g comes to Y < g P, as far as floats tell, before it is `over`."""
    Y = by.corners[0].ended(by.mean)
    for steps in range(most):
        if over():
            return False
        taken = step(by.upper(Y, steps), by.order, g)
        if taken is None:
            return False
        Y = taken.Y
        if is_positive(g * P - Y):
            return True
    return False
