"""What a proof found: every inequality with its sign, and the verdict on all of them, with as many bits as it takes."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import flint
from flint import ctx

from designer.proof.balls import Sign

BITS = (128, 256, 512, 1024)  # carried one after the other, until every inequality is proved or one proved false


class Verdict(NamedTuple):
    """Whether the certificate is proved; where it is not, the inequality that fails, and by how much."""

    holds: bool
    gamma: float
    arithmetic: str
    failure: str | None
    margins: dict[str, float]  # of each inequality and mode: the least eigenvalue after scaling; not proved: <= 0


class Finding(NamedTuple):
    """One inequality, looked at."""

    inequality: str
    mode: str
    sign: Sign
    at: str = ""  # more about where

    @property
    def name(self) -> str:
        return f"{self.inequality} mode {self.mode}"


def decided(findings: Callable[[], list[Finding]], gamma: float) -> Verdict:
    """The verdict on all findings, with as many bits as it takes; what is proved false is named first."""
    for bits in BITS:
        with ctx.workprec(bits):
            found = findings()
        failed = [finding for finding in found if not finding.sign.proved]
        false = [finding for finding in failed if finding.sign.refuted]
        if false or not failed:
            break
    margins: dict[str, float] = {}
    for finding in found:
        least = finding.sign.least if finding.sign.proved else min(finding.sign.least, 0.0)
        margins[finding.name] = min(least, margins.get(finding.name, least))
    failure = _text((false or failed)[0], bits) if failed else None
    return Verdict(
        failure is None, gamma, f"ball arithmetic of {bits} bits (flint {flint.__version__})", failure, margins
    )


def _text(failed: Finding, bits: int) -> str:
    where, least = f'{failed.inequality} fails in mode "{failed.mode}"{failed.at}', f"{failed.sign.least:.3g}"
    if failed.sign.refuted:
        return f"{where}: it is false, its least scaled eigenvalue is {least} and must be positive"
    return f"{where}: it is not proved, its least scaled eigenvalue is about {least}, which {bits} bits leave open"
