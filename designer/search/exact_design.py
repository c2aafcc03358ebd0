"""From a problem to gains designed for the exact gain, with a certificate of kind "exact"; and one for any gains."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from agent.contract.arrays import Array
from agent.contract.errors import Unattainable
from agent.contract.gains import Certificate, Gains, LinkMatrices, Solver
from agent.contract.problem import Problem
from designer.coordinates import Coordinates
from designer.gain.alone import Alone
from designer.gain.exact import (
    Gain,
    InvariantSet,
    Operator,
    exact_gain,
    horizon_gain,
    invariant_set,
    lyapunov,
    recursion_holds,
)
from designer.gain.floor import floor, floor_below
from designer.invariants import SLOW
from designer.lmi import LmiSolution, beyond_paper
from designer.lmi.recovery import recover
from designer.model.error_model import StackedGains, error_model, link_gains, model_of_gains
from designer.model.units import NaturalUnits
from designer.patience import Budget, TimeIsUp, looking
from designer.proof.by_gramian import ByGramian
from designer.proof.findings import Verdict
from designer.proof.prover import BALLS, FLOATS, MOST_STEPS_BELOW, Prover
from designer.proof.recursion import MOST_STEPS
from designer.search.descent import Descent, Progress, descend
from designer.search.effort import in_windows, refuse_without_memory, seconds_of_the_end, whole_fits
from designer.search.quiet import Found, quieter
from designer.search.starts import WEIGHT, consensus_gains, ignoring, least_variance_gains
from designer.search.windows import WEIGHT as WEIGHT_OF_WINDOWS
from designer.search.windows import window_gains
from designer.workers import greet_cluster

_LMI_STARTS = ("theorem2", "decomposed")
_LMI_STATES = 8  # n nx up to which an LMI, a second or two there, gives one more start
_LMI_ROUNDING = 1e-3  # a solver may state its bound so much too low
_WIDE = 1e-6  # of a gain where chance has no say: what floats know less of, balls know
_BELOW = (0.0, 1e-9, 1e-8, 1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1, 0.5)
_LEAPT = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2)  # below either end, which takes little time; the last is tried first
_FAR_BELOW = (1e-6, 1e-4, 1e-3, 1e-2, 1e-1, 0.5)  # and by steps: a W fails after many, if not far below
_SOON, _FEW_STATES = 5000, 60  # steps, which a gamma a little larger may save; n nx up to which that is tried
_A_LITTLE_LARGER = (1.0, 1.0 + 1e-6, 1.0 + 1e-5)
_SOON_IN_BALLS, _FEWER_STATES = 500, 20  # that balls take in a second: asked before gamma is larger by more
_STARTS_OF_THE_END = 12  # of a large network: as long as its gains of least variance, so many times
_FEWEST = 400  # evaluations of the whole after windows: with less, it may lead to nothing that is stable
_PROVED_STATES = 250  # n nx up to which the lower end is proved at once
_LMI_SECONDS, _LMI_SHARE = 2.0, 0.25  # what that takes, most of it to load; and of a search's time no more
_AT_ONCE = 2.0  # seconds that starts may take, however little time there is
_SHARE_OF_NOISE = 0.5  # of a search's time, where least noise is sought after the least peak
_SECONDS_OF_A_PROOF = 1.0  # that it gets however little time there is
_STEPS_AT_ONCE, _STEPS_IN_HASTE = 300, 20_000
_BEYOND, _BEYOND_GAIN, _FURTHER = 0.1, 1e-4, 2.0  # by this part of itself g is higher at first; and so much more then
_HIGHEST = 1e100
_STATES_OF_BALLS = 40  # n nx up to which they are asked at once
_RECURSION = "(17) for a P summed from the gains, and the recursion of the exact gain"
_GRAMIAN = "M G M' < gamma^2 for the gramian G, since chance has no say"
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
    slack: float = 0.0,
    held: NDArray[np.bool_] | None = None,
    natural: NaturalUnits | None = None,
) -> Gains:
    """Gains with the least exact gain that is found, from the given starts or, where there are none, from its own.

    With `slack` those of least noise whose exact gain is at most 1 + slack times that one.

    `first` and `last`: as `descend` takes them. KeyboardInterrupt ends the search, and so does the end of the budget,
    which begins when it is made; the best so far is returned. Windows are spread over a cluster at `dask`, if there is
    one. `held` (nx, nx): entries of K_ij that are to be 0, unless windows are searched. `natural`: the units that
    `problem` is in; the certificate is for the one that was given, and the status too.
    """
    started, budget = time.perf_counter(), Budget() if budget is None else budget
    unit = 1.0 if natural is None else natural.output
    refuse_without_memory(problem)
    if dask is not None:
        greet_cluster(dask)  # before the starts, which may take minutes
    if math.isinf(floor(problem)):
        raise Unattainable(
            f"no gains can bound the error of {problem.name}: all sensors together do not show an unstable part of "
            "the plant that the disturbance drives, as far as floats tell; measure it"
        )
    budget.keep(seconds_of_the_end(problem))
    own, begun_with = starts is None, _Starts(dict(starts or {}), None, None)
    if own:
        begun_with = _starts(problem, held, budget)
    begun = time.perf_counter()
    with looking(budget.check_last):
        if own and begun_with.ended is None and in_windows(problem):
            after = _STARTS_OF_THE_END * (begun - started)
            descent = _by_windows(problem, begun_with.gains, after, budget=budget, progress=progress, dask=dask)
        else:
            how: dict[str, Any] = {"first": first, "last": last, "progress": progress, "held": held}
            with budget.leaving(_SHARE_OF_NOISE if slack else 0.0):
                descent = descend(problem, begun_with.gains, budget=budget, **how)
    descent = descent._replace(ended=begun_with.ended or descent.ended)
    chosen = descent.chosen
    if not chosen.gain.stable:
        raise Unattainable(
            f"no mean-square stable gains were found for {problem.name}: the best ones multiply E|error|^2 by "
            f"{chosen.gain.rate} in each step, as far as floats tell, and less than 1 is needed; "
            f"{_advice(problem)}"
        )
    method, steps, status, stacked, gain = "exact", descent.steps, _status(descent, unit), chosen[:2], chosen.gain
    if slack:
        found = _quieter(problem, descent, slack, budget, progress, held)
        if found is None:
            budget.left_out.append("the search for the least noise")
        else:
            method, steps, stacked = f"exact, peak slack {100.0 * slack:g} %", steps + found.steps, found.gains[:2]
            status = f"{_status_of_noise(found, unit)}; before: {status}"
            gain = found.gains.gain
    solved = time.perf_counter()
    K, H = link_gains(problem, *stacked)
    budget.end()
    budget.goes_on(phase := "proving gamma", partial(_steps_of_proof, problem, stacked, gain))
    if progress is not None:
        spent = time.perf_counter() - started
        progress(Progress("", 0.0, steps, gain.high, spent, gain.horizon, phase=phase))
    certificate = _certified(problem, K, H, gain, budget, natural)
    certificate = certificate.model_copy(update=_of_lmi(problem, begun_with, budget))
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


def _certified(
    problem: Problem, K: LinkMatrices, H: LinkMatrices, gain: Gain, budget: Budget, natural: NaturalUnits | None
) -> Certificate:
    """At length, or after a second signal at once."""
    if natural is not None:
        problem, (K, H), gain = natural.given, natural.back(K, H), in_units_of(natural.output, gain)
    return budget.to_its_end(
        lambda: certify(problem, K, H, gain=gain, budget=budget), lambda: certify_at_once(problem, K, H)
    )


def _steps_of_proof(problem: Problem, gains: StackedGains, gain: Gain) -> int | None:
    """As floats find it; the proof takes several times as long."""
    if gain.P is None:
        return None
    operator, g = Operator(error_model(problem, *gains)), (_ABOVE[4] * gain.high) ** 2
    return recursion_holds(operator, g, MOST_STEPS, invariant=InvariantSet(gain.P)).steps


def _quieter(
    problem: Problem,
    descent: Descent,
    slack: float,
    budget: Budget,
    progress: Callable[[Progress], None] | None,
    held: NDArray[np.bool_] | None,
) -> Found | None:
    """From what the search for the least peak chose; None where a second signal came first."""
    pressed = descent.ended == "interrupted"
    if pressed:
        budget.end()
    gains, gamma = descent.chosen[:2], (1.0 + slack) * descent.chosen.gain.high
    budget.goes_on("measuring the noise of the gains of least peak")
    found = budget.to_its_end(
        lambda: quieter(problem, gains, gamma, budget=budget, progress=progress, held=held), lambda: None
    )
    return found._replace(ended=descent.ended) if pressed and found is not None else found


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

    `after`: the seconds that choice and proof will take.
    """

    def report(done: int, of: int) -> None:
        if progress is not None:
            phase = f"window {done} of {of}; Ctrl-C keeps what is done"
            progress(Progress("", WEIGHT_OF_WINDOWS, 0, math.inf, budget.spent, 0, phase=phase))

    budget.keep(after)
    windowed = window_gains(problem, starts["least variance"], budget=budget, dask=dask, report=report)
    ended = windowed.ended or (None if whole_fits(problem) else "windows alone, for want of memory")
    if ended:
        budget.end()
    start = {"windows": windowed.gains}
    descent = descend(problem, start, first=WEIGHT_OF_WINDOWS, budget=budget, progress=progress, fewest=_FEWEST)
    return descent._replace(ended=ended) if ended else descent


class _Starts(NamedTuple):
    """Gains to start from, gamma of the LMI where that gave one of them, and why there are not more."""

    gains: dict[str, StackedGains]
    lmi_gamma: float | None
    ended: str | None


def _starts(problem: Problem, held: NDArray[np.bool_] | None, budget: Budget) -> _Starts:
    """Least variance first: all others take longer. KeyboardInterrupt, TimeIsUp: even that would, and others will do.

    For an unstable plant there are none.
    """
    starts: dict[str, StackedGains] = {}
    lmi_gamma, ended = None, None
    until = max(budget.spent + _AT_ONCE, budget.seconds - budget.kept)

    def check(steps: int) -> None:
        if budget.asked:
            raise KeyboardInterrupt
        if budget.spent >= until:
            raise TimeIsUp

    try:
        with looking(check):
            starts["least variance"] = least_variance_gains(problem, held)
            if held is not None and problem.plant.spectral_radius < 1.0:
                starts["ignoring all measurements"] = ignoring(problem)  # where M cancels, few gains are better
            if lyapunov(Operator(error_model(problem, *starts["least variance"])))[0] is None:
                starts[f"consensus {WEIGHT}"] = consensus_gains(problem)
            if problem.n * problem.nx <= _LMI_STATES:
                lmi_gamma = _lmi_start(problem, starts, budget)
    except KeyboardInterrupt:
        ended = "interrupted"
    except TimeIsUp:
        ended = "out of time"
    if not starts and problem.plant.spectral_radius < 1.0:
        raise KeyboardInterrupt if ended == "interrupted" else TimeIsUp
    if not starts:
        with looking(budget.check_last):
            starts["least variance"] = least_variance_gains(problem, held)
    if ended is not None:
        budget.end()
    return _Starts(starts, lmi_gamma, ended)


def _lmi_start(problem: Problem, starts: dict[str, StackedGains], budget: Budget) -> float | None:
    """One start more; returns the optimum of the LMI. None: no answer, or no time to ask."""
    if _LMI_SHARE * budget.left < _LMI_SECONDS:
        budget.left_out.append("the gains of an LMI, to start from and to compare with")
        return None
    name = "decomposed" if beyond_paper(problem) else "theorem2"
    try:
        solution = _solved(problem, name)
        gains = recover(problem, solution)
    except Unattainable:
        return None  # one start less
    if np.isfinite(gains[0]).all() and np.isfinite(gains[1]).all():
        starts[name] = gains
    return solution.gamma


def _solved(problem: Problem, name: str) -> LmiSolution:
    if name == "decomposed":
        from designer.lmi import decomposed

        return decomposed.solve(problem)
    from designer.lmi import theorem2  # cvxpy takes seconds to import

    return theorem2.solve(problem, reduced=True)


def _of_lmi(problem: Problem, begun_with: _Starts, budget: Budget) -> dict[str, Any]:
    """What the certificate says of the LMI: its optimum, and the exact gain of its own gains."""
    gamma, name = begun_with.lmi_gamma, next((name for name in _LMI_STARTS if name in begun_with.gains), None)
    if name is None:
        return {}
    exact = budget.compared(
        "the exact gain of the gains of an LMI",
        lambda: exact_gain(error_model(problem, *begun_with.gains[name])).bounds,
    )
    if gamma is not None and (exact is None or gamma < (1.0 - _LMI_ROUNDING) * exact[0]):
        return {}  # no bound of its own gains: the solver failed
    return {"lmi_gamma": gamma, "lmi_exact": exact}


def certify(
    problem: Problem, K: LinkMatrices, H: LinkMatrices, *, gain: Gain | None = None, budget: Budget | None = None
) -> Certificate:
    """gamma just above the exact gain of any gains of (5), proved; or Unattainable. `gain`: where it is known.

    Where the `budget` is over, the lower end is 0; where it is before gamma is proved, gamma is one that is sooner.

    Where M cancels, what is known of it has too few digits; so it may be where the roundings of natural units count,
    and then it is computed with the numbers as they stand.
    """
    budget = Budget() if budget is None else budget
    try:
        with looking(budget.proving(_SECONDS_OF_A_PROOF)):
            return _near(problem, K, H, gain, budget)
    except TimeIsUp:
        above = None if gain is None or not gain.stable else gain.high
    with suppress(Unattainable):
        soon = certify_at_once(problem, K, H, above=above, steps=_STEPS_IN_HASTE)
        budget.left_out.append("a gamma as near to the exact gain as floats find it")
        return soon
    return _near(problem, K, H, gain, budget)


def _near(problem: Problem, K: LinkMatrices, H: LinkMatrices, gain: Gain | None, budget: Budget) -> Certificate:
    """The same, however long it takes."""
    alone = Alone.of(model_of_gains(problem, K, H)) is not None  # which other units may round away
    if Coordinates.of(problem) is None and not alone:
        gain = gain_of(problem, K, H) if gain is None else gain
        verdict = confirmed(problem, K, H, gain.high) if gain.stable else None
        if verdict is not None and verdict.holds:
            return _certificate(problem, K, H, gain, verdict, budget)
    gain = narrowed(problem, K, H, exact_gain(model_of_gains(problem, K, H)))
    if not gain.stable:
        known = Prover(problem, K, H).stable.holds
        are = "are not mean-square stable, which is proved" if known is False else "are not known to be stable"
        raise Unattainable(
            f"the gains for {problem.name} {are}; as far as floats tell they multiply E|error|^2 by {gain.rate} "
            "in each step, and less than 1 is needed"
        )
    verdict = confirmed(problem, K, H, gain.high)
    if not verdict.holds:
        raise Unattainable(
            f"the exact gain {gain.high:.6g} of the gains for {problem.name} is not confirmed by the check "
            f"({verdict.failure})"
        )
    return _certificate(problem, K, H, gain, verdict, budget)


def _certificate(
    problem: Problem, K: LinkMatrices, H: LinkMatrices, gain: Gain, verdict: Verdict, budget: Budget
) -> Certificate:
    """With the lower end of the exact gain, where there is time for it."""
    low = budget.compared("the lower end of the exact gain", lambda: lower_end(problem, K, H, gain))
    return Certificate(
        gamma=verdict.gamma,
        kind="exact",
        form="summed",
        exact=(0.0 if low is None else low, verdict.gamma),
        floor=floor_below(problem, verdict.gamma),
        holds=verdict.holds,
        verified=f"{_GRAMIAN if verdict.by_gramian else _RECURSION}: {verdict.arithmetic}",
        margins=verdict.margins,
    )


def certify_at_once(
    problem: Problem, K: LinkMatrices, H: LinkMatrices, *, above: float | None = None, steps: int = _STEPS_AT_ONCE
) -> Certificate:
    """A gamma that a recursion of few steps proves; or Unattainable. `above`: the exact gain, where it is known.

    Where errors decay slowly gamma is above the exact gain, of which nothing is said; but where chance has no say that
    is known at once.
    """
    model = model_of_gains(problem, K, H)
    if Alone.of(model) is not None:
        return certify(problem, K, H)
    operator = Operator(model)
    invariant, beyond = invariant_set(operator), _BEYOND if above is None else _BEYOND_GAIN
    least = horizon_gain(operator, 1)[1] if above is None else above**2
    while invariant.P and beyond < _HIGHEST:
        if recursion_holds(operator, least * (1.0 + beyond), steps, invariant=invariant).holds:
            break
        beyond *= _FURTHER
    makes = FLOATS + BALLS if problem.n * problem.nx <= _STATES_OF_BALLS else FLOATS
    gamma = math.sqrt(least * (1.0 + beyond)) * _ABOVE[3]
    verdict = Prover(problem, K, H, makes=makes).exact(gamma, most=2 * steps)
    if not verdict.holds:
        raise Unattainable(f"no gamma of the gains for {problem.name} is proved at once ({verdict.failure})")
    return Certificate(
        gamma=verdict.gamma,
        kind="exact",
        form="summed",
        floor=None,
        holds=verdict.holds,
        verified=f"(17) for a P summed from the gains, and a recursion of few steps: {verdict.arithmetic}",
        margins=verdict.margins,
    )


def gain_of(problem: Problem, K: LinkMatrices, H: LinkMatrices) -> Gain:
    """The exact gain as computed in natural units, so that it is the same number in any."""
    natural = NaturalUnits(problem)
    return in_units_of(natural.output, exact_gain(model_of_gains(natural.problem, *natural.rounded_there(K, H))))


def in_units_of(unit: float, gain: Gain) -> Gain:
    """What is known of z in units of `unit`, of z itself."""
    return gain._replace(low=unit * gain.low, high=unit * gain.high)


def narrowed(problem: Problem, K: LinkMatrices, H: LinkMatrices, gain: Gain) -> Gain:
    """Where chance has no say and floats allow for much rounding, since errors hardly decay: what balls tell."""
    low, high = gain.bounds or (0.0, 0.0)
    wide = gain.P is None and high - low > _WIDE * high
    by = ByGramian.of(problem, K, H) if wide else None
    while by is not None and high - low > _WIDE * high:
        sign = by.sign(middle := (low + high) / 2.0)
        if sign.proved:
            high = middle
        elif sign.refuted:
            low = middle
        else:
            break
    return gain if by is None else gain._replace(low=low, high=high)


def lower_end(problem: Problem, K: LinkMatrices, H: LinkMatrices, gain: Gain) -> float:
    """The exact gain is not below it, which is proved: just below what floats find, or further, at last 0.

    Of large networks, what floats find, a little lowered: whoever verifies it takes the time.
    """
    if problem.n * problem.nx > _PROVED_STATES:
        return gain.low * (1.0 - _BELOW[3])
    prover, slow = Prover(problem, K, H), gain.radius > SLOW
    if prover.by_gramian is not None:
        return next((low for part in _BELOW if prover.at_least(low := gain.low * (1.0 - part))), 0.0)
    if slow:
        by_costs = (low for part in _LEAPT if prover.at_least_by_costs(low := gain.low * (1.0 - part)))
        if (found := next(by_costs, None)) is not None:
            return found
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
    by_floats, by_both = Prover(problem, K, H, P=P, makes=FLOATS), Prover(problem, K, H, P=P)
    states, tried = problem.n * problem.nx, list[tuple[Prover, int, tuple[float, ...]]]()
    tried += [(by_floats, _SOON, _A_LITTLE_LARGER)] if states <= _FEW_STATES else []
    tried += [(by_both, _SOON_IN_BALLS, _A_LITTLE_LARGER[1:])] if states <= _FEWER_STATES else []
    for prover, most, factors in (*tried, (by_floats, MOST_STEPS, _ABOVE), (by_both, MOST_STEPS, _ABOVE)):
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
