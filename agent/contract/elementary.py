"""exp, log, sin and cos by operations that IEEE 754 rounds in one way: the same bits on every machine.

Those of mathematics libraries and of numpy differ between processors in their last bit. These reduce their argument
exactly and sum a series by Horner's rule; multiplication and addition are operations of their own, never fused.
Errors are below 3 units in the last place.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from agent.contract.arrays import Array

_LN2 = [float.fromhex(part) for part in ("0x1.62e42feep-1", "0x1.a39ef35793c76p-33")]  # 32 bits, and the rest
_HALF_PI = [  # 33 bits, the next 33, and the rest
    float.fromhex(part) for part in ("0x1.921fb544p0", "0x1.0b4611a6p-34", "0x1.3198a2e037073p-69")
]
_EXP = [1.0 / math.factorial(n) for n in range(14)]
_ATANH = [1.0 / (2 * n + 1) for n in range(12)]
_SIN = [(-1) ** n / math.factorial(2 * n + 1) for n in range(9)]
_COS = [(-1) ** n / math.factorial(2 * n) for n in range(10)]


def exp(x: ArrayLike) -> Array:
    """e^x elementwise, for x <= 700; 0 where it is too small for a float."""
    x = np.maximum(np.asarray(x, dtype=np.float64), -800.0)
    n = np.rint(x / (_LN2[0] + _LN2[1]))
    r = (x - n * _LN2[0]) - n * _LN2[1]
    return np.asarray(np.ldexp(_series(_EXP, r), n.astype(np.int64)))


def log(x: ArrayLike) -> Array:
    """The natural logarithm elementwise, for positive x that are not subnormal."""
    m, n = np.frexp(np.asarray(x, dtype=np.float64))
    small = m < math.sqrt(0.5)
    m, n = np.where(small, 2.0 * m, m), n - small
    s = (m - 1.0) / (m + 1.0)
    return np.asarray(n * _LN2[0] + (n * _LN2[1] + 2.0 * s * _series(_ATANH, s * s)))


def sin(x: ArrayLike) -> Array:
    """sin x elementwise, for |x| below a million."""
    x = np.asarray(x, dtype=np.float64)
    n = np.rint(x / (math.pi / 2.0))
    return _turned(((x - n * _HALF_PI[0]) - n * _HALF_PI[1]) - n * _HALF_PI[2], n.astype(np.int64) - 1)


def cos_of_turns(u: ArrayLike) -> Array:
    """cos(2 pi u) elementwise, for u in [0, 1)."""
    quarters = 4.0 * np.asarray(u, dtype=np.float64)
    n = np.rint(quarters)
    return _turned((quarters - n) * (math.pi / 2.0), n.astype(np.int64))


def _turned(r: Array, quarters: NDArray[np.int64]) -> Array:
    """cos(r + quarters pi / 2), |r| at most pi / 4."""
    z = r * r
    value = np.where(quarters % 2 == 1, -r * _series(_SIN, z), _series(_COS, z))
    return np.asarray(np.where(quarters % 4 >= 2, -value, value))


def _series(coefficients: list[float], x: Array) -> Array:
    """The sum of coefficients[n] x^n, by Horner's rule."""
    total = np.full_like(x, coefficients[-1])
    for coefficient in coefficients[-2::-1]:
        total *= x
        total += coefficient
    return total
