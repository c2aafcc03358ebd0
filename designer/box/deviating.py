"""The worst entries of a box that are found, of a constant model: what the gain gains by each.

S(Y) of a model whose entries are off by D is S_0 + a D + D'a' + D'Q D (`designer.proof.cube`), so its derivative by D
is 2 (a' + D'Q) X for what [eta; w] is like, X. All signs follow it at once, again and again: each D meets X alone, and
in each S(Y) is convex.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from agent.contract.arrays import Array
from designer.box.passes import Steps, back, forth
from designer.proof.cube import Cube

_HORIZON = 60  # steps
_WIDTH = 5e-4  # of gamma^2, at which signs are compared
_ABOVE = 0.01  # gamma^2 of the weights above that
_ROUNDS = 8
_TURNS, _FEW_ENTRIES = 3, 100  # of single signs, which take a recursion each
_FAR = 1e8  # times gamma^2 of before: no gain


class Deviating(NamedTuple):
    """What the entries are off by, and what gamma is at least."""

    low: float  # over so many steps, as far as floats tell
    D: Array  # (k, m)
    of_M: Array  # (nz, n_eta)

    def signs(self, cube: Cube) -> tuple[int, ...]:
        """Of every entry."""
        every = zip(cube.entries, cube.deviations.places, strict=True)
        return tuple(int(np.sign((self.of_M if entry.matrix == "M" else self.D)[place])) for entry, place in every)


def worst_constant(cube: Cube, low: float) -> Deviating:
    """All signs along the slope, then each alone, and so on; `low` is about the gain without deviations."""
    best = ascended(cube, low)
    for _ in range(_TURNS if len(cube.entries) <= _FEW_ENTRIES else 0):
        tried = _flipped(cube, best)
        if not tried.low > best.low:
            break
        following = ascended(cube, tried.low, tried)
        best = following if following.low > tried.low else tried
    return best


def _flipped(cube: Cube, at: Deviating) -> Deviating:
    """The same or more, by the signs of single entries."""
    for entry, place in zip(cube.entries, cube.deviations.places, strict=True):
        if not math.isfinite(at.low):
            break
        tried = at._replace(D=at.D.copy(), of_M=at.of_M.copy())
        of_letter = tried.of_M if entry.matrix == "M" else tried.D
        of_letter[place] *= -1.0
        g = at.low**2 * (1.0 + _WIDTH)
        if _recursion(cube, tried, g) is None:
            at = tried._replace(low=math.sqrt(_least(cube, tried, g)))
    return at


def ascended(cube: Cube, low: float, start: Deviating | None = None) -> Deviating:
    """The worst that is met on the way from `start`, or from no deviation; `low` is about gamma there."""
    radii, most = cube.deviations.radii, cube.deviations.of_M
    best = at = start or Deviating(0.0, np.zeros_like(radii), np.zeros_like(most))
    for _ in range(_ROUNDS):
        g = _least(cube, at, max(low, best.low) ** 2)
        if not math.isfinite(g):
            return at._replace(low=math.inf)
        if g > best.low**2:
            best = at._replace(low=math.sqrt(g))
        slopes = _slopes(cube, at, g * (1.0 + _WIDTH + _ABOVE))
        if slopes is None:
            break
        by_D, by_M = slopes
        D, of_M = (size * np.where(by > 0.0, 1.0, -1.0) for size, by in ((radii, by_D), (most, by_M)))
        if (D == at.D).all() and (of_M == at.of_M).all():
            break
        at = Deviating(0.0, D, of_M)
    return best


def _least(cube: Cube, at: Deviating, g: float) -> float:
    """The largest g, known to _WIDTH, at which the recursion fails, as far as floats tell; `g` is about that."""
    low = high = g
    while _recursion(cube, at, high) is None:
        low, high = high, 1.1 * high
        if not high < _FAR * g:
            return math.inf
    while low == high or _recursion(cube, at, low) is not None:
        low, high = low / 1.1, low
    while high > low * (1.0 + _WIDTH):
        middle = math.sqrt(low * high)
        low, high = (middle, high) if _recursion(cube, at, middle) is None else (low, middle)
    return low


def _recursion(cube: Cube, at: Deviating, g: float) -> Steps | None:
    Y = np.tile(cube.peak_parts().at(at.of_M), (cube.model.modes, 1, 1))
    return back(lambda Y, steps: cube.parts(Y).at(at.D), Y, g, _HORIZON)


def _slopes(cube: Cube, at: Deviating, g: float) -> tuple[Array, Array] | None:
    """Up to a factor the derivative of gamma by D and by what M is off; None: floats do not see that g is enough."""
    passed = _recursion(cube, at, g)
    if passed is None:
        return None
    joint, X = forth(passed.Gamma, passed.W_inverse, lambda joint, k: cube.carried(joint, at.D))
    of_steps = [cube.parts(Y).slope(at.D, joint_k) for Y, joint_k in zip(passed.Y, joint, strict=True)]
    return np.array(of_steps).sum(axis=(0, 1)), cube.peak_parts().slope(at.of_M, X.sum(axis=0))
