"""A whole run gone through with the ledger: what the bound says at its end, and where it said least."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from agent.contract.arrays import Array
from agent.contract.errors import counted
from agent.contract.gains import Gains
from agent.contract.problem import Problem
from designer.ledger.deviation import Deviation
from designer.ledger.exact import Ledger
from designer.ledger.promise import SHARE, Promise
from designer.model.error_model import initial_eta

Flags = NDArray[np.bool_]
_LOOKS = 24  # gains that are searched along a run with faults; a search takes up to a tenth of a second
_AS_IT_WAS = "the initial error, which is not known"


class Account(NamedTuple):
    """The promise at the last step, and at the worst of the steps that were looked at."""

    last: Promise
    steps: int  # of the run
    faulty: int  # steps with something that is not as designed
    worst: Promise | None  # None: nothing was faulty
    worst_step: int
    looked: int  # steps that were looked at

    @property
    def is_plain(self) -> bool:
        """From the first step to the last, the bound said what it says of any run."""
        return self.last.status == "valid" and not self.faulty

    @property
    def is_without_faults(self) -> bool:
        """The same, but for what the initial error leaves."""
        return self.last.status != "void" and not self.faulty

    def text(self) -> str:
        """In one line, for people."""
        if self.last.status == "void" or not self.faulty:
            return self.last.text()
        line = f"{self.last.text()} at the end; {counted(self.faulty, 'step')} with faults"
        if self.worst is None or self.worst.factor <= 1.0 + SHARE:
            return line
        worst = f"{self.worst.factor:.4g} times gamma"
        return f"{line}; at step {self.worst_step}, the worst of {self.looked} looked at, {worst}"

    def document(self) -> dict[str, Any]:
        """For --json."""
        last = self.last
        return {
            "status": last.status,
            "factor": last.factor if math.isfinite(last.factor) else None,
            "within": last.within,
            "owed": [owed._asdict() for owed in last.owed],
            "reason": last.reason,
            "step": last.step,
            "faulty": self.faulty,
            "worst_factor": self.worst.factor if self.worst and math.isfinite(self.worst.factor) else None,
            "worst_step": self.worst_step if self.worst else None,
            "looked": self.looked,
        }


def deviations(substituted: Flags, unmeasured: Flags, absent: Flags, origin: NDArray[np.int64]) -> dict[int, Deviation]:
    """The steps that were not as designed, from arrays.

    `substituted` (steps, n, n), row i for what node i did not use though neither mode nor model left it out;
    `unmeasured` and `absent` (steps, n); `origin` (steps, n) is -1 where a node goes on, else the node whose estimate
    it begins with, or n or more where it begins with 0.
    """
    n = unmeasured.shape[1]
    marked = substituted.any(axis=(1, 2)) | unmeasured.any(axis=1) | absent.any(axis=1) | (origin != -1).any(axis=1)
    found = {}
    for k in np.flatnonzero(marked).tolist():
        pairs = ((int(i), int(j)) for i, j in np.argwhere(substituted[k]) if i != j)
        begun = ((int(i), int(origin[k, i])) for i in np.flatnonzero(origin[k] != -1))
        found[k] = Deviation(
            substituted=frozenset(pairs),
            unmeasured=frozenset(np.flatnonzero(unmeasured[k]).tolist()),
            absent=frozenset(np.flatnonzero(absent[k]).tolist()),
            begun=frozenset((i, j if 0 <= j < n else None) for i, j in begun),
        )
    return found


class Beginning(NamedTuple):
    """What is there before anything has happened, for a ledger that stands at the first step."""

    covariance: Array  # (modes, n_eta, n_eta)
    what: str
    is_unit: bool

    def told(self, ledger: Ledger) -> None:
        ledger.jump(self.covariance, self.what, is_unit=self.is_unit)


def beginning(problem: Problem, *, unknown: bool) -> Beginning | None:
    """The initial error of the problem, or one that is `unknown`; None where there is none."""
    size = problem.plant_states + problem.n * problem.nx
    known, covariance = initial_eta(problem), np.zeros((len(problem.mode_names), size, size))
    if not unknown and not known.any():
        return None
    covariance[problem.mode_index(problem.markov.initial)] = np.eye(size) if unknown else np.outer(known, known)
    return Beginning(covariance, _AS_IT_WAS if unknown else "the initial error", unknown)


def account(
    gains: Gains,
    *,
    steps: int,
    faults: Mapping[int, Deviation],
    void: tuple[str, int] | None = None,
    starts_anywhere: bool = False,
) -> Account:
    """Go through a run of so many steps.

    `faults` maps steps to what happened in them; `void` is the first thing that the model cannot describe, and when;
    `starts_anywhere`: x(0) was not that of the estimates, as with a real plant.
    """
    if void is not None:
        promise = Promise("void", gains.certificate.gamma, math.inf, None, (), *void)
        return Account(promise, steps, len(faults), None, 0, 0)
    start = beginning(gains.problem, unknown=starts_anywhere)
    if not faults and start is None:
        return Account(Promise("valid", gains.certificate.gamma, 1.0, 0, (), "", None), steps, 0, None, 0, 0)
    ledger, looks = Ledger.of(gains), _looks(faults, steps)
    if start is not None:
        start.told(ledger)
    worst, worst_step = None, 0
    for k in range(steps):
        if k in faults:
            ledger.tell(faults[k])
        if k in looks:
            promise = ledger.promise()
            if worst is None or promise.factor > worst.factor:
                worst, worst_step = promise, k
        if k < steps - 1:
            ledger.step()
    return Account(ledger.promise(), steps, len(faults), worst, worst_step, len(looks))


def _looks(faults: Mapping[int, Deviation], steps: int) -> set[int]:
    """Steps to look at: where nodes begin again, and right after a stretch of faults; the last ones of too many."""
    begun = {k for k, deviation in faults.items() if deviation.begun}
    after = {k + 1 for k in faults if k + 1 not in faults and k + 1 < steps}
    return set(sorted(begun | after)[-_LOOKS:])
