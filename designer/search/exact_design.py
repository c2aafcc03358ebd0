"""From a problem to gains designed for the exact gain, with a certificate of kind "exact"; and one for any gains."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from agent.contract.arrays import Array
from agent.contract.errors import Unattainable
from agent.contract.gains import Certificate, Gains, LinkMatrices, Solver
from agent.contract.problem import Problem
from designer.coordinates import Coordinates
from designer.gain.exact import Gain, Operator, exact_gain, lyapunov
from designer.gain.floor import floor, floor_below
from designer.lmi import beyond_paper
from designer.lmi.recovery import recover
from designer.model.error_model import StackedGains, error_model, link_gains, model_of_gains
from designer.proof.findings import Verdict
from designer.proof.prover import FLOATS, MOST_STEPS_BELOW, Prover
from designer.proof.recursion import MOST_STEPS
from designer.search.descent import Budget, Descent, Progress, descend, to_its_end
from designer.search.effort import in_windows, refuse_without_memory, whole_fits
from designer.search.quiet import Found, quieter
from designer.search.starts import WEIGHT, consensus_gains, ignoring, least_variance_gains
from designer.search.windows import WEIGHT as WEIGHT_OF_WINDOWS
from designer.search.windows import window_gains
from designer.workers import greet_cluster

_LMI_STARTS = ("theorem2", "decomposed")
_LMI_STATES = 8  # n nx up to which an LMI, a second or two there, gives one more start
_LMI_ROUNDING = 1e-3  # a solver may state its bound so much too low
_BELOW = (0.0, 1e-9, 1e-8, 1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1, 0.5)
_LEAPT = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2)  # below either end, which takes little time; the last is tried first
_FAR_BELOW = (1e-6, 1e-4, 1e-3, 1e-2, 1e-1, 0.5)  # and by steps: a W fails after many, if not far below
SLOW = 0.98  # radius
_SOON, _FEW_STATES = 5000, 60  # steps, which a gamma a little larger may save; n nx up to which that is tried
_A_LITTLE_LARGER = (1.0, 1.0 + 1e-6, 1.0 + 1e-5)
_STARTS_OF_THE_END = 12  # of a large network: as long as its gains of least variance, so many times
_FEWEST = 400  # evaluations of the whole after windows: with less, it may lead to nothing that is stable
_PROVED_STATES = 250  # n nx up to which the lower end is proved at once
_ABOVE = (1.0, 1.0 + 1e-9, 1.0 + 1e-8, 1.0 + 1e-7, 1.0 + 1e-6, 1.0 + 1e-5, 1.0 + 1e-4)


def design_exact(
    problem: Problem,
    *,
    starts: Mapping[str, StackedGains] | None = None,
    first: float = math.inf,
    last: float = 0.0,
    budget: Budget | None = None,
    progress: Callable[[Progress], None] | None = None,
    dask: str | None = None,
    unit: float = 1.0,
    slack: float = 0.0,
    held: NDArray[np.bool_] | None = None,
) -> Gains:
    """Gains with the least exact gain that is found, from the given starts or, where there are none, from its own.

    With `slack` those of least noise whose exact gain is at most 1 + slack times that one.

    `first` and `last`: as `descend` takes them. KeyboardInterrupt ends the search, and so does the end of the budget,
    which begins when it is made; the best so far is returned. Windows are spread over a cluster at `dask`, if there is
    one. `unit`: of z; it counts in the status alone. `held` (nx, nx): entries of K_ij that are to be 0, unless windows
    are searched.
    """
    started, budget = time.perf_counter(), Budget() if budget is None else budget
    refuse_without_memory(problem)
    if dask is not None:
        greet_cluster(dask)  # before the starts, which may take minutes
    if math.isinf(floor(problem)):
        raise Unattainable(
            f"no gains can bound the error of {problem.name}: all sensors together do not show an unstable part of "
            "the plant that the disturbance drives, as far as floats tell; measure it"
        )
    own, lmi_gamma, stopped = starts is None, None, False
    if starts is None:
        try:
            starts, lmi_gamma = _starts(problem, held)
        except KeyboardInterrupt:
            if problem.plant.spectral_radius >= 1.0:
                raise
            own, starts, budget, stopped = False, {"ignoring all measurements": ignoring(problem)}, Budget(0.0), True
    try:
        lmi_exact = next(
            (exact_gain(error_model(problem, *starts[name])).bounds for name in _LMI_STARTS if name in starts), None
        )
    except KeyboardInterrupt:
        lmi_exact, budget, stopped = None, Budget(0.0), True
    if lmi_gamma is not None and (lmi_exact is None or lmi_gamma < (1.0 - _LMI_ROUNDING) * lmi_exact[0]):
        lmi_gamma = lmi_exact = None  # no bound of its own gains: the solver failed
    begun = time.perf_counter()
    if own and in_windows(problem):
        after = _STARTS_OF_THE_END * (begun - started)
        descent = _by_windows(problem, starts, after, budget=budget, progress=progress, dask=dask)
    else:
        descent = descend(problem, starts, first=first, last=last, budget=budget, progress=progress, held=held)
    descent = descent._replace(ended="interrupted") if stopped else descent
    chosen = descent.chosen
    if not chosen.gain.stable:
        raise Unattainable(
            f"no mean-square stable gains were found for {problem.name}: the best ones multiply E|error|^2 by "
            f"{chosen.gain.radius:.6g} in each step, as far as floats tell, and less than 1 is needed; "
            f"{_advice(problem)}"
        )
    method, steps, status, stacked, gain = "exact", descent.steps, _status(descent, unit), chosen[:2], chosen.gain
    if slack:
        pressed = descent.ended == "interrupted"
        if pressed:
            budget.end()
        found = quieter(problem, stacked, (1.0 + slack) * gain.high, budget=budget, progress=progress, held=held)
        found = found._replace(ended=descent.ended) if pressed else found
        method, steps, stacked = f"exact, peak slack {100.0 * slack:g} %", steps + found.steps, found.gains[:2]
        status = f"{_status_of_noise(found, unit)}; before: {status}"
        gain = to_its_end(lambda: exact_gain(error_model(problem, *stacked)))
    solved = time.perf_counter()
    K, H = link_gains(problem, *stacked)
    if progress is not None:
        phase, spent = "proving gamma and the lower end of the exact gain", time.perf_counter() - started
        progress(Progress("", 0.0, steps, gain.high, spent, gain.horizon, phase=phase, over=True))
    certificate = to_its_end(lambda: certify(problem, K, H, gain=gain))
    certificate = certificate.model_copy(update={"lmi_gamma": lmi_gamma, "lmi_exact": lmi_exact})
    ended = time.perf_counter()
    return Gains.of(
        problem,
        K,
        H,
        method=method,
        certificate=certificate,
        solver=Solver(
            name="barrier descent, numpy",
            version=np.__version__,
            status=status,
            iterations=steps,
            seconds=solved - begun,
        ),
        starts=begun - started,
        solve=solved - begun,
        certify=ended - solved,
    )


def _by_windows(
    problem: Problem,
    starts: Mapping[str, StackedGains],
    after: float,
    *,
    budget: Budget,
    progress: Callable[[Progress], None] | None,
    dask: str | None,
) -> Descent:
    """Windows first, from which the whole network's search goes on where there are time and memory for it.

    `after`: the seconds that choice and proof will take. Windows may take these too: they are worth the most.
    """

    def report(done: int, of: int) -> None:
        if progress is not None:
            phase = f"window {done} of {of}; Ctrl-C keeps what is done"
            progress(Progress("", WEIGHT_OF_WINDOWS, 0, math.inf, budget.spent, 0, phase=phase))

    windowed = window_gains(problem, starts["least variance"], budget=budget, dask=dask, report=report)
    budget.keep(after)
    ended = windowed.ended or (None if whole_fits(problem) else "windows alone, for want of memory")
    if ended:
        budget.end()
    start = {"windows": windowed.gains}
    descent = descend(problem, start, first=WEIGHT_OF_WINDOWS, budget=budget, progress=progress, fewest=_FEWEST)
    return descent._replace(ended=ended) if ended else descent


def _starts(problem: Problem, held: NDArray[np.bool_] | None) -> tuple[dict[str, StackedGains], float | None]:
    """Gains to start from, and gamma of the LMI where that gave one of them."""
    starts = {"least variance": least_variance_gains(problem, held)}
    if held is not None and problem.plant.spectral_radius < 1.0:
        starts["ignoring all measurements"] = ignoring(problem)  # where M cancels, few gains are better
    if lyapunov(Operator(error_model(problem, *starts["least variance"])))[0] is None:
        starts[f"consensus {WEIGHT}"] = consensus_gains(problem)
    if problem.n * problem.nx > _LMI_STATES:
        return starts, None
    from designer.lmi import decomposed, theorem2  # cvxpy takes seconds to import

    name = "decomposed" if beyond_paper(problem) else "theorem2"
    try:
        solution = decomposed.solve(problem) if beyond_paper(problem) else theorem2.solve(problem, reduced=True)
        gains = recover(problem, solution)
    except Unattainable:
        return starts, None  # one start less
    if np.isfinite(gains[0]).all() and np.isfinite(gains[1]).all():
        starts[name] = gains
    return starts, solution.gamma


def certify(problem: Problem, K: LinkMatrices, H: LinkMatrices, *, gain: Gain | None = None) -> Certificate:
    """gamma just above the exact gain of any gains of (5), proved; or Unattainable. `gain`: where it is known.

    Where M cancels, what is known of it has too few digits.
    """
    if gain is None or Coordinates.of(problem) is not None:
        gain = exact_gain(model_of_gains(problem, K, H))
    if not gain.stable:
        known = Prover(problem, K, H).stable.holds
        are = "are not mean-square stable, which is proved" if known is False else "are not known to be stable"
        raise Unattainable(
            f"the gains for {problem.name} {are}; as far as floats tell they multiply E|error|^2 by {gain.radius:.6g} "
            "in each step, and less than 1 is needed"
        )
    verdict = confirmed(problem, K, H, gain.high)
    if not verdict.holds:
        raise Unattainable(
            f"the exact gain {gain.high:.6g} of the gains for {problem.name} is not confirmed by the check "
            f"({verdict.failure})"
        )
    return Certificate(
        gamma=verdict.gamma,
        kind="exact",
        form="summed",
        exact=(lower_end(problem, K, H, gain), verdict.gamma),
        floor=floor_below(problem, verdict.gamma),
        holds=verdict.holds,
        verified=f"(17) for a P summed from the gains, and the recursion of the exact gain: {verdict.arithmetic}",
        margins=verdict.margins,
    )


def lower_end(problem: Problem, K: LinkMatrices, H: LinkMatrices, gain: Gain) -> float:
    """The exact gain is not below it, which is proved: just below what floats find, or further, at last 0.

    Of large networks, what floats find, a little lowered: whoever verifies it takes the time.
    """
    if problem.n * problem.nx > _PROVED_STATES:
        return gain.low * (1.0 - _BELOW[3])
    prover, slow = Prover(problem, K, H), gain.radius > SLOW
    if slow and prover.at_least_by_leaps(least := gain.low * (1.0 - _LEAPT[-1])):
        ends = {end * (1.0 - part) for part in _LEAPT for end in (gain.low, gain.high)}
        leapt = sorted((low for low in ends if low > least), reverse=True)
        return next((low for low in leapt if prover.at_least_by_leaps(low)), least)
    most = MOST_STEPS_BELOW if slow else 2 * gain.horizon + 10
    tried = (gain.low * (1.0 - part) for part in (_FAR_BELOW if slow else _BELOW))
    return next((low for low in tried if low > 0.0 and prover.at_least_by_steps(low, most=most)), 0.0)


def _advice(problem: Problem) -> str:
    radius = problem.plant.spectral_radius
    if radius < 1.0:
        return "try --method decomposed"
    return (
        f"A itself has spectral radius {radius:.6g}: let more measurements and messages arrive, or let every node "
        "hear what shows the unstable part"
    )


def confirmed(problem: Problem, K: LinkMatrices, H: LinkMatrices, high: float, *, P: Array | None = None) -> Verdict:
    """The least gamma just above the exact gain that is proved, by floats if they can; else the last that was tried.

    P satisfies (17); without one it is summed from the gains.
    """
    by_floats = Prover(problem, K, H, P=P, makes=FLOATS)
    soon = [(by_floats, _SOON, _A_LITTLE_LARGER)] if problem.n * problem.nx <= _FEW_STATES else []
    at_length = [(prover, MOST_STEPS, _ABOVE) for prover in (by_floats, Prover(problem, K, H, P=P))]
    for prover, most, factors in (*soon, *at_length):
        for factor in factors:
            verdict = prover.exact(high * factor, most=most)
            if verdict.holds:
                return verdict
    return verdict


def _status(descent: Descent, unit: float) -> str:
    """How the search ended and where it began, and what the chosen gains trade for their size and decay."""
    chosen, least = descent.chosen, descent.least
    return (
        f"{descent.ended}; from {descent.start or 'the start'}; "
        f"least {unit * least.gain.high:.6g} (norm {least.norm:.4g}, radius {least.gain.radius:.4g}), "
        f"chosen {unit * chosen.gain.high:.6g} (norm {chosen.norm:.4g}, radius {chosen.gain.radius:.4g})"
    )


def _status_of_noise(found: Found, unit: float) -> str:
    """How the search for less noise ended, and what it gives for what."""
    start, gains = found.start, found.gains
    return (
        f"{found.ended}; E|z~|^2 under white w from {unit**2 * start.noise:.6g} to {unit**2 * gains.noise:.6g}, "
        f"gamma from {unit * start.gamma:.6g} to {unit * gains.gamma:.6g}"
    )
