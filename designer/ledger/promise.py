"""What the bound says at one step, as a value and in a line."""

from __future__ import annotations

from typing import NamedTuple

SHARE = 0.01  # a term below this share no longer counts
VOID_ABOVE = 1e3  # times gamma: a bound that says nothing


class Owed(NamedTuple):
    """What a jump has left."""

    what: str
    size: float  # (E|z_tilde_m(k)|^2)^(1/2); where `is_unit`, for a jump of length 1
    is_unit: bool
    within: int | None  # steps as designed until it is below SHARE of what it was at most


class Promise(NamedTuple):
    """What the bound says at one step. `factor` times gamma is the gain to z_tilde now."""

    status: str  # "valid", "valid plus" a term, or "void"
    gamma: float
    factor: float
    within: int | None  # steps as designed until `factor` is below 1 + SHARE, for good; 0 where it is
    owed: tuple[Owed, ...]
    reason: str  # why it is void
    step: int | None  # since when

    def text(self) -> str:
        """In one line, for people."""
        if self.status == "void":
            return f"void since step {self.step}: {self.reason}"
        terms = []
        if self.factor > 1.0 + SHARE:
            when = "" if self.within is None else f", below {SHARE:.0%} after {self.within} steps as designed"
            terms.append(f"{self.factor - 1.0:.1%} of gamma for faults{when}")
        for owed in self.owed:
            unit = f" times its length, for {owed.what}" if owed.is_unit else f" for {owed.what}"
            when = "" if owed.within is None else f", below {SHARE:.0%} of its most after {owed.within} steps"
            terms.append(f"{owed.size:.3g}{unit}{when}")
        return f"valid plus {'; plus '.join(terms)}" if terms else "valid"
