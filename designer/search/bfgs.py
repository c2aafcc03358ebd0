"""BFGS with the weak Wolfe line search of Lewis and Overton, which also suits functions that are not smooth.

A. S. Lewis and M. L. Overton, "Nonsmooth optimization via quasi-Newton methods", Mathematical Programming 141, 2013.
The function may be infinite; the search then stays where it is finite.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from agent.contract.arrays import Array

Function = Callable[[Array], tuple[float, Array]]  # value and gradient


class Point(NamedTuple):
    """Where the search stands."""

    x: Array
    value: float
    gradient: Array
    inverse_hessian: Array


def start(function: Function, x: Array, inverse_hessian: Array) -> Point:
    """The first point."""
    return Point(x, *function(x), inverse_hessian)


def step(function: Function, point: Point) -> Point | None:
    """One step downhill and the update of the inverse Hessian; None where no step goes down any more."""
    H, gradient = point.inverse_hessian, point.gradient
    direction = -(H @ gradient)
    slope = float(direction @ gradient)
    if not slope < 0.0:
        return None
    found = _weak_wolfe(function, point, direction, slope)
    if found is None:
        return None
    t, value, gradient_next = found
    s, y = t * direction, gradient_next - gradient
    sy = float(s @ y)
    if sy > 0.0:
        Hy = H @ y
        u = s / sy
        H = H - np.outer(u, Hy) - np.outer(Hy, u) + (1.0 + float(y @ Hy) / sy) * np.outer(u, s)
    return Point(point.x + s, value, gradient_next, H)


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
