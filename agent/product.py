"""A matrix times a vector with its sums in a stated order: the same bits on every machine, and in a loop in C."""

from __future__ import annotations

import numpy as np

from agent.contract.arrays import Array


def product(matrix: Array, vector: Array) -> Array:
    """`matrix @ vector`, (rows,): every row is multiplied out, and then summed from left to right.

    BLAS (numpy's `@`) orders and fuses these sums by processor. Here products and sums are operations of their own,
    each rounded once by IEEE 754, so no processor has a choice.
    """
    with np.errstate(over="ignore", invalid="ignore"):  # as `@`; what is not finite is refused where it is told
        return np.asarray(np.add.accumulate(matrix * vector, axis=1)[:, -1])
