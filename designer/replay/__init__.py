"""A recording against the paper's centralised error model: what was logged, is it what the mathematics says?

1. the logged inputs obey plant, sensors and the seed's draws; every node's own words agree with each other;
2. one step of (10) from the *logged* state gives the next logged errors: names step, node, field, size;
3. (10) running *freely* from step 0 stays with the log;
4. every message is there exactly once;
5. the realised run obeys its path inequality.

Replay shares no step arithmetic with the nodes: they sum (4)(5) link by link, here (10) is one matrix of the
whole network. It never imports the runtime's filter.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path as FilePath

import numpy as np

from agent.contract.problem import Problem
from designer.replay import free_run, proofs
from designer.replay.log import Log, load
from designer.replay.proofs import Central, Check
from designer.replay.verdict import Divergence, Proof, Verdict

UNIT: float = 2.0**-53  # the relative error of one float64 operation
_STEPS_AT_ONCE = 1024
_NUMBERS_AT_ONCE = 2_000_000  # of output covariances held at once, 16 MB


def tolerance(problem: Problem) -> float:
    """The one tolerance: 5 (n_eta + sum ny + nw + n + 4) u, relative, with u = 2^-53.

    Every sum in float64 is the exact sum of terms that are each off by a factor (1 + d)^m, |d| <= u, where m
    counts the operations that a term goes through; to first order its error is at most m u times the sum of the
    terms' absolute values, which is the magnitude that gaps are divided by. A logged e_i(k+1) = x(k+1) -
    x_hat_i(k+1) comes from the plant's sums for x and y, m <= 2 nx + 2 nw + 3 together, and the node's,
    m <= n_eta + sum ny + nx + 4; (8) takes its blocks and its product through m <= n_eta + 2 sum ny + nw + n + 6
    operations, with at most twice the magnitude. In total 3 n_eta + 5 sum ny + 3 nx + 4 nw + 2 n + 19, which is
    below the number above since n_eta >= 2 nx; the shorter sums of x, y, z and innovations are below it too.

    No gain enters: what large gains amplify is in the magnitude. One unit in the last place of an estimate is a
    gap of at most 2 u and lies within; a change of 1e-6 of it lies eight orders of magnitude above u.
    """
    ny = sum(node.C.shape[0] for node in problem.nodes)
    n_eta = problem.nx * (problem.n + 1)
    return float(5 * (n_eta + ny + problem.nw + problem.n + 4) * UNIT)


def replay(path: FilePath) -> Verdict:
    """Read a recording and judge it. Raises InputError for a file that is no recording."""
    log = load(path)
    central = Central.of(log.gains)
    tally = Tally(tolerance(log.gains.problem), log.gains.problem.node_names)
    with np.errstate(over="ignore", invalid="ignore"):  # an unstable free run may: proof 2 still judges
        peak = _compare(log, central, tally)
    return _verdict(log, tally, peak)


class Tally:
    """The worst gap of each proof, and the first divergence: by step, then in the order of the checks."""

    def __init__(self, tolerance: float, node_names: tuple[str, ...]) -> None:
        self.tolerance, self._names = tolerance, node_names
        self.compared = dict.fromkeys((1, 2, 3), 0)
        self.gaps = dict.fromkeys((1, 2, 3), 0.0)
        self.worst: Divergence | None = None
        self.first: Divergence | None = None

    def add(self, checks: Iterable[Check]) -> None:
        for check in checks:
            known = ~np.isnan(check.gap)
            if not known.any():
                continue
            gap = np.where(known, check.gap, -1.0)
            self.compared[check.proof] += int(known.sum())
            self.gaps[check.proof] = max(self.gaps[check.proof], float(gap.max()))
            if self.worst is None or gap.max() > self.worst.gap:
                self.worst = self._divergence(check, int(gap.argmax()))
            beyond = np.flatnonzero((gap > self.tolerance).any(axis=1))
            if len(beyond) and (self.first is None or check.first + beyond[0] < self.first.step):
                row = int(beyond[0])
                column = int(np.argmax(gap[row] > self.tolerance))
                self.first = self._divergence(check, row * gap.shape[1] + column)

    def _divergence(self, check: Check, place: int) -> Divergence:
        row, column = divmod(place, check.gap.shape[1])
        owner = int(check.owner[column])
        position = column - int(np.argmax(check.owner == owner))
        logged, expected = float(check.logged[row, column]), float(check.expected[row, column])
        vector = not check.words and check.field != "arrived"
        return Divergence(
            step=check.first + row,
            node=self._names[owner] if owner >= 0 else None,
            field=f"{check.field}[{position}]" if vector else check.field,
            gap=float(check.gap[row, column]),
            expected=check.words[int(expected)] if check.words else expected,
            logged=check.words[int(logged)] if check.words else logged,
            proof=check.proof,
        )


class Peak:
    """Peak, energy and the path inequality, gathered block by block."""

    def __init__(self) -> None:
        self.peak, self.margin, self.compared, self.holds = 0.0, np.inf, 0, True

    def add(self, path: free_run.Path, tolerance: float) -> None:
        known = ~np.isnan(path.error) & ~np.isnan(path.bound)
        error, bound = path.error[known], path.bound[known]
        self.compared += int(known.sum())
        self.peak = max(self.peak, float(np.nanmax(path.error, initial=0.0)))
        self.holds &= bool((error <= bound + tolerance * path.rounding[known]).all())
        margins = 1.0 - error[bound > 0.0] / bound[bound > 0.0]
        self.margin = min(self.margin, float(margins.min(initial=np.inf)))


def _compare(log: Log, central: Central, tally: Tally) -> tuple[Peak, float] | None:
    """All checks, a block of steps at a time; returns peak and energy where there is a plant."""
    drawn = proofs.draw(log)
    inputs, eta, hears = (
        proofs.logged_inputs(log),
        proofs.logged_states(log),
        proofs.neighbours(log),
    )
    tally.add(proofs.start_checks(log, central))
    for first in range(0, log.steps, _STEPS_AT_ONCE):
        now = slice(first, min(first + _STEPS_AT_ONCE, log.steps))
        tally.add(proofs.input_checks(log, central, drawn, now))
        tally.add(proofs.step_checks(log, central, inputs, eta, now))
        tally.add(proofs.message_checks(log, central, hears, now))
    whole = free_run.complete(inputs, drawn, log, central)
    energies = (whole.w**2).sum(axis=1)
    energy_before = np.cumsum(energies) - energies
    block = max(16, min(_STEPS_AT_ONCE, _NUMBERS_AT_ONCE // len(central.model.M) ** 2))
    peak = Peak()
    for part in free_run.free_run(log, central, whole, block=block):
        tally.add([free_run.free_check(log, central, part, eta)])
        if log.has_plant:
            peak.add(free_run.path_block(log, central, part, energy_before), tally.tolerance)
    return (peak, float(energies.sum())) if log.has_plant else None


def _verdict(log: Log, tally: Tally, peak: tuple[Peak, float] | None) -> Verdict:
    end = log.end or {}
    return Verdict(
        recording=str(log.path),
        run=log.run.get("run", ""),
        seed=log.seed,
        steps=log.steps,
        planned=log.planned,
        messages=log.messages,
        status=end.get("status", "cut"),
        reason=end.get("reason", ""),
        damage=log.damage,
        finished=log.finished,
        has_plant=log.has_plant,
        proofs=tuple(_proofs(log, tally, peak)),
        worst_gap=max(tally.gaps.values()),
        worst=tally.worst,
        tolerance=tally.tolerance,
        first_divergence=tally.first,
        missing=log.census.missing,
        duplicates=log.census.duplicates,
        strange=log.census.strange,
        numbering=log.census.numbering,
        peak=peak[0].peak if peak else None,
        energy=peak[1] if peak else None,
        gamma=log.gains.certificate.gamma,
        path_margin=peak[0].margin if peak and np.isfinite(peak[0].margin) else None,
    )


def _proofs(log: Log, tally: Tally, peak: tuple[Peak, float] | None) -> Iterator[Proof]:
    for number, gap in tally.gaps.items():
        yield Proof(number, gap <= tally.tolerance, tally.compared[number], gap)
    once = not (log.census.duplicates.total or log.census.strange or log.census.numbering)
    whole = not log.finished or log.census.missing.total == 0  # a cut file must lack something
    note = f"{log.census.missing.total} missing, {log.census.duplicates.total} double"
    yield Proof(4, once and whole, log.messages, 0.0, note)
    if peak is None:
        yield Proof(5, True, 0, 0.0, "real sensors: the error is not known")
    else:
        margin = f"smallest margin {peak[0].margin:.1%}" if np.isfinite(peak[0].margin) else "nothing disturbed the run"
        yield Proof(5, peak[0].holds, peak[0].compared, 0.0, margin)
