"""What a report tells of a run, in numbers: one place for the page, the figures and the tables."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from agent.contract.arrays import Array
from agent.contract.errors import RunBroken
from designer.beyond_gamma import BeyondGamma, beyond_gamma
from designer.ladder import ladder_of
from designer.replay import Report, judge
from designer.replay.log import Log, load
from designer.replay.trace import Trace
from designer.replay.verdict import Verdict

SETTLED = 0.01  # of the largest value: what stays below it to the end need not be seen
MOST_OF_A_RUN = 0.8  # a part of it is worth a picture of its own only where it is shorter than that
THIS_RUN = "this run: largest error / root of the energy"


@dataclass(frozen=True, eq=False)
class Account:
    """A run, the verdict on it, and what both come to."""

    log: Log
    verdict: Verdict
    trace: Trace
    paths: tuple[Path, ...]  # the files

    @classmethod
    def of(
        cls, *paths: Path, run: str | None = None, gains: Path | None = None, report: Report | None = None
    ) -> Account:
        """Read and judge a recording, or the parts of one; `run`, `gains` and `report` as in `replay`.

        Raises InputError for what is no recording, RunBroken where it holds no step.
        """
        tell = report or (lambda what, done, of: None)
        log = load(paths, run=run, gains=gains, report=lambda done, of: tell("reading", done, of))
        if not log.steps:
            raise RunBroken(f"{log.label} holds no step of its run, so there is nothing to report")
        trace = Trace(log.steps)
        return cls(log, judge(log, trace, report=report), trace, paths)

    @cached_property
    def errors(self) -> Array:
        """z - z_hat_i, (steps, n, nz); where the plant is not known, each node's distance from their median."""
        z_hat = self.log.z_hat.reshape(self.log.steps, self.log.gains.problem.n, -1)
        if self.log.has_plant:
            return np.asarray(self.log.z[:, None, :] - z_hat)
        return np.asarray(z_hat - over_nodes(np.nanmedian, z_hat)[:, None, :])

    @cached_property
    def sizes(self) -> Array:
        """The norm of `errors` of each node, (steps, n)."""
        return np.asarray(np.linalg.norm(self.errors, axis=2))

    @cached_property
    def rms(self) -> Array:
        """The root of the mean of their squares over all steps, (n,); 0 where nothing is known of a node."""
        known = np.isfinite(self.sizes)
        return np.asarray(np.sqrt(np.nansum(self.sizes**2, axis=0) / np.maximum(known.sum(axis=0), 1)))

    @cached_property
    def ranking(self) -> list[int]:
        """The nodes, that with the largest `rms` first."""
        return [int(i) for i in np.argsort(-self.rms, kind="stable")]

    @cached_property
    def settled(self) -> int:
        """Steps until z and every z_hat_i have become small for good; all steps where that is not much shorter."""
        size = np.nan_to_num(np.abs(np.hstack([self.log.z, self.log.z_hat]))).max(axis=1, initial=0.0)
        moving = np.flatnonzero(size > SETTLED * size.max(initial=0.0))
        shown = int(moving[-1]) + 2 if len(moving) else self.log.steps
        return shown if shown < MOST_OF_A_RUN * self.log.steps else self.log.steps

    @property
    def is_as_promised(self) -> bool:
        """Whether nothing happened in this run that gamma does not cover."""
        return self.verdict.ledger is None or self.verdict.ledger.is_without_faults

    @cached_property
    def mean_bound(self) -> Array | None:
        """gamma sqrt(sum over j < k of |w(j)|^2), and what x(0) leaves, (steps,).

        None where gamma is not proved, says less of this run than of any (faults, say), or errors are not known.
        """
        if self.verdict.gamma.failure is not None or not self.is_as_promised or not self.log.has_plant:
            return None
        start = self.verdict.gamma.start
        if start is None:
            return None
        return np.asarray(self.verdict.gamma.value * np.sqrt(self.trace.energy_before) + start)

    @cached_property
    def lost(self) -> Array:
        """1 where the measurement of a node was lost, 0 where it arrived, NaN where that is not known, (steps, n)."""
        log = self.log
        arrived = np.where(np.array(log.external), np.nan, log.theta)
        seen = np.array([node.seen for node in log.gains.problem.nodes])
        return np.asarray(1.0 - np.where(np.isnan(arrived) & seen, log.measured, arrived))

    @cached_property
    def done_without(self) -> Array:
        """How many messages of its neighbours a node did not use in a step, (steps, n); NaN where that is not known.

        It put its own estimate in the place of each. The messages of step k are named in the estimate of step k + 1.
        """
        log, problem = self.log, self.log.gains.problem
        unused = np.asarray(~log.senders.members())
        without = np.full((log.steps, problem.n), np.nan)
        for s in range(len(problem.topologies)):
            at = np.flatnonzero(log.mode[:-1] == s)
            for i in range(problem.n):
                heard = log.heard[at + 1, i]
                known = heard >= 0
                neighbours = list(problem.neighbours(s, i))
                without[at[known], i] = unused[heard[known]][:, neighbours].sum(axis=1)
        return without

    @cached_property
    def rungs(self) -> list[tuple[str, float]]:
        """The ladder of the gains, of the LMI what is proved here, and what this run came to beside it."""
        from designer.proof.undercut import least_again  # which needs balls

        verdict, ladder = self.verdict, ladder_of(self.log.gains)
        least = least_again(self.log.gains)
        rungs = (ladder if least is not None and least.holds else ladder._replace(theorem2_least=None)).rungs()
        if verdict.peak and verdict.energy and self.log.has_plant:
            rungs.append((THIS_RUN, verdict.peak.size / verdict.energy**0.5))
        return rungs

    @cached_property
    def beyond(self) -> BeyondGamma:
        """What these gains do to each node by itself, and in noise."""
        gains = self.log.gains
        return beyond_gamma(gains.problem, gains.K, gains.H)

    @cached_property
    def mode_shares(self) -> Array:
        """The part of all steps that each mode had, (modes,)."""
        counts = np.bincount(self.log.mode[self.log.mode >= 0], minlength=len(self.log.gains.problem.topologies))
        return np.asarray(counts[: len(self.log.gains.problem.topologies)] / max(1, self.log.steps))


def over_nodes(statistic: Callable[..., Array], values: Array) -> Array:
    """np.nanmedian and the like over axis 1; NaN where all is NaN."""
    nothing = np.asarray(np.isnan(values).all(axis=1))
    filled = np.where(nothing[:, None], 0.0, values)
    return np.asarray(np.where(nothing, np.nan, statistic(filled, axis=1)))
