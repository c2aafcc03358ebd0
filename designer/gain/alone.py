"""Errors in which chance has no say, as where all nodes ignore all measurements: their gain by the gramian, in floats.

They are a linear system without multiplicative noise, whose l2 to l-infinity gain is known by its reachability Gramian:
gamma^2 is the largest eigenvalue of M G M', G the sum of all A^j B B' A'^j: designer.proof.by_gramian proves it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from agent.contract.arrays import Array
from designer.model.error_model import ErrorModel

_DOUBLINGS = 60
_SETTLED = 1e-12  # of A^T
_HUGE = 1e100
_WIDTH = 1e-9
_LEAST = 1e-150  # an error that is always 0 has a bound above that
_MOST_STEPS = 128
_LONG = np.longdouble  # what is squared some thirty times loses ten digits
_ROUNDING = float(np.finfo(_LONG).eps)


class Alone(NamedTuple):
    """eta+ = A eta + B w in every mode and whatever gets lost, and sums of A^j B B' A'^j; A^k goes to 0.

    Of all errors together, or, where each moves as the plant does, of one of them.
    """

    A: Array
    sums: list[Array]  # of 1, 2, 4, ... terms, until A^k has become nothing
    copies: int  # of what is in A: 1, or x and every e_i

    @classmethod
    def of(cls, model: ErrorModel) -> Alone | None:
        """None where chance or the mode has a say, or floats do not see that A^k goes to 0."""
        lost = model.H[:, :, model.alpha[model.owner] > 0.0]
        if lost.any() or (model.links is not None and model.links.V.any()):
            return None
        A, B = model.A[0], model.B[0]
        if (model.A != A).any() or (model.B != B).any():
            return None
        nx = model.H.shape[1] // len(model.rows)
        copies = model.size // nx
        if np.array_equal(A, np.kron(np.eye(copies), A[:nx, :nx])) and np.array_equal(B, np.tile(B[:nx], (copies, 1))):
            A, B = A[:nx, :nx], B[:nx]
        power, B = A.astype(_LONG), B.astype(_LONG)
        sums = [B @ B.T]
        for _ in range(_DOUBLINGS):
            if np.abs(power).max() < _SETTLED:
                return cls(A, sums, model.size // len(A))
            sums.append(sums[-1] + power @ sums[-1] @ power.T)
            power = power @ power
            if not np.abs(power).max() < _HUGE:
                break
        return None

    @property
    def radius(self) -> float:
        """What E|eta|^2 is multiplied by in each step, in the long run."""
        return float(np.abs(np.linalg.eigvals(self.A)).max()) ** 2

    def gain(self, M: Array) -> tuple[float, float]:
        """The gain to M eta, M (any, n_eta), between two numbers that allow for the rounding of all these steps."""
        off = _WIDTH + _ROUNDING * 2.0 ** len(self.sums)
        gamma = self._gain_of(self.sums[-1], M)
        return gamma * (1.0 - off), max(gamma * (1.0 + off), _LEAST)

    def horizon(self, M: Array) -> int:
        """A number of steps after which the gain is not far below that; no more than anybody would look at."""
        low, _ = self.gain(M)
        return next(
            (2**k for k, total in enumerate(self.sums) if 2**k == _MOST_STEPS or self._gain_of(total, M) >= low), 1
        )

    def _gain_of(self, total: Array, M: Array) -> float:
        folded = M.astype(_LONG).reshape(len(M), self.copies, -1).sum(axis=1)
        weighed = (folded @ (total + total.T) @ folded.T / 2.0).astype(np.float64)
        largest = float(np.linalg.eigvalsh(weighed).max()) if np.isfinite(weighed).all() else math.inf
        return math.sqrt(max(largest, 0.0))
