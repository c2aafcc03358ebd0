"""From a problem to gains: pick a method, design, and put the ladder on."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Any

from agent.contract.errors import InputError, Unattainable, listed
from agent.contract.gains import Gains
from agent.contract.problem import Problem
from designer.box.design import ForBox, design_for_box
from designer.box.extent import Box
from designer.coordinates import Coordinates
from designer.diagnosis import explained, refuse_hopeless, refuse_nothing_to_estimate
from designer.gain.floor import floor_below
from designer.gain.worst_case import with_worst_case
from designer.lmi.lmi_design import METHODS, design_by_lmi, first_confirmed, gains_that_ignore
from designer.model.units import NaturalUnits
from designer.patience import Budget, TimeIsUp, looking
from designer.proof.certificate import lyapunov_matrix
from designer.search.baselines import BASELINES, design_baseline
from designer.search.descent import Progress
from designer.search.effort import default_budget, default_method
from designer.search.exact_design import confirmed, design_exact, gain_of, lower_end
from designer.search.lmi_apart import design_apart

EXACT = "exact"  # gains designed for the exact gain; no LMI, and a certificate of its own kind
_IGNORING_STATES = 250  # n nx up to which gains that ignore all are compared, where a search or a proof was cut short
SHARE_OF_BOX = 0.5  # of a search's time
_SHARE_OF_WEIGHTS = 0.002  # of the budget, for what no gains are below by an LMI
_LADDER_STATES = 500  # n nx up to which the exact gain of the LMI's gains is worth its time


def methods() -> list[str]:
    """What `design` knows: the LMI's, the search, and what both are compared with."""
    return [*METHODS, EXACT, *BASELINES]


def design(
    problem: Problem,
    *,
    method: str | None = None,
    budget: float | Budget | None = None,
    progress: Callable[[Progress], None] | None = None,
    dask: str | None = None,
    peak_slack: float = 0.0,
) -> Gains:
    """Gains for every mode and link, with a gamma that the check without a solver confirms.

    The default method is "exact"; for more than 200 nodes of whom some hear very many others it is "decomposed".
    `budget`: seconds for all of it, by default as many as the problem is worth. When they are over, or a signal came
    that the budget was told of, the best gains so far are proved and returned, for a stable plant those that ignore all
    measurements at least; else there is KeyboardInterrupt. What was left out is said in the budget. `progress` is for
    the method "exact".
    `dask`: the address of a cluster for the windows of large networks.
    `peak_slack`, for that method too: gamma may be that part larger than the least one, for gains with less noise.
    Raises InputError for an unknown method, Unattainable where no gains or no certificate were found, with the reason
    as far as it is known.
    """
    budget, started = _budget(problem, budget), time.perf_counter()
    method = default_method(problem) if method is None else method
    if method not in methods():
        raise InputError(f'method "{method}" does not exist; the methods are {listed(methods())}')
    if peak_slack and method != EXACT:
        raise InputError(f"--peak-slack starts from the least peak that method exact finds; method {method} has none")
    if not 0.0 <= peak_slack < math.inf:
        raise InputError(f"--peak-slack {peak_slack:g}: a part of gamma, 0 or more; 0.05 and 5% are the same")
    refuse_nothing_to_estimate(problem)
    refuse_hopeless(problem)
    try:
        with looking(budget.check_last):
            if method in BASELINES:
                return with_worst_case(design_baseline(problem, method, budget))
            if method == EXACT:
                gains = _exact_in_natural_units(problem, budget, progress, dask, peak_slack)
            else:
                apart = design_apart(problem, method, budget)
                gains = _with_exact(apart or design_by_lmi(problem, method, budget), budget)
    except Unattainable as error:
        least = gains_that_ignore(problem, method, str(error), started) if method == EXACT else None
        if least is None:
            reason = partial(explained, problem, error, _solvable)
            raise budget.compared("what would have to change", reason) or error from None
        gains = least
    except (KeyboardInterrupt, TimeIsUp) as stopped:
        least = None if _from_elsewhere(stopped, budget) else gains_that_ignore(problem, method, _why(stopped), started)
        if least is None:
            raise
        gains = least
    cut = method == EXACT and not gains.solver.status.startswith("converged")
    if (cut or budget.asked > 1) and problem.n * problem.nx <= _IGNORING_STATES:
        ended = gains.solver.status.partition(";")[0]
        why = f"{ended}, and nothing found by then has a lower gamma that is proved"
        ignorant = gains_that_ignore(problem, method, why, started)
        gains = min([gains, *([] if ignorant is None else [ignorant])], key=lambda each: each.gamma)
    found = {
        "floor": budget.compared("the floor", lambda: floor_below(problem, gains.certificate.gamma)),
        **_of_lmi(gains, budget),
    }
    certificate = gains.certificate.model_copy(update=found)
    return with_worst_case(gains.model_copy(update={"certificate": certificate}))


def _budget(problem: Problem, budget: float | Budget | None) -> Budget:
    """One that may have begun."""
    if isinstance(budget, Budget):
        return budget
    return Budget(default_budget(problem) if budget is None else budget)


def _from_elsewhere(stopped: BaseException, budget: Budget) -> bool:
    """Whether this came from somebody who does not tell the budget, and wants all to end."""
    return isinstance(stopped, KeyboardInterrupt) and not budget.asked


def _why(stopped: BaseException) -> str:
    return "it was interrupted" if isinstance(stopped, KeyboardInterrupt) else "time was up"


def design_in_box(
    problem: Problem,
    box: Box,
    *,
    method: str | None = None,
    budget: float | Budget | None = None,
    progress: Callable[[Progress], None] | None = None,
    dask: str | None = None,
    peak_slack: float = 0.0,
) -> ForBox:
    """Gains with a gamma that is proved for every model of the box, no larger than that of the nominal design.

    As `design`, which begins and takes up to half of the budget. Other methods do not design for a box, nor does
    `peak_slack`: of their gains it is proved what holds.
    """
    budget = _budget(problem, budget)
    with budget.leaving(SHARE_OF_BOX):
        nominal = design(problem, method=method, budget=budget, progress=progress, dask=dask, peak_slack=peak_slack)
    found = from_nominal(problem, box, nominal, budget, progress=progress)
    if found is None:
        raise KeyboardInterrupt
    return found


def from_nominal(
    problem: Problem,
    box: Box,
    nominal: Gains,
    budget: Budget,
    *,
    progress: Callable[[Progress], None] | None = None,
) -> ForBox | None:
    """The same from gains that were designed without the box; None where a second signal came before it was proved."""
    search = not (budget.asked or nominal.solver.status.startswith("interrupted"))
    budget.over = not search
    return budget.to_its_end(
        lambda: design_for_box(problem, box, nominal, search=search, budget=budget, progress=progress),
        lambda: None,
    )


def _of_lmi(gains: Gains, budget: Budget) -> dict[str, Any]:
    """What no gains have less than by an LMI, where that is what they come from or what they are compared with."""
    if gains.certificate.lmi_gamma is None:
        return {}
    from designer.undercut import Undercut, undercut  # scipy takes long to import

    seconds, offered = _SHARE_OF_WEIGHTS * budget.seconds, gains.certificate.lmi_weights
    least = budget.compared(
        "the least that the LMI can give", lambda: undercut(gains.problem, offered=offered, seconds=seconds)
    )
    gamma, weights, why_not = least or Undercut(None, why_not="time was up, or a signal came")
    return {"lmi_least": gamma, "lmi_weights": weights, "lmi_why_not": why_not}


def _exact_in_natural_units(
    problem: Problem,
    budget: Budget,
    progress: Callable[[Progress], None] | None,
    dask: str | None,
    slack: float,
) -> Gains:
    """The same gains whatever the units: a problem in others is the same one in natural units, number by number.

    Where M cancels, z itself is a state in the search; if that leads nowhere, as where what z is made of grows and
    sensors hardly tell it apart, the states are those of the problem after all.
    """
    coordinates = Coordinates.of(problem)
    if coordinates is not None:
        with suppress(Unattainable):
            return _searched(problem, NaturalUnits(problem, coordinates), budget, progress, dask, slack)
    return _searched(problem, NaturalUnits(problem), budget, progress, dask, slack)


def _searched(
    problem: Problem,
    natural: NaturalUnits,
    budget: Budget,
    progress: Callable[[Progress], None] | None,
    dask: str | None,
    slack: float,
) -> Gains:
    """Found in natural units, and proved of the problem that was given, with gains as they are rounded for it.

    What is said of an LMI beside that is computed, of the problem in natural units.
    """
    unit, tell = natural.output, progress
    if progress is not None and unit != 1.0:

        def tell(at: Progress) -> None:
            noise = None if at.noise is None else unit**2 * at.noise
            progress(at._replace(gamma=unit * at.gamma, noise=noise))

    how: dict[str, Any] = {"slack": slack, "held": natural.held, "natural": natural}
    gains = design_exact(natural.problem, budget=budget, progress=tell, dask=dask, **how)
    K, H = natural.back(gains.K, gains.H)
    lmi_gamma, lmi_exact = gains.certificate.lmi_gamma, gains.certificate.lmi_exact
    compared = {
        "lmi_gamma": None if lmi_gamma is None else unit * lmi_gamma,
        "lmi_exact": None if lmi_exact is None else (unit * lmi_exact[0], unit * lmi_exact[1]),
    }
    certificate = gains.certificate.model_copy(update=compared)
    update = {"problem": problem, "problem_digest": problem.digest(), "K": K, "H": H, "certificate": certificate}
    return gains.model_copy(update=update)


def _with_exact(gains: Gains, budget: Budget) -> Gains:
    """The gains of an LMI with their exact gain; where it is below Theorem 1's gamma it is proved beside that.

    The P that an LMI gave satisfies (17), so it ends the recursion too. Not for networks where that takes too long.
    """
    problem, certificate = gains.problem, gains.certificate
    if certificate.kind == "exact":  # there is nothing beside it
        return gains
    if problem.n * problem.nx > _LADDER_STATES:
        return gains
    return budget.compared("the exact gain of these gains", lambda: _with_gain(gains)) or gains


def _with_gain(gains: Gains) -> Gains:
    """With it, and what is proved of it."""
    problem, certificate = gains.problem, gains.certificate
    started = time.perf_counter()
    gain = gain_of(problem, gains.K, gains.H)
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

    natural = NaturalUnits(problem)
    try:
        first_confirmed(natural, "decomposed", decomposed.answers(natural.problem, last_resort=False), Budget())
    except Unattainable:
        return False
    return True
