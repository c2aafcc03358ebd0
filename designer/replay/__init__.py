"""A recording against the centralised error model: what was logged, is it what the mathematics says?

1. modes, losses, deliveries and disturbance are the seed's, plant and sensors obey them, and so does what each node
   says of itself;
2. one step of (10) from the *logged* state, with the messages that each node says it used, gives the next logged
   errors: names step, node, field, size;
3. (10) running *freely* from step 0 stays with the log;
4. every message is there exactly once, and is what its sender says it sent;
5. the realised run obeys its path inequality.

Beside these, the certificate of the attached gains is checked again: it decides nothing about the log, but without
it gamma is only a number in a file.

Replay shares no step arithmetic with the nodes: they sum (4)(5) link by link, here (10) is one matrix of the
whole network. It never imports the runtime's filter.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path as FilePath
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agent.contract.errors import counted
from agent.contract.problem import Problem
from designer.chance import Chance, chance
from designer.ledger.account import Account
from designer.ledger.deviation import Deviation
from designer.replay import free_run, proofs
from designer.replay.census import Place
from designer.replay.central import Central
from designer.replay.coupling import Coupling, with_the_plant
from designer.replay.gamma import Gamma, checked_gamma
from designer.replay.inputs import draw, logged_inputs
from designer.replay.log import Log, load
from designer.replay.pacing import Pacing
from designer.replay.part import Part
from designer.replay.promise import faults_of, promise
from designer.replay.proofs import Check
from designer.replay.trace import Trace
from designer.replay.verdict import Divergence, Peak, Proof, Verdict, kind_of

Report = Callable[[str, int, int], None]  # what is being done, how much of it, and of how much
UNIT: float = 2.0**-53  # the relative error of one float64 operation
_STEPS_AT_ONCE = 1024
_NUMBERS_AT_ONCE = 2_000_000  # of output covariances held at once, 16 MB


def tolerance(problem: Problem, *, paced: bool = False) -> float:
    """The one tolerance: 5 (n_eta + sum ny + nw + n + 4) u, relative, with u = 2^-53; links and bias below.

    Every sum in float64 is the exact sum of terms that are each off by a factor (1 + d)^m, |d| <= u, where m
    counts the operations that a term goes through; to first order its error is at most m u times the sum of the
    terms' absolute values, which is the magnitude that gaps are divided by. A logged e_i(k+1) = x(k+1) -
    x_hat_i(k+1) comes from the plant's sums for x and y, m <= 2 nx + 2 nw + 3 together, and the node's,
    m <= n_eta + sum ny + nx + 4; (8) takes its blocks and its product through m <= n_eta + 2 sum ny + nw + n + 6
    operations, with at most twice the magnitude. In total 3 n_eta + 5 sum ny + 3 nx + 4 nw + 2 n + 19, which is
    below the number above since n_eta >= 2 nx; the shorter sums of x, y, z and innovations are below it too.

    Links that lose messages: realised deliveries are added to the mean block by block. That makes m <= n_eta + 2 sum ny
    + nw + 2 n + 6, and the magnitude four times: a message that was lost and that carried a lost measurement goes into
    (rho + |phi - rho|) (beta + |theta - beta|) <= 4 terms of its own size, which cancel. In total 5 n_eta + 9 sum ny
    + 3 nx + 6 nw + 8 n + 31; since n >= 2, n_eta >= 3 nx, and 9 in place of 5 is above it. Seen losses alone cancel
    two terms, beta + |theta - beta| <= 2, as hidden ones do.

    Unbiased gains: a node takes a_ii K_ii = A - sum of the other a_ij K_ij, the model the K_ii of the file, rounded:
    `Gains` has made sure that sum over j of a_ij K_ij differs from A by 5 (n + 2) u times their absolute values at
    most, the rounding of that sum with it. That number is added. The node's own sums have one term and one difference
    more, for which the bound above has room.

    Paced runs: any link may lose a message, so the sums are as long as with lossy links, and up to n terms join K_ii;
    what acted is no mean, so nothing cancels but theta - beta, and the magnitude stays twice. 9 is above that, too.

    No gain enters: what large gains amplify is in the magnitude, and so is a state that grows. One unit in the last
    place of an estimate is a gap of at most 2 u and lies within; a change of 1e-6 of it lies eight orders of magnitude
    above u.
    """
    ny = sum(node.C.shape[0] for node in problem.nodes)
    n_eta = problem.nx * (problem.n + 1)
    factor = 9 if paced or (problem.delivery < 1.0).any() else 5
    rounded = 5 * (problem.n + 2) if problem.unbiased else 0
    return float((factor * (n_eta + ny + problem.nw + problem.n + 4) + rounded) * UNIT)


def replay(
    path: FilePath | Sequence[FilePath],
    *,
    run: str | None = None,
    gains: FilePath | None = None,
    part: Part | None = None,
    report: Report | None = None,
) -> Verdict:
    """Read a recording, or the files that hold parts of one, and judge it. Raises InputError for what is none.

    `run` and `gains` as in `load`; `part` is what alone is judged. `report` is told what is being done, how far that
    is, and of how much.
    """
    tell = report or (lambda what, done, of: None)
    log = load(path, run=run, gains=gains, part=part, report=lambda done, of: tell("reading", done, of))
    return judge(log, part=part, report=report)


def judge(log: Log, trace: Trace | None = None, *, part: Part | None = None, report: Report | None = None) -> Verdict:
    """Judge what was read; `trace`, of as many steps, gets what was found at each of them.

    Estimates that others have used may have gone with the process that held them. The model knows them where they were
    made as the seed says; where that does not explain the rest, nothing is concluded of them, nor of what depends on
    them, and that is said.
    """
    central = Central.of(log.gains)

    def compared(trace: Trace | None, *, doubts: bool) -> tuple[Tally, _Compared]:
        names = log.gains.problem.node_names
        tally = Tally(tolerance(log.gains.problem, paced=log.is_paced), names, trace, part, log.grown)
        with np.errstate(over="ignore", invalid="ignore"):  # an unstable free run may: proof 2 still judges
            return tally, _compare(log, central, tally, report or (lambda what, done, of: None), doubts=doubts)

    doubts = (log.is_part or bool(log.absences.perhaps_sent.any())) and _diverges(*compared(None, doubts=False))
    return _verdict(log, *compared(trace, doubts=doubts))


def ledger(path: FilePath | Sequence[FilePath]) -> Account | None:
    """What gamma says of a recorded run; as `replay` says it, but that what nodes tell of themselves is not compared.

    None where no gamma is proved.
    """
    log = load(path)
    faults: Mapping[int, Deviation] = {}
    if log.is_paced:
        central = Central.of(log.gains)
        drawn = draw(log, central)
        inputs, hears = logged_inputs(log, central, drawn), proofs.to_be_heard(log, central, drawn)
        faults = faults_of(Coupling.of(with_the_plant(log, drawn), central, inputs, drawn, hears), hears)
    return promise(log, checked_gamma(log.gains), faults)


class Tally:
    """The worst gap of each proof, and the first divergence: by step, then in the order of the checks."""

    def __init__(
        self,
        tolerance: float,
        node_names: tuple[str, ...],
        trace: Trace | None = None,
        part: Part | None = None,
        last: int | None = None,
    ) -> None:
        self.tolerance, self.trace, self._names, self.part = tolerance, trace, node_names, part or Part()
        self.compared = dict.fromkeys((1, 2, 3), 0)
        self.gaps = dict.fromkeys((1, 2, 3), 0.0)
        self.worst: Divergence | None = None
        self.first: Divergence | None = None
        self.later: Counter[str] = Counter()  # numbers and names beyond the tolerance, by kind, with the first
        self.leeway = np.nan  # what the tolerance is, in units of the estimates, at the last step of which it is known
        self.last = last  # that is compared

    def add(self, checks: Iterable[Check]) -> None:
        for check in map(self._in_part, checks):
            known = ~np.isnan(check.gap)
            if not known.any():
                continue
            if self.trace is not None:
                self.trace.add(check)
            gap = np.where(known, check.gap, -1.0)
            self.compared[check.proof] += int(known.sum())
            if check.proof == 2 and check.field == "x_hat" and check.magnitude is not None:
                row = int(np.flatnonzero(known.any(axis=1))[-1])
                self.leeway = self.tolerance * float(check.magnitude[row][known[row]].max())
            self.gaps[check.proof] = max(self.gaps[check.proof], float(gap.max()))
            if self.worst is None or gap.max() > self.worst.gap:
                row, column = divmod(int(gap.argmax()), gap.shape[1])
                self.worst = check.divergence(row, column, self._names)
            self.later[kind_of(check.field, check.proof)] += int((gap > self.tolerance).sum())
            beyond = np.flatnonzero((gap > self.tolerance).any(axis=1))
            if len(beyond) and (self.first is None or check.first + beyond[0] < self.first.step):
                row = int(beyond[0])
                column = int(np.argmax(gap[row] > self.tolerance))
                self.first = check.divergence(row, column, self._names)

    def beside_the_first(self) -> dict[str, int]:
        """How many diverge beside the first, by kind."""
        return dict(self.later - Counter([self.first.kind] if self.first else []))

    def _in_part(self, check: Check) -> Check:
        """Without what is not to be judged."""
        if self.part == Part() and self.last is None:
            return check
        steps = check.first + np.arange(len(check.gap))
        judged = ((steps >= self.part.first) & (steps <= self.part.last))[:, None]
        if self.last is not None:
            judged &= (steps <= self.last)[:, None]
        if self.part.node is not None:
            judged = judged & (check.owner == self._names.index(self.part.node))
        return check._replace(gap=np.where(judged, check.gap, np.nan))


class PathAudit:
    """Proof 5, gathered block by block. If w is one number, the bound is an equality at step 1.

    With an initial error it is one until the first w.
    """

    def __init__(self, problem: Problem, part: Part) -> None:
        self._part, self._starts = part, bool(problem.initial_error.any())
        self._equal_at = 1 if problem.nw == 1 and not self._starts else -1
        self.holds, self.compared = True, 0
        self.margin, self.step = np.inf, -1  # the smallest, and where
        self.is_equality = False  # in that step, which says nothing, and is not in the margin
        self.silent, self.silent_from = 0, -1  # steps whose rounding may be more than the bound, and the first of them
        self.spoke_again = False  # after that one

    def add(self, path: free_run.Path, tolerance: float) -> None:
        steps = path.first + np.arange(len(path.error))
        judged = ~np.isnan(path.error) & (steps >= self._part.first) & (steps <= self._part.last)
        rounding = tolerance * path.rounding
        speaks = (rounding <= path.bound) | (path.bound == 0.0)
        self._fall_silent(steps[judged], speaks[judged])
        known = judged & speaks & ~np.isnan(path.bound)
        within = path.error <= path.bound + rounding
        self.compared += int(known.sum())
        self.holds &= bool(within[known].all())
        counts = known & (path.bound > path.start)
        trivial = counts & within & (steps == self._equal_at)
        self.is_equality |= bool(trivial.any())
        counts &= ~trivial
        if counts.any():
            margins = 1.0 - path.error[counts] / path.bound[counts]
            if margins.min() < self.margin:
                self.margin, self.step = float(margins.min()), int(steps[counts][margins.argmin()])

    def _fall_silent(self, steps: NDArray[np.int64], speaks: NDArray[np.bool_]) -> None:
        if not self.silent and not speaks.all():
            self.silent_from = int(steps[~speaks][0])
        self.silent += int((~speaks).sum())
        self.spoke_again |= bool(self.silent and speaks[steps > self.silent_from].any())

    def note(self) -> str:
        smallest = f"smallest margin {self.margin:.1%}, at step {self.step}"
        smallest += "; the bound has what x(0) leaves beside it" if self._starts else ""
        if self.silent:
            from_where = f"from step {self.silent_from} on"
            which = f"of {counted(self.silent, 'step')} {from_where}" if self.spoke_again else from_where
            why = f"it says nothing {which}, where rounding may be more than the bound"
            return f"{smallest}; {why}" if self.step >= 0 else why
        if self.is_equality:
            why = "at step 1 the bound is an equality, because w is one number"
            return f"{smallest}; {why}" if self.step >= 0 else why
        return smallest if self.step >= 0 else "nothing disturbed the run"


class _Compared(NamedTuple):
    """What the checks found beside gaps."""

    audit: PathAudit | None  # proof 5, where errors can be computed
    energy: float | None  # and sum of |w|^2
    pacing: Pacing | None
    faults: Mapping[int, Deviation]  # by step
    unknown: tuple[Place, ...] = ()  # estimates of which nothing is concluded


def _diverges(tally: Tally, compared: _Compared) -> bool:
    return tally.first is not None or not (compared.audit is None or compared.audit.holds)


def _compare(log: Log, central: Central, tally: Tally, report: Report, *, doubts: bool = False) -> _Compared:
    """All checks, a block of steps at a time; with `doubts`, nothing is concluded of what nobody has recorded."""
    drawn = draw(log, central)
    inputs = logged_inputs(log, central, drawn)
    hears = proofs.to_be_heard(log, central, drawn)
    coupling = pacing = None
    faults: Mapping[int, Deviation] = {}
    if log.is_paced:
        log = with_the_plant(log, drawn)
        coupling = Coupling.of(log, central, inputs, drawn, hears)
        coupling = coupling.doubtful() if doubts else coupling
        pacing, faults = Pacing.of(coupling, hears, log.period), faults_of(coupling, hears)
        central, hears = coupling.central, coupling.hears
    tally.add(proofs.start_checks(log, central))
    for first in range(0, log.steps, _STEPS_AT_ONCE):
        now = slice(first, min(first + _STEPS_AT_ONCE, log.steps))
        tally.add(proofs.input_checks(log, central, drawn, now))
        if coupling is None:
            tally.add(proofs.step_checks(log, central, inputs, now))
        else:
            tally.add(coupling.told_checks(now))
            tally.add(coupling.step_checks(now))
        tally.add(proofs.message_checks(log, central, hears, now))
        report("comparing, first pass", now.stop, log.steps)
    unknown = coupling.unknown_places() if coupling is not None else ()
    whole = coupling.inputs if coupling is not None else free_run.complete(inputs, drawn, log, central)
    energies = (whole.w**2).sum(axis=1)
    energy_before = np.cumsum(energies) - energies
    if tally.trace is not None and log.has_plant:
        tally.trace.energy_before[:] = energy_before
    block = max(16, min(_STEPS_AT_ONCE, _NUMBERS_AT_ONCE // len(central.model.M) ** 2))
    audit = PathAudit(log.gains.problem, tally.part)
    errors = log.error_norms() if coupling is None else coupling.error_norms()
    parts = free_run.free_run(log, central, whole, block=block) if coupling is None else coupling.free_run(block=block)
    for part in parts:
        tally.add([free_run.free_check(log, central, part)])
        report("comparing, second pass", part.first + len(part.eta), log.steps)
        if log.has_plant:
            path = free_run.path_block(central, part, errors, energy_before)
            audit.add(path, tally.tolerance)
            if tally.trace is not None:
                steps = slice(path.first, path.first + len(path.bound))
                tally.trace.path_bound[steps], tally.trace.path_start[steps] = path.bound, part.start
    if not log.has_plant:
        return _Compared(None, None, pacing, faults, unknown)
    return _Compared(audit, float(energies.sum()), pacing, faults, unknown)


def _peak(log: Log) -> Peak | None:
    errors = log.error_norms()
    if not np.isfinite(errors).any():
        return None
    step = int(np.nanargmax(errors))
    return Peak(float(errors[step]), step)


def _verdict(log: Log, tally: Tally, compared: _Compared) -> Verdict:
    end, audit, gamma = log.end or {}, compared.audit, checked_gamma(log.gains)
    ledger = promise(log, gamma, compared.faults)
    return Verdict(
        recording=log.label,
        part=tally.part,
        run=log.run.get("run", ""),
        seed=log.seed,
        steps=log.steps,
        planned=log.planned,
        messages=log.messages,
        status=end.get("status", "cut"),
        reason=end.get("reason", ""),
        damage=log.damage,
        is_doubtful=log.is_doubtful,
        notes=log.notes,
        finished=log.finished,
        whole=log.is_whole and not compared.unknown,
        lost=int(log.absences.lost.sum()),
        unknown=compared.unknown,
        is_simulated=log.is_simulated,
        external=tuple(name for name, real in zip(log.gains.problem.node_names, log.external, strict=True) if real),
        proofs=tuple(_proofs(log, tally, audit, compared.unknown)),
        worst_gap=max(tally.gaps.values()),
        worst=tally.worst,
        tolerance=tally.tolerance,
        first_divergence=tally.first,
        later=tally.beside_the_first(),
        missing=log.census.missing,
        lacking=log.census.lacking,
        gaps=log.census.gaps,
        copies=log.census.copies,
        duplicates=log.census.duplicates,
        strange=log.census.strange,
        numbering=log.census.numbering,
        evidence=log.evidence,
        peak=_peak(log),
        energy=compared.energy,
        gamma=gamma,
        ledger=ledger,
        chance=_chance(log, gamma, ledger, compared.energy),
        pacing=compared.pacing,
        path_margin=audit.margin if audit and audit.step >= 0 else None,
        silent_from=audit.silent_from if audit and audit.silent else None,
        leeway=None if np.isnan(tally.leeway) else tally.leeway,
        up_to=tally.last,
    )


def _chance(log: Log, gamma: Gamma, ledger: Account | None, energy: float | None) -> Chance | None:
    """What single runs keep; None where this is none of them, with faults or with errors that are not known."""
    if energy is None or ledger is None or not ledger.is_without_faults:
        return None
    return chance(log.gains, steps=log.steps, energy=energy)


def _proofs(log: Log, tally: Tally, audit: PathAudit | None, unknown: tuple[Place, ...]) -> Iterator[Proof]:
    for number, gap in tally.gaps.items():
        compared = tally.compared[number]
        yield Proof(number, gap <= tally.tolerance if compared else None, compared, gap)
    yield _census_proof(log, is_whole=log.is_whole and not unknown)
    if audit is not None and tally.part.node is not None:
        yield Proof(5, None, 0, 0.0, "it is about all nodes together")
    elif audit is not None:
        yield Proof(5, audit.holds if audit.compared else None, audit.compared, 0.0, audit.note())
    elif log.is_simulated:
        yield Proof(5, None, 0, 0.0, "it does not apply to measurements that are not of the simulated plant")
    else:
        yield Proof(5, None, 0, 0.0, "without a plant the error is not known")


def _census_proof(log: Log, *, is_whole: bool) -> Proof:
    """What a filtered or cut file lacks is held against it no more than it shows anything."""
    census = log.census
    altered = log.evidence.total
    faulty = bool(census.missing.total or census.duplicates.total or census.strange or census.numbering or altered)
    counts = [f"{census.missing.total} missing", f"{census.duplicates.total} double"]
    if altered or log.evidence.checked:
        counts.append(f"{altered} altered")
    if census.lacking.total:
        steps = f" from step {census.lacking.first[0].step} on" if census.lacking.first else ""
        counts.append(f"{census.lacking.total} not in this file{steps}")
    if lost := int(log.absences.lost.sum()):
        counts.append(f"{lost} lost, by the recorder's account")
    holds = False if faulty else True if is_whole else None
    return Proof(4, holds, log.messages, 0.0, ", ".join(counts))
