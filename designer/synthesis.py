"""From a problem to gains: pick a method, design, and put the ladder on."""

from __future__ import annotations

import time
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
from designer.proof.certificate import lyapunov_matrix
from designer.search.descent import Budget, Progress
from designer.search.effort import BUDGET, default_method
from designer.search.exact_design import confirmed, design_exact, lower_end

EXACT = "exact"  # gains designed for the exact gain; no LMI, and a certificate of its own kind
_LADDER_STATES = 500  # n nx up to which the exact gain of the LMI's gains is worth its time


def design(
    problem: Problem,
    *,
    method: str | None = None,
    budget: float = BUDGET,
    progress: Callable[[Progress], None] | None = None,
    dask: str | None = None,
) -> Gains:
    """Gains for every mode and link, with a gamma that the check without a solver confirms.

    The default method is "exact"; for more than 200 nodes of whom some hear very many others it is "decomposed".
    `progress` and `budget` are for the method "exact", which returns its best gains when its seconds are over, the
    proof after that, and on KeyboardInterrupt. `dask`: the address of a cluster for the windows of large networks.
    Raises InputError for an unknown method, Unattainable where no gains or no certificate were found, with the reason
    as far as it is known.
    """
    method = default_method(problem) if method is None else method
    if method not in METHODS and method != EXACT:
        raise InputError(f'method "{method}" does not exist; the methods are {listed([*METHODS, EXACT])}')
    refuse_nothing_to_estimate(problem)
    refuse_hopeless(problem)
    try:
        if method == EXACT:
            gains = design_exact(problem, budget=Budget(budget), progress=progress, dask=dask)
        else:
            gains = _with_exact(design_by_lmi(problem, method))
    except Unattainable as error:
        raise explained(problem, error, _solvable) from None
    certificate = gains.certificate.model_copy(update={"floor": floor(problem)})
    return with_worst_case(gains.model_copy(update={"certificate": certificate}))


def _with_exact(gains: Gains) -> Gains:
    """The gains of an LMI with their exact gain; where it is below Theorem 1's gamma it is proved beside that.

    The P that an LMI gave satisfies (17), so it ends the recursion too. Not for networks where that takes too long.
    """
    problem, certificate = gains.problem, gains.certificate
    if problem.n * problem.nx > _LADDER_STATES:
        return gains
    started = time.perf_counter()
    gain = exact_gain(error_model(problem, *stacked_gains(gains)))
    exact = gain.bounds
    found: dict[str, object] = {"exact": exact}
    if exact is not None and exact[1] < certificate.gamma:
        verdict = confirmed(problem, gains.K, gains.H, exact[1], P=lyapunov_matrix(gains))
        if verdict.holds and verdict.gamma < certificate.gamma:
            low = lower_end(problem, gains.K, gains.H, gain)
            found |= {
                "exact": (low, verdict.gamma),
                "gamma": verdict.gamma,
                "kind": "exact",
                "theorem1_gamma": certificate.gamma,
                "verified": f"{certificate.verified}; the recursion of the exact gain: {verdict.arithmetic}",
                "margins": certificate.margins | verdict.margins,
            }
    spent = time.perf_counter() - started
    seconds = gains.seconds | {name: gains.seconds[name] + spent for name in ("certify", "total")}
    return gains.model_copy(update={"certificate": certificate.model_copy(update=found), "seconds": seconds})


def _solvable(problem: Problem) -> bool:
    """Whether the decomposed LMI has an answer that is confirmed."""
    from designer.lmi import decomposed

    try:
        first_confirmed(problem, "decomposed", decomposed.answers(problem, last_resort=False))
    except Unattainable:
        return False
    return True
