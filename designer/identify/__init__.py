"""Recorded runs against the probabilities of their model: what fits, what does not, and what was observed instead."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from agent.contract.errors import EXIT_GOOD, EXIT_NO, InputError, counted
from agent.contract.gains import Gains
from agent.contract.problem import Problem
from designer.box.extent import box_in
from designer.gain.exact import Gain, exact_gain
from designer.identify.counts import Counts, counts_of, total
from designer.identify.estimate import observed, tolerant
from designer.identify.fit import Finding, findings
from designer.model.error_model import error_model, stacked_gains
from designer.model.mismatch import error_model_of
from designer.replay.log import Log


class Identification(NamedTuple):
    """The answer, for people, for tools, and as a problem."""

    gains: Gains
    logs: tuple[str, ...]
    steps: int
    level: float
    counts: Counts
    findings: tuple[Finding, ...]
    designed: Gain  # the exact gain of the gains as their file has the network
    problem: Problem | None  # with what was observed, and tolerances; None: there is none, because `refusal`
    tolerances: str  # what they are, or why there are none
    refusal: str
    gain: Gain | None  # the exact gain of the same gains there

    @property
    def fits(self) -> bool:
        return all(finding.fits for finding in self.findings)

    @property
    def tests(self) -> int:
        """How many could have gone either way."""
        return sum(finding.p is not None and not finding.is_certain for finding in self.findings)

    @property
    def exit_code(self) -> int:
        return EXIT_GOOD if self.fits else EXIT_NO

    def document(self) -> dict[str, Any]:
        """For --json."""
        return {
            "recordings": list(self.logs),
            "steps": self.steps,
            "fits": self.fits,
            "level": self.level,
            "tests": self.tests,
            "findings": [finding.document() for finding in self.findings],
            "gamma": self.gains.certificate.gamma,
            "exact_as_designed": self.designed.bounds,
            "exact_as_observed": self.gain.bounds if self.gain else None,
            "stable_as_observed": self.gain.stable if self.gain else None,
            "tolerances": self.tolerances,
            "refusal": self.refusal,
        }

    def text(self) -> str:
        """The facts for people."""
        wrong = [finding.what for finding in self.findings if not finding.fits]
        answer = f"does NOT fit: {'; '.join(wrong)}" if wrong else "nothing speaks against the model"
        lines = [
            f"{self.gains.problem.name}, {counted(len(self.logs), 'run')}, {counted(self.steps, 'step')}: {answer}",
            f"tests      {self.tests} at once, level {self.level:g} in all (Holm)",
            f"intervals  each at {1.0 - self.level:.4g}",
        ]
        lines += [] if self.problem is None else [f"tolerances {self.tolerances}"]
        lines += [line for finding in self.findings for line in finding.lines()]
        return "\n".join([*lines, f"exact gain {self._gain_text()}"])

    def _gain_text(self) -> str:
        before = _number(self.designed)
        if self.gain is None:
            return f"{before} as designed; as observed none: {self.refusal}"
        if not self.gain.stable:
            return f"{before} as designed; as observed the errors do NOT die out, as far as floats tell"
        return f"{before} as designed, {_number(self.gain)} of the same gains as observed"


def identify(logs: Sequence[Log], *, level: float = 0.01) -> Identification:
    """Compare the runs with the model of their gains, which must be the same. `level` is that of all tests together."""
    gains = logs[0].gains
    for log in logs[1:]:
        if log.gains.digest() != gains.digest():
            raise InputError(f"{log.label} has other gains than {logs[0].label}; identify takes runs of the same gains")
    counts = total([counts_of(log) for log in logs])
    refusal, problem, gain = "", None, None
    try:
        problem = observed(gains.problem, counts)
    except InputError as error:
        refusal = str(error)
    tolerances = ""
    if problem is not None:
        try:
            wide = tolerant(problem, gains.problem, counts, level=level)
            box_in(wide)
            problem = wide
        except InputError as error:  # more may vary than is looked at
            tolerances = f"left out: {error}"
    K_bar, H_bar = stacked_gains(gains)
    if problem is not None:
        gain = exact_gain(error_model_of(problem, gains.problem.beta, K_bar, H_bar))
    return Identification(
        gains=gains,
        logs=tuple(log.label for log in logs),
        steps=sum(log.steps for log in logs),
        level=level,
        counts=counts,
        findings=tuple(findings(gains.problem, counts, level=level)),
        designed=exact_gain(error_model(gains.problem, K_bar, H_bar)),
        problem=problem,
        tolerances=tolerances or f"of all probabilities at once, at {1.0 - level:.4g}",
        refusal=refusal,
        gain=gain,
    )


def _number(gain: Gain) -> str:
    return f"{gain.high:.6g}" if gain.stable else "not stable"
