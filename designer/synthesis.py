"""From a problem to gains: pick a method, design, and put the ladder on."""

from __future__ import annotations

from collections.abc import Callable

from agent.contract.errors import InputError, Unattainable, listed
from agent.contract.gains import Gains
from agent.contract.problem import Problem
from designer.diagnosis import explained, refuse_hopeless, refuse_nothing_to_estimate
from designer.gain.exact import exact_gain
from designer.gain.floor import floor
from designer.gain.worst_case import with_worst_case
from designer.lmi.lmi_design import METHODS, design_by_lmi, first_confirmed
from designer.model.error_model import error_model, stacked_gains
from designer.search.descent import Progress
from designer.search.effort import default_method
from designer.search.exact_design import design_exact

EXACT = "exact"  # gains designed for the exact gain; no LMI, and a certificate of its own kind
_LADDER_STATES = 250  # n nx up to which the exact gain of the LMI's gains is worth its time


def design(problem: Problem, *, method: str | None = None, progress: Callable[[Progress], None] | None = None) -> Gains:
    """Gains for every mode and link, with a gamma that the check without a solver confirms.

    The default method is "exact" where that takes at most about ten minutes, else "decomposed".
    `progress` is called during the method "exact" only, which also returns its best gains on KeyboardInterrupt.
    Raises InputError for an unknown method, Unattainable where no gains or no certificate were found, with the reason
    as far as it is known.
    """
    method = default_method(problem) if method is None else method
    if method not in METHODS and method != EXACT:
        raise InputError(f'method "{method}" does not exist; the methods are {listed([*METHODS, EXACT])}')
    refuse_nothing_to_estimate(problem)
    refuse_hopeless(problem)
    try:
        gains = design_exact(problem, progress=progress) if method == EXACT else design_by_lmi(problem, method)
    except Unattainable as error:
        raise explained(problem, error, _solvable) from None
    return with_worst_case(_with_ladder(gains))


def _with_ladder(gains: Gains) -> Gains:
    """With the floor, and the exact gain of the gains where their certificate has none and the network is not large."""
    problem, certificate = gains.problem, gains.certificate
    exact = certificate.exact
    if exact is None and problem.n * problem.nx <= _LADDER_STATES:
        exact = exact_gain(error_model(problem, *stacked_gains(gains))).bounds
    certificate = certificate.model_copy(update={"exact": exact, "floor": floor(problem)})
    return gains.model_copy(update={"certificate": certificate})


def _solvable(problem: Problem) -> bool:
    """Whether the decomposed LMI has an answer that is confirmed."""
    from designer.lmi import decomposed

    try:
        first_confirmed(problem, "decomposed", decomposed.answers(problem, last_resort=False))
    except Unattainable:
        return False
    return True
