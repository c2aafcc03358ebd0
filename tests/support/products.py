"""Products of matrices that are as inexact as docs/theory.md lets them be."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from agent.contract.arrays import Array
from designer.proof import float64

Product = Callable[[Any, Any], Array]
honest: Product = float64.product


def worst(seed: int) -> Product:
    """Every entry is off by 0.9 m u of the sum of sizes, to either side: m roundings for m terms that are not 0."""
    rng = np.random.default_rng(seed)

    def product(A: Any, B: Any) -> Array:
        computed = honest(A, B)
        sizes, terms = honest(abs(A), np.abs(B)), honest(abs(A) != 0, (B != 0).astype(float))
        return np.asarray(computed + rng.choice([-1.0, 1.0], size=computed.shape) * 0.9 * terms * float64.U * sizes)

    return product
