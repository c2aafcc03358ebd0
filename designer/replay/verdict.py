"""What a replay found: a value, its JSON, and its text for people."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Any

from agent.contract.arrays import ulps
from agent.contract.errors import EXIT_BROKEN, EXIT_GOOD, EXIT_NO, counted
from agent.contract.recording.evidence.examiner import Findings
from designer.chance import Chance
from designer.ledger.account import Account
from designer.replay.census import Faults, Place
from designer.replay.gamma import Gamma
from designer.replay.part import Part
from designer.replay.topics import NAMED

if TYPE_CHECKING:
    from designer.replay.pacing import Pacing

CLAIMS = {  # what each proof shows, and what is counted
    1: (
        "plant, sensors, the seed's modes, losses, deliveries and disturbance, and what each node says of itself agree",
        "values",
    ),
    2: ("one step of the centralised model from the logged state gives the next logged state", "values"),
    3: ("the centralised model running freely from step 0 stays with the log", "values"),
    4: ("every message is there once", "messages"),
    5: ("path inequality |z~(k)|^2 <= gamma_path(k)^2 sum over j < k of |w(j)|^2", "steps"),
}


OUTCOMES = {  # of every replay one; what it is called in the first line, and its exit code
    "agrees": ("agrees", EXIT_GOOD),
    "agrees for what is there": ("agrees for what is there, but is not whole", EXIT_BROKEN),
    "diverges": ("DIVERGES", EXIT_NO),
    "unreadable": ("nothing can be said", EXIT_BROKEN),
}
_KINDS = {2: "in one step of the model", 3: "in the free run"}  # divergences of these proofs, beside a field


def kind_of(field: str, proof: int) -> str:
    """The kind of a divergence: what the field is called, and where that is not all, what it was compared with."""
    return f"{field.partition('[')[0]} {_KINDS.get(proof, '')}".rstrip()


@dataclass(frozen=True)
class Divergence:
    """One number or name of the log beside what it should be."""

    step: int
    node: str | None  # None: the plant or the coordinator
    field: str  # as in the message, with its place in a vector: "x_hat[1]"
    gap: float  # relative to the magnitudes that enter; 1 for a wrong name
    expected: float | str
    logged: float | str
    proof: int

    @property
    def place(self) -> str:
        whose = f'of node "{self.node}"' if self.node is not None else "of the plant"
        if self.field == "mode" and self.node is None:
            whose = "of the coordinator"
        return f"{self.field} {whose}"

    @property
    def kind(self) -> str:
        return kind_of(self.field, self.proof)

    @property
    def ulps(self) -> int | None:
        """The distance of the two numbers in units in the last place, counted in float64; None of names."""
        if isinstance(self.logged, str) or isinstance(self.expected, str):
            return None
        return ulps(self.logged, self.expected)

    def text(self) -> str:
        values = (repr(value) if isinstance(value, float) else f'"{value}"' for value in (self.logged, self.expected))
        return "step {}: {} is {}, expected {}".format(self.step, self.place, *values)

    def document(self) -> dict[str, Any]:
        return {**vars(self), "ulps": self.ulps}


@dataclass(frozen=True)
class Proof:
    """The outcome of one of the five proofs."""

    number: int
    holds: bool | None  # None: nothing can be said, because nothing was compared, or the file is cut
    compared: int  # numbers and names, messages, or steps; 0 where nothing could be compared
    worst_gap: float
    note: str = ""

    def text(self) -> str:
        claim, counted = CLAIMS[self.number]
        match self.holds:
            case None:
                outcome = "part " if self.number == 4 else "  -  "
            case _:
                outcome = "holds" if self.holds else "FAILS"
        details = [f"{self.compared} {counted}" + (" compared" if self.number <= 3 else "")]
        if self.number <= 3 and self.compared:
            details[0] += f", largest gap {self.worst_gap:.1e}"
        details += [self.note] if self.note else []
        return f"  {self.number} {outcome}  {claim} ({'; '.join(details)})"


@dataclass(frozen=True)
class Peak:
    """The largest |z_tilde(k)| over all nodes."""

    size: float
    step: int


@dataclass(frozen=True)
class Verdict:
    """A replay's verdict. Gaps and the tolerance are relative to the magnitudes that enter each number."""

    recording: str
    part: Part  # what alone was judged
    run: str
    seed: int
    steps: int  # that the file holds
    planned: int
    messages: int
    status: str  # what the run said of its end; "cut" where it said nothing
    reason: str
    damage: str  # what is wrong with the file, "" where nothing is
    is_doubtful: bool  # its checksum fails, so that any number in it may be a wrong one
    notes: tuple[str, ...]  # what is odd about the file, and harms nothing
    finished: bool  # the run came to its planned end, and the file is sound
    whole: bool  # and every message of it is there, so that all is judged
    is_simulated: bool  # a simulated plant is in the file
    external: tuple[str, ...]  # nodes with sensors of their own; where there are any, estimates are compared
    proofs: tuple[Proof, ...]
    worst_gap: float
    worst: Divergence | None  # where the worst gap is
    tolerance: float
    first_divergence: Divergence | None
    later: Mapping[str, int]  # numbers and names that diverge beside the first, by kind
    missing: Faults  # nothing explains that they are not there
    lacking: Faults  # not in this file, as after a filter, a cut or damage
    gaps: tuple[str, ...]  # what is lacking, in words
    lost: int  # messages that went, by the recorder's account, with the process that held them
    unknown: tuple[Place, ...]  # estimates that went so, and of which nothing is concluded
    duplicates: Faults  # of different content for the same step
    copies: int  # of equal content
    strange: tuple[str, ...]  # what should not be in the file
    numbering: tuple[str, ...]  # faults in the senders' numbering
    evidence: Findings  # whether the messages are those that were sent
    peak: Peak | None  # against the simulated plant, also where sensors measured something else
    energy: float | None  # sum of |w|^2
    gamma: Gamma
    pacing: Pacing | None  # of a paced run
    chance: Chance | None  # what single runs keep; None where gamma is not proved, or says less of this run
    ledger: Account | None  # what gamma says of this run; None where it is not proved
    path_margin: float | None  # smallest 1 - |z_tilde(k)| / bound of proof 5 that is not trivial
    silent_from: int | None  # the first step of which proof 5 says nothing, because of rounding
    leeway: float | None  # the tolerance in units of the estimates, at the last step
    up_to: int | None  # the last step that was compared, where later ones have numbers too large for that

    @property
    def agrees(self) -> bool:
        """What is in the file agrees. Messages that a filtered or cut file lacks are not held against it."""
        return all(proof.holds is not False for proof in self.proofs)

    @property
    def complete(self) -> int:
        """Steps from the beginning of which every message is there."""
        holes = [place.step for faults in (self.missing, self.lacking) for place in faults.first]
        return min([self.steps, *holes])

    @property
    def compared(self) -> int:
        """Numbers and names that were compared."""
        return sum(proof.compared for proof in self.proofs if proof.number <= 3)

    @property
    def outcome(self) -> str:
        """One of OUTCOMES. Where a checksum fails, a number that does not agree is damage, and accuses nobody."""
        if not self.agrees:
            return "unreadable" if self.is_doubtful else "diverges"
        if not self.compared:
            return "unreadable"
        return "agrees" if self.whole else "agrees for what is there"

    @property
    def exit_code(self) -> int:
        return OUTCOMES[self.outcome][1]

    def document(self) -> dict[str, Any]:
        """For --json: plain values, None where nothing can be said."""
        first = self.first_divergence
        return {
            "recording": self.recording,
            **self.part.document(),
            "run": self.run,
            "agrees": self.agrees,
            "outcome": self.outcome,
            "finished": self.finished,
            "whole": self.whole,
            "status": self.status,
            "reason": self.reason,
            "damage": self.damage,
            "notes": list(self.notes),
            "seed": self.seed,
            "steps": self.steps,
            "planned": self.planned,
            "complete_steps": self.complete,
            "messages": self.messages,
            "worst_gap": self.worst_gap,
            "worst": self.worst.document() if self.worst else None,
            "tolerance": self.tolerance,
            "leeway": self.leeway,
            "up_to": self.up_to,
            "first_divergence": first.document() if first else None,
            "later_divergences": dict(self.later),
            "missing": self.missing.total,
            "missing_first": [place._asdict() for place in self.missing.first],
            "lacking": self.lacking.total,
            "lacking_first": [place._asdict() for place in self.lacking.first],
            "lacking_words": list(self.gaps),
            "lost": self.lost,
            "unknown": len(self.unknown),
            "unknown_first": [place._asdict() for place in self.unknown[:NAMED]],
            "copies": self.copies,
            "duplicates": self.duplicates.total,
            "duplicates_first": [place._asdict() for place in self.duplicates.first],
            "strange": list(self.strange),
            "numbering": list(self.numbering),
            "altered": self.evidence.total,
            "altered_first": [finding._asdict() for finding in self.evidence.wrong],
            "as_sent": self.evidence.checked,
            "simulated": self.is_simulated,
            "real_sensors": bool(self.external),
            "external": list(self.external),
            "pacing": self.pacing.document() if self.pacing else None,
            "peak": self.peak.size if self.peak else None,
            "peak_step": self.peak.step if self.peak else None,
            "energy": self.energy,
            "gamma": self.gamma.value,
            "certificate": self.gamma.failure is None,
            "certificate_failure": self.gamma.failure,
            "start": self.gamma.start,
            "one_run": self.chance.document() if self.chance else None,
            "ledger": self.ledger.document() if self.ledger else None,
            "path_margin": self.path_margin,
            "silent_from": self.silent_from,
            "proofs": [vars(proof) for proof in self.proofs],
        }

    def __repr__(self) -> str:
        """In a line; `text()` and `document()` have everything."""
        return f"Verdict({self.recording}: {self.headline()})"

    def _repr_html_(self) -> str:
        """What a notebook shows."""
        return f"<pre>{escape(self.text())}</pre>"

    def text(self) -> str:
        """The facts for people."""
        if not self.compared:
            return "\n".join(self._head())
        pacing = self.pacing.text() if self.pacing is not None else []
        return "\n".join([*self._head(), *pacing, *self._peak(), *self._proofs(), *self._faults()])

    def headline(self) -> str:
        """The outcome, and in a few words why, where that is not a number."""
        answer = OUTCOMES[self.outcome][0]
        if self.outcome == "unreadable":
            return f"{answer}: " + ("it holds nothing to compare" if self.agrees else "its bytes were changed later")
        if self.outcome == "diverges" and all(proof.holds is not False for proof in self.proofs if proof.number != 4):
            return f"{answer}: every number in it agrees, but {self._what_is_wrong()}"
        if self.up_to is None:
            return answer
        if self.outcome == "agrees":
            return f"{answer} up to step {self.up_to}: later numbers are too large to compare"
        return f"{answer}; numbers after step {self.up_to} are too large to compare"

    def _what_is_wrong(self) -> str:
        """The faults of proof 4 in a few words."""
        missing, double, altered = self.missing.total, self.duplicates.total, self.evidence.total
        found = [
            f"{counted(missing, 'message')} {'is' if missing == 1 else 'are'} missing",
            f"{counted(double, 'message')} contradict{'s' if double == 1 else ''} another of the same step",
            "something in it is not of this run, or was altered",
            "the senders' numbers have faults",
            f"{counted(altered, 'message')} {'is' if altered == 1 else 'are'} not what the senders say they sent",
        ]
        faults = (missing, double, self.strange, self.numbering, altered)
        return ", and ".join(words for words, fault in zip(found, faults, strict=True) if fault)

    def _head(self) -> list[str]:
        lines = [
            f"{self.recording}: {self.headline()}",
            f'run "{self.run}", seed {self.seed}, {self.steps} of {self.planned} steps, '
            f"{counted(self.messages, 'message')}, {self.status}{f': {self.reason}' if self.reason else ''}",
        ]
        if self.leeway is not None and math.isfinite(self.leeway):
            lines.append(f"at its last step an estimate may be off by {self.leeway:.2g} and agree, by rounding alone")
        if self.part != Part():
            lines.append(f"judged: {self.part.text()}")
        if self.damage:
            lines.append(f"the file: {self.damage}")
        if self.gaps:
            how = "not in this file" if self.status in ("cut", "continues") or self.damage else "left out of this file"
            lines.append(f"{how}: {counted(self.lacking.total, 'message')} ({'; '.join(self.gaps)})")
        if self.unknown:
            named = ", ".join(f"{place.topic} step {place.step}" for place in self.unknown[:5])
            more = f" and {len(self.unknown) - 5} more" if len(self.unknown) > 5 else ""
            lines.append(f"unknown, and used by others, whose next estimates are not judged by them: {named}{more}")
        if self.gaps or self.damage:
            lines.append(f"the last complete step is {self.complete - 1}" if self.complete else "no step is complete")
        return [*lines, *(f"note: {note}" for note in self.notes)]

    def _proofs(self) -> list[str]:
        lines = [proof.text() for proof in self.proofs]
        if self.first_divergence:
            ulps = self.first_divergence.ulps
            lines.append(
                f"first divergence, {self.first_divergence.text()}: gap {self.first_divergence.gap:.1e}, "
                f"tolerance {self.tolerance:.1e}{'' if ulps is None else f', {_approximately(ulps)} apart'}"
            )
            lines += self._later()
        elif self.worst:
            lines.append(
                f"largest gap {self.worst_gap:.1e}, at step {self.worst.step} in {self.worst.place}; "
                f"tolerance {self.tolerance:.1e} ({1.0 - self.worst_gap / self.tolerance:.0%} left)"
            )
        return lines

    def _later(self) -> Iterator[str]:
        total = sum(self.later.values())
        if total:
            kinds = sorted(self.later.items(), key=lambda kind: (-kind[1], kind[0]))
            yield f"then {total} more: {', '.join(f'{count} of {kind}' for kind, count in kinds)}"

    def _faults(self) -> list[str]:
        lines = []
        for word, faults in (("missing", self.missing), ("double", self.duplicates)):
            if faults.total:
                named = ", ".join(f"{place.topic} step {place.step}" for place in faults.first[:5])
                more = f" and {faults.total - 5} more" if faults.total > 5 else ""
                lines.append(f"{word}: {faults.total} ({named}{more})")
        for fault in (*self.strange, *self.numbering)[:5]:
            lines.append(f"strange: {fault}")
        for finding in self.evidence.wrong[:5]:
            lines.append(f"not as sent: {finding}")
        if self.evidence.total > 5:
            lines.append(f"not as sent: {self.evidence.total - 5} more")
        return lines

    def _peak(self) -> list[str]:
        lines = []
        if self.external:
            names = ", ".join(f'"{name}"' for name in self.external)
            lines.append(f"sensors of their own: {names}; estimates are compared instead of errors")
        if not self.is_simulated:
            lines.append("no simulated plant: nothing is known of the error")
        if self.peak is not None:
            bound = "" if self.energy is None or not self.gamma.is_claimed else self._bound(self.energy)
            against = " against the simulated plant" if self.external else ""
            rounding = ""
            if self.silent_from is not None and self.peak.step >= self.silent_from:
                rounding = f"; from step {self.silent_from} on it may be rounding alone"
            lines.append(f"peak |z~| {self.peak.size:.4g}{against} at step {self.peak.step}{bound}{rounding}")
        lines += [self.gamma.text(), *([self.chance.text()] if self.chance else [])]
        return [*lines, *([f"ledger       {self.ledger.text()}"] if self.ledger else [])]

    def _bound(self, energy: float) -> str:
        gamma, start = self.gamma.value, self.gamma.start
        if start is None:
            return ""
        words = "gamma sqrt(energy) + start" if start else "gamma sqrt(energy)"
        of_start = f" and start {start:.4g}" if start else ""
        return f", {words} {gamma * energy**0.5 + start:.4g} with gamma {gamma:.5g}{of_start}"


def _approximately(ulps: int) -> str:
    """ "17 units in the last place"; large numbers in powers of ten."""
    return f"{counted(ulps, 'unit') if ulps < 10**6 else f'{float(ulps):.1e} units'} in the last place"
