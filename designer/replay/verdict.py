"""What a replay found: a value, its JSON, and its text for people."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from agent.contract.errors import EXIT_BROKEN, EXIT_GOOD, EXIT_NO
from designer.replay.census import Faults

CLAIMS = {
    1: "plant, sensors, draws and each node's own words agree",
    2: "one step of the central model from the log gives the log",
    3: "the central model running freely stays with the log",
    4: "every message is there once",
    5: "path inequality |z~(k)|^2 <= gamma_path(k)^2 sum |w|^2",
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

    def text(self) -> str:
        whose = f'of node "{self.node}"' if self.node is not None else "of the plant"
        if self.field == "mode" and self.node is None:
            whose = "of the coordinator"
        values = (repr(value) if isinstance(value, float) else f'"{value}"' for value in (self.logged, self.expected))
        return "step {}: {} {} is {}, expected {}".format(self.step, self.field, whose, *values)


@dataclass(frozen=True)
class Proof:
    """The outcome of one of the five proofs."""

    number: int
    holds: bool
    compared: int  # numbers, names or messages that were compared; 0 where nothing could be
    worst_gap: float
    note: str = ""


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
    has_plant: bool  # False: real sensors, so estimates are compared, and nothing is known of the error
    proofs: tuple[Proof, ...]
    worst_gap: float
    worst: Divergence | None  # where the worst gap is
    tolerance: float
    first_divergence: Divergence | None
    missing: Faults
    duplicates: Faults
    strange: tuple[str, ...]  # what should not be in the file
    numbering: tuple[str, ...]  # faults in the senders' numbering
    peak: float | None  # max over k of |z_tilde(k)|
    energy: float | None  # sum of |w|^2
    gamma: float
    path_margin: float | None  # smallest 1 - |z_tilde(k)| / (gamma_path(k) sqrt(energy before k))

    @property
    def agrees(self) -> bool:
        """What is in the file agrees. Messages that a cut file lacks are not held against it."""
        return all(proof.holds for proof in self.proofs)

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
            "real_sensors": not self.has_plant,
            "peak": self.peak,
            "energy": self.energy,
            "gamma": self.gamma,
            "path_margin": self.path_margin,
            "proofs": [vars(proof) for proof in self.proofs],
        }

    def text(self) -> str:
        return "\n".join([*self._head(), *self._proofs(), *self._faults(), *self._peak()])

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
        lines = []
        for proof in self.proofs:
            outcome = "FAILS" if not proof.holds else ("holds" if proof.compared else "  -  ")
            worst = f", worst gap {proof.worst_gap:.1e}" if proof.number <= 3 and proof.compared else ""
            note = f"; {proof.note}" if proof.note else ""
            lines.append(f"  {proof.number} {outcome}  {CLAIMS[proof.number]} ({proof.compared} compared{worst}{note})")
        if self.first_divergence:
            lines.append(
                f"first divergence, {self.first_divergence.text()}: "
                f"gap {self.first_divergence.gap:.1e}, tolerance {self.tolerance:.1e}"
            )
        elif self.worst:
            lines.append(
                f"worst gap {self.worst_gap:.1e} within tolerance {self.tolerance:.1e} "
                f"(margin {1.0 - self.worst_gap / self.tolerance:.0%}); {self.worst.text()}"
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
        if self.peak is None or self.energy is None:
            return ["no simulated plant: estimates were compared, nothing is known of the error"]
        bound = self.gamma * self.energy**0.5
        margin = (
            "" if self.path_margin is None else f"; smallest margin to this path's own bound {self.path_margin:.1%}"
        )
        return [
            f"peak |z~| {self.peak:.4g}, gamma sqrt(energy) {bound:.4g} with gamma {self.gamma:.5g}{margin}",
            "gamma bounds sup_k E|z~(k)|^2 <= gamma^2 sum |w|^2: in the mean over modes and losses, from zero "
            "initial error; one run may exceed it",
        ]
