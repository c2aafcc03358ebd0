"""What a file claims that no gains have less than by an LMI: proved again, without a solver."""

from __future__ import annotations

from typing import NamedTuple

from agent.contract.gains import Certificate, Gains
from designer.proof.least import at_least
from designer.proof.silent import at_least_by_silence


class LeastAgain(NamedTuple):
    """`holds`: proved, or what is claimed is false or not shown by the weights that are to; None: nothing shows it."""

    holds: bool | None
    how: str


def least_again(gains: Gains) -> LeastAgain | None:
    """None: nothing is claimed.

    P = diag{R, Q(s)} for which `gains` have less by Theorem 1 refutes it: that P has to be proved before.
    """
    claim, weights = gains.certificate, gains.certificate.lmi_weights
    if claim.lmi_least is None:
        return None
    if claim.form == "structured" and _less(claim):
        return LeastAgain(False, "its own have less")
    silent = at_least_by_silence(gains.problem)
    if silent is not None and silent >= claim.lmi_least:
        return LeastAgain(True, "no node sees some disturbance")
    if weights is None:
        return LeastAgain(None, "no weights are stored that would show it")
    proved = at_least(gains.problem, weights.matrices(gains.problem.mode_names), weights.states)
    if proved is not None and proved >= claim.lmi_least:
        return LeastAgain(True, "by the weights on (17) that are stored")
    return LeastAgain(False, f"its weights show {'nothing' if proved is None else f'no more than {proved}'}")


def _less(claim: Certificate) -> bool:
    return claim.by_theorem1 is not None and claim.lmi_least is not None and claim.by_theorem1 < claim.lmi_least
