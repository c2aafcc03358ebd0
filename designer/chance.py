"""What single runs keep with a probability, by the P of a certificate; docs/theory.md, section 7."""

from __future__ import annotations

from decimal import ROUND_CEILING, Context
from typing import Any, NamedTuple

import numpy as np

from agent.contract.gains import Gains
from agent.contract.problem.disturbance import White
from designer.single_run import single_run
from designer.start import value_of

CONFIDENCE = 0.95  # of the bound that single runs keep
_UP = Context(prec=4, rounding=ROUND_CEILING)
_ROUNDED = 1.0 + 2.0**-30  # outweighs the rounding of a sum of 2^20 squares, and of all else here


class Chance(NamedTuple):
    """P(sup_k |z_tilde(k)| >= c) <= gamma^2 (E sum |w|^2 + V) / c^2."""

    gamma: float  # of a P with (17) and (18) of Theorem 1
    energy: float  # E sum |w|^2, and V = eta(0)'P eta(0)

    def level(self, confidence: float = CONFIDENCE) -> float:
        """The c below which |z_tilde| stays at every step of a run with this probability at least."""
        return float(self.gamma * np.sqrt(self.energy / (1.0 - confidence)) * _ROUNDED)

    def text(self) -> str:
        """For people."""
        return (
            f"one run      |z~| stays below {_UP.create_decimal(self.level()):g} at every step with probability "
            f"{CONFIDENCE:.0%} at least, proved by (17) and (18)"
        )

    def document(self) -> dict[str, Any]:
        """For --json."""
        return {"probability": CONFIDENCE, "bound": self.level(), "gamma_P": self.gamma}


def chance(gains: Gains, *, steps: int, energy: float) -> Chance | None:
    """Of runs with these gains; `energy` is sum |w|^2, of which white noise has a mean. None where there is no P."""
    known, disturbance = single_run(gains), gains.problem.disturbance
    if known is None:
        return None
    if isinstance(disturbance, White):
        energy = steps * gains.problem.nw * disturbance.deviation**2
    gamma, P, T = known
    return Chance(gamma, energy + value_of(gains.problem, P, T))
