"""What a proof found: every inequality with its sign, and the verdict on all of them."""

from __future__ import annotations

from typing import NamedTuple

from designer.proof.balls import Sign

GRAMIAN = "M G M' < g"  # what decides where chance has no say


class Verdict(NamedTuple):
    """Whether what is claimed is proved; where it is not, the inequality that fails, and by how much."""

    holds: bool
    gamma: float
    arithmetic: str
    failure: str | None
    margins: dict[str, float]  # of each inequality and mode: the least eigenvalue after scaling; not proved: <= 0
    low: float | None = None  # the exact gain is not below it, which is proved too; None: nobody said, or it is not
    interval_is_false: bool = False  # gamma is proved, and an end that was claimed of the exact gain proved false

    @property
    def by_gramian(self) -> bool:
        """Whether chance has no say, so that there was neither a P nor a recursion."""
        return any(name.startswith(GRAMIAN) for name in self.margins)

    def joined(self, other: Verdict) -> Verdict:
        """Both, with this one's gamma."""
        arithmetic = "; ".join(dict.fromkeys([self.arithmetic, other.arithmetic]))
        return self._replace(
            holds=self.holds and other.holds,
            arithmetic=arithmetic,
            failure=self.failure or other.failure,
            margins=self.margins | other.margins,
        )


class Finding(NamedTuple):
    """One inequality, looked at."""

    inequality: str
    mode: str
    sign: Sign
    at: str = ""  # more about where
    exhausted: bool = False  # the steps, not the digits: more of these would not decide it

    @property
    def name(self) -> str:
        return f"{self.inequality} mode {self.mode}"


def found(inequality: str, modes: tuple[str, ...], signs: list[Sign], at: str = "") -> list[Finding]:
    """A finding for each mode."""
    return [Finding(inequality, mode, sign, at) for mode, sign in zip(modes, signs, strict=True)]


def proved(findings: list[Finding]) -> bool:
    return all(finding.sign.proved for finding in findings)


def refuted(findings: list[Finding]) -> bool:
    return any(finding.sign.refuted for finding in findings)


def margins(findings: list[Finding]) -> dict[str, float]:
    """The least of every inequality and mode."""
    least: dict[str, float] = {}
    for finding in findings:
        margin = finding.sign.least if finding.sign.proved else min(finding.sign.least, 0.0)
        least[finding.name] = min(margin, least.get(finding.name, margin))
    return least


def failure(findings: list[Finding], arithmetic: str) -> str | None:
    """What is wrong in one sentence, what is proved false first; None where all is proved."""
    failed = [finding for finding in findings if not finding.sign.proved]
    if not failed:
        return None
    first = next((finding for finding in failed if finding.sign.refuted), failed[0])
    where, least = f'{first.inequality} fails in mode "{first.mode}"{first.at}', f"{first.sign.least:.3g}"
    if first.sign.refuted:
        return f"{where}: it is false, its least scaled eigenvalue is {least} and must be positive"
    if first.exhausted:
        return f"{where}: undecided, and a proof gets no more steps; it takes fewer at a gamma a little larger"
    return f"{where}: it is not proved, its least scaled eigenvalue is about {least}, which {arithmetic} leaves open"
