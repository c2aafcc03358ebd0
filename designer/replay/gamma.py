"""The gamma of the gains in a recording: a number in a file, until their certificate is proved again."""

from __future__ import annotations

from dataclasses import dataclass

from agent.contract.errors import InputError
from agent.contract.extras import needing
from agent.contract.gains import Gains
from designer.start import left_by_start


@dataclass(frozen=True)
class Gamma:
    """A gamma, and whether the certificate beside it proves it."""

    value: float
    is_claimed: bool
    failure: str | None  # why it is not proved
    is_proved: bool = False  # though something else that is claimed is false
    start: float | None = 0.0  # sqrt E|z~|^2 that the initial error alone leaves at most, proved; None: not found
    is_checked: bool = True  # what is needed for that is installed

    def text(self) -> str:
        if not self.is_claimed:
            return "certificate  none: gamma is not claimed"
        if not self.is_checked:
            return f"certificate  NOT CHECKED: {self.failure}; whether gamma is proved for these gains is not known"
        if self.failure is not None and self.is_proved:
            return f"certificate  FAILS: {self.failure}; gamma itself is proved"
        if self.failure is not None:
            return f"certificate  FAILS: {self.failure}; gamma is not proved for these gains"
        start = "from zero initial error" if self.start == 0.0 else "beside what the initial error leaves"
        return (
            "certificate  holds: gamma bounds sup_k E|z~(k)|^2 <= gamma^2 sum |w|^2, in the mean over modes, losses "
            f"and deliveries, {start}; one run may exceed it"
        )


def checked_gamma(gains: Gains) -> Gamma:
    """What the gains claim, proved again from their own numbers."""
    claim, problem = gains.certificate, gains.problem
    if not claim.holds:
        return Gamma(claim.gamma, is_claimed=False, failure="gamma is not claimed")
    from designer.proof.certificate import verify  # it loads ball arithmetic, which nothing else of a replay needs

    try:
        with needing("the proof of so large a network"):
            verdict = verify(gains)
    except InputError as error:
        if isinstance(error.__cause__, ModuleNotFoundError):
            return Gamma(claim.gamma, is_claimed=True, failure=str(error), is_checked=False)
        return Gamma(claim.gamma, is_claimed=True, failure=str(error))
    start = 0.0 if problem.plant.initial_error is None else left_by_start(problem, gains.K, gains.H)
    is_proved = verdict.holds or verdict.interval_is_false
    return Gamma(claim.gamma, is_claimed=True, failure=verdict.failure, is_proved=is_proved, start=start)
