"""What a replay found: a value, its JSON, and its text for people."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from agent.contract.errors import EXIT_BROKEN, EXIT_GOOD, EXIT_NO
from designer.replay.census import Faults
from designer.replay.gamma import Gamma

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

    def text(self) -> str:
        values = (repr(value) if isinstance(value, float) else f'"{value}"' for value in (self.logged, self.expected))
        return "step {}: {} is {}, expected {}".format(self.step, self.place, *values)


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
                outcome = "cut  " if self.number == 4 else "  -  "
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
    run: str
    seed: int
    steps: int  # that the file holds
    planned: int
    messages: int
    status: str  # what the run said of its end; "cut" where it said nothing
    reason: str
    damage: str  # what is wrong with the file, "" where nothing is
    finished: bool
    is_simulated: bool  # a simulated plant is in the file
    external: tuple[str, ...]  # nodes with sensors of their own; where there are any, estimates are compared
    proofs: tuple[Proof, ...]
    worst_gap: float
    worst: Divergence | None  # where the worst gap is
    tolerance: float
    first_divergence: Divergence | None
    missing: Faults
    duplicates: Faults
    strange: tuple[str, ...]  # what should not be in the file
    numbering: tuple[str, ...]  # faults in the senders' numbering
    peak: Peak | None  # against the simulated plant, also where sensors measured something else
    energy: float | None  # sum of |w|^2
    gamma: Gamma
    path_margin: float | None  # smallest 1 - |z_tilde(k)| / bound that is not trivial; bound: proof 5 and its rounding

    @property
    def agrees(self) -> bool:
        """What is in the file agrees. Messages that a cut file lacks are not held against it."""
        return all(proof.holds is not False for proof in self.proofs)

    @property
    def exit_code(self) -> int:
        if not self.agrees:
            return EXIT_NO
        return EXIT_GOOD if self.finished else EXIT_BROKEN

    def document(self) -> dict[str, Any]:
        """For --json: plain values, None where nothing can be said."""
        first = self.first_divergence
        return {
            "recording": self.recording,
            "run": self.run,
            "agrees": self.agrees,
            "finished": self.finished,
            "status": self.status,
            "reason": self.reason,
            "damage": self.damage,
            "seed": self.seed,
            "steps": self.steps,
            "planned": self.planned,
            "messages": self.messages,
            "worst_gap": self.worst_gap,
            "worst": vars(self.worst) if self.worst else None,
            "tolerance": self.tolerance,
            "first_divergence": vars(first) if first else None,
            "missing": self.missing.total,
            "missing_first": [place._asdict() for place in self.missing.first],
            "duplicates": self.duplicates.total,
            "duplicates_first": [place._asdict() for place in self.duplicates.first],
            "strange": list(self.strange),
            "numbering": list(self.numbering),
            "simulated": self.is_simulated,
            "real_sensors": bool(self.external),
            "external": list(self.external),
            "peak": self.peak.size if self.peak else None,
            "peak_step": self.peak.step if self.peak else None,
            "energy": self.energy,
            "gamma": self.gamma.value,
            "certificate": self.gamma.failure is None,
            "certificate_failure": self.gamma.failure,
            "path_margin": self.path_margin,
            "proofs": [vars(proof) for proof in self.proofs],
        }

    def text(self) -> str:
        return "\n".join([*self._head(), *self._peak(), *self._proofs(), *self._faults()])

    def _head(self) -> list[str]:
        if not self.agrees:
            answer = "DIVERGES"
        else:
            answer = "agrees" if self.finished else "agrees as far as it goes, but is not whole"
        lines = [
            f"{self.recording}: {answer}",
            f'run "{self.run}", seed {self.seed}, {self.steps} of {self.planned} steps, {self.messages} messages, '
            f"{self.status}{f': {self.reason}' if self.reason else ''}",
        ]
        if self.damage:
            lines.append(f"the file: {self.damage}")
        return lines

    def _proofs(self) -> list[str]:
        lines = [proof.text() for proof in self.proofs]
        if self.first_divergence:
            lines.append(
                f"first divergence, {self.first_divergence.text()}: "
                f"gap {self.first_divergence.gap:.1e}, tolerance {self.tolerance:.1e}"
            )
        elif self.worst:
            lines.append(
                f"largest gap {self.worst_gap:.1e}, at step {self.worst.step} in {self.worst.place}; "
                f"tolerance {self.tolerance:.1e} ({1.0 - self.worst_gap / self.tolerance:.0%} left)"
            )
        return lines

    def _faults(self) -> list[str]:
        lines = []
        for word, faults in (("missing", self.missing), ("double", self.duplicates)):
            if faults.total:
                named = ", ".join(f"{place.topic} step {place.step}" for place in faults.first[:5])
                more = f" and {faults.total - 5} more" if faults.total > 5 else ""
                lines.append(f"{word}: {faults.total} ({named}{more})")
        for fault in (*self.strange, *self.numbering)[:5]:
            lines.append(f"strange: {fault}")
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
            lines.append(f"peak |z~| {self.peak.size:.4g}{against} at step {self.peak.step}{bound}")
        return [*lines, self.gamma.text()]

    def _bound(self, energy: float) -> str:
        return f", gamma sqrt(energy) {self.gamma.value * energy**0.5:.4g} with gamma {self.gamma.value:.5g}"
