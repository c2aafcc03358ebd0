"""The gain from the energy of w to that of all errors, and the P that attains it: for what holds of single runs.

Least g at which Y <- A'Y_bar A + (A'Y_bar B)W^-1(B'Y_bar A) + M'M stays bounded; E sum |z_tilde|^2 <= g E sum |w|^2.
Its limit Y lies above M'M and above what a step makes of it, so that P = Y / g satisfies (17), and (18)
with gamma^2 = g. The P that ends the recursion of the exact gain may satisfy (18) only with a gamma ten times as large.
"""

from __future__ import annotations

import math

import numpy as np

from agent.contract.arrays import Array
from designer.gain.exact import Operator, step

_STEPS = 3000  # in which the recursion is to settle
_SETTLED = 1e-9
_WIDTH = 1e-3  # of g
_STRICT = 1e-6  # so much of the largest entry of M'M, in natural units, is added everywhere: (17) is to be strict
_MOST = 1e6  # times the square of the exact gain


@np.errstate(over="ignore", invalid="ignore")
def energy_matrix(operator: Operator, gamma: float) -> Array | None:
    """P (modes, n_eta, n_eta), from gamma, the exact gain, upwards; None where no Y stays bounded."""
    low = gamma**2
    high, Y = low, _bounded(operator, low)
    while Y is None:
        low, high = high, 2.0 * high
        if high > _MOST * gamma**2:
            return None
        Y = _bounded(operator, high)
    while high > low * (1.0 + _WIDTH):
        middle = math.sqrt(low * high)
        found = _bounded(operator, middle)
        low, high, Y = (middle, high, Y) if found is None else (low, middle, found)
    return Y / high


def _bounded(operator: Operator, g: float) -> Array | None:
    """The limit of the recursion at g; None where there is none, or it is not reached."""
    both = np.outer(operator.units, operator.units)
    added = operator.MM + np.diag(operator.units**2) * (_STRICT * float(np.abs(operator.MM / both).max()))
    Y = added
    for _ in range(_STEPS):
        taken = step(operator, Y, g)
        if taken is None:
            return None
        following = taken.Y + added
        if np.abs((following - Y) / both).max() <= _SETTLED * np.abs(following / both).max():
            return following
        Y = following
    return None
