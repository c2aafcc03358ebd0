"""What a replay finds at every step, for a report: the verdict has the worst alone."""

from __future__ import annotations

import numpy as np

from agent.contract.arrays import Array
from designer.replay.proofs import Check


class Trace:
    """Filled while a log is judged; NaN where nothing was compared, or nothing is known."""

    def __init__(self, steps: int) -> None:
        self.gaps = {proof: np.full(steps, np.nan) for proof in (1, 2, 3)}  # the largest of each proof, (steps,)
        self.path_bound: Array = np.full(steps, np.nan)  # gamma_path(k) sqrt(energy_before), and path_start, (steps,)
        self.path_start: Array = np.full(steps, np.nan)  # |z~(k)| that x(0) alone leaves in this run, (steps,)
        self.energy_before: Array = np.full(steps, np.nan)  # sum over j < k of |w(j)|^2, (steps,)

    def add(self, check: Check) -> None:
        """The gaps of one comparison; where two concern the same step the larger one stays."""
        of_proof = self.gaps[check.proof][check.first : check.first + len(check.gap)]
        np.fmax(of_proof, np.fmax.reduce(check.gap, axis=1), out=of_proof)
