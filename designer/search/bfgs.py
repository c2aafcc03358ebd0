"""L-BFGS with the weak Wolfe line search of Lewis and Overton, which also suits functions that are not smooth.

A. S. Lewis and M. L. Overton, "Nonsmooth optimization via quasi-Newton methods", Mathematical Programming 141, 2013;
the two loops are those of J. Nocedal, "Updating quasi-Newton matrices with limited storage", Mathematics of Computation
35, 1980. The function may be infinite; the search then stays where it is finite.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from agent.contract.arrays import Array

Function = Callable[[Array], tuple[float, Array]]  # value and gradient
Map = Callable[[Array], Array]  # a symmetric positive matrix times a vector

_PAIRS = 100
PATIENCE = 10
_MOST_STEPS = 300


class Pair(NamedTuple):
    """A step and how the gradient changed along it."""

    s: Array
    y: Array
    sy: float
    scale: float  # s'y / y'(first y)


class Point(NamedTuple):
    """Where the search stands."""

    x: Array
    value: float
    gradient: Array
    first: Map  # an inverse Hessian to begin with
    scale: float  # of `first`: the largest s'y / y'(first y); the last one may be far too small at a kink
    pairs: tuple[Pair, ...]  # the oldest first


def start(function: Function, x: Array, first: Map) -> Point:
    """The first point."""
    return Point(x, *function(x), first, 1.0, ())


def minimise(function: Function, x: Array, first: Map, advance: Callable[[Point], None], *, enough: float) -> Point:
    """Steps until the last few together gain less than `enough`; `advance` is told of each."""
    point = start(function, x, first)
    values = [point.value]
    while len(values) < _MOST_STEPS:
        following = step(function, point)
        if following is None:
            break
        point = following
        values.append(point.value)
        advance(point)
        if len(values) > PATIENCE and values[-1 - PATIENCE] - values[-1] < enough:
            break
    return point


def step(function: Function, point: Point) -> Point | None:
    """One step downhill; None where no step goes down any more, not even by the first inverse Hessian alone."""
    direction = _direction(point)
    slope = float(direction @ point.gradient)
    found = _weak_wolfe(function, point, direction, slope) if slope < 0.0 else None
    if found is None:
        return step(function, point._replace(pairs=(), scale=1.0)) if point.pairs else None
    t, value, gradient = found
    s, y, scale, pairs = t * direction, gradient - point.gradient, point.scale, point.pairs
    sy = float(s @ y)
    if sy > 0.0:
        pairs = (*pairs[1 - _PAIRS :], Pair(s, y, sy, sy / float(y @ point.first(y))))
        scale = max(pair.scale for pair in pairs)
    return Point(point.x + s, value, gradient, point.first, scale, pairs)


def _direction(point: Point) -> Array:
    """Minus the inverse Hessian times the gradient, by two loops over the pairs."""
    q, shares = point.gradient.copy(), []
    for s, y, sy, _ in reversed(point.pairs):
        share = float(s @ q) / sy
        shares.append(share)
        q -= share * y
    q = point.scale * point.first(q)
    for (s, y, sy, _), share in zip(point.pairs, reversed(shares), strict=True):
        q += (share - float(y @ q) / sy) * s
    return np.negative(q)


def _weak_wolfe(function: Function, point: Point, direction: Array, slope: float) -> tuple[float, float, Array] | None:
    """t, value and gradient there: enough descent (1e-4), and a slope that has risen to half of the first."""
    low, high, t = 0.0, math.inf, 1.0
    best: tuple[float, float, Array] | None = None
    for _ in range(40):
        value, gradient = function(point.x + t * direction)
        if not value < point.value + 1e-4 * t * slope:
            high = t
        elif float(gradient @ direction) < 0.5 * slope:
            low, best = t, (t, value, gradient)
        else:
            return t, value, gradient
        t = (low + high) / 2.0 if high < math.inf else 2.0 * low
    return best
