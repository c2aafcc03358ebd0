"""The cheap account, from P alone: three numbers for what acts in a step, one for what the error may be.

v bounds E eta'P eta, and E|z_tilde|^2 <= gamma_P^2 v. Looser than the exact account, and small enough for any device.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from agent.contract.arrays import Array
from agent.contract.problem import Problem
from designer.ledger.deviation import AS_DESIGNED, Acting, Deviation, Models


class Rates(NamedTuple):
    """E V(k+1) <= ((l E V)^(1/2) + (b |w|^2)^(1/2))^2 for V = eta'P eta."""

    l: float  # noqa: E741 -- the letter of docs/theory.md
    b: float
    is_17: bool  # (17) holds: E V(k+1) <= E V + |w|^2 as well


class Cheap:
    """Stepped with what happened and with the energy of w in the step, E|w(k)|^2 or a bound."""

    def __init__(self, problem: Problem, K_bar: Array, H_bar: Array, *, P: Array) -> None:
        self.v = 0.0
        self._models, self._P = Models(problem, K_bar, H_bar), P
        self._root_inverse = np.linalg.inv(np.linalg.cholesky(P))
        self._rates: dict[Deviation, Rates] = {}
        self._now = AS_DESIGNED

    def tell(self, deviation: Deviation) -> None:
        """What happens in this step. Raises Unabsorbed where no error model describes it."""
        acting = self._models.acting(deviation)
        if acting.J is not None:
            self.v *= self._against_P(acting.before(self._P))
        self._now = deviation

    def jump(self, size: float) -> None:
        """eta moves by delta: `size` bounds E delta'P delta."""
        self.v = (math.sqrt(self.v) + math.sqrt(size)) ** 2

    def step(self, energy: float) -> None:
        rates = self.rates(self._now)
        v = (math.sqrt(rates.l * self.v) + math.sqrt(rates.b * energy)) ** 2
        self.v = min(v, self.v + energy) if rates.is_17 else v
        self._now = AS_DESIGNED

    def bound(self) -> float:
        """Of (E|z_tilde|^2)^(1/2), over the nodes that are there."""
        return math.sqrt(max(self._against_P(self._models.acting(self._now).MM), 0.0) * self.v)

    def rates(self, deviation: Deviation) -> Rates:
        """The three numbers of what acts in the step, once nodes have begun."""
        if deviation not in self._rates:
            self._rates[deviation] = self._found(self._models.acting(deviation))
        return self._rates[deviation]

    def _found(self, acting: Acting) -> Rates:
        operator, n = acting.operator, acting.operator.size
        S = operator.joint(operator.bar(self._P))
        whole = np.zeros_like(S)
        whole[:, :n, :n], whole[:, n:, n:] = self._P, np.eye(operator.nw)
        is_17 = float(np.linalg.eigvalsh(whole - S).min()) >= 0.0
        return Rates(self._against_P(S[:, :n, :n]), float(np.linalg.eigvalsh(S[:, n:, n:]).max()), is_17)

    def _against_P(self, Y: Array) -> float:
        """The least c with Y <= c P in every mode."""
        relative = self._root_inverse @ Y @ self._root_inverse.swapaxes(1, 2)
        return float(np.linalg.eigvalsh((relative + relative.swapaxes(1, 2)) / 2.0).max())
