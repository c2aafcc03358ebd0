"""Gains designed for the exact gain: the least gamma over all K_ij and H_ij that the topologies allow.

gamma_T is not smooth where several modes and directions are critical at once, and at its minimum they are. So the
minimum is approached from inside, along the path of the minima of designer.search.barrier's J while mu falls; J is
smooth, and L-BFGS follows it. docs/theory.md, section 6, has what else was tried.

The last word is the exact gain of the gains found. Where it shows that the horizon T was too short, T is doubled, and
the search goes on from the last gains that are mean-square stable: gamma_T is finite for others too. Where there are
none yet, the longer T is, the more it is what grows in the errors that is made small; where that rate falls no further
from T to 2 T, the search ends.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agent.contract.arrays import Array
from agent.contract.errors import InputError
from agent.contract.problem import Problem
from designer.decay import Decay
from designer.gain.exact import Gain, InvariantSet, exact_gain, horizon_gain, lyapunov, recursion_holds
from designer.lmi.back_off import least_gamma
from designer.model.error_model import StackedGains, error_model
from designer.patience import Budget, TimeIsUp, looking
from designer.search import bfgs
from designer.search.barrier import Barrier
from designer.search.outlook import Outlook

_WEIGHTS = (3e-2, 9e-3, 3e-3, 9e-4, 3e-4, 9e-5, 3e-5, 9e-6)  # mu
NEAR = 9e-4  # the first mu where the start is near
ROUGH = 9e-5  # the last one where some hundredths of a percent do not matter
_SLACK = 1.001  # gamma may be this factor above the least one found, for gains that are small and decay fast
_RIDGE = 20.0  # of the centring: with less, gains of a flat minimum shrink so slowly that the search ends first
_HORIZON = 20
_LONGEST = 640
_NUMBERS = 2e8  # that the Y_bar of all steps may be: 1.6 GB
_SHORT = 1e-4  # gamma may exceed sqrt(g) by so much of itself, or by this part of mu, before T is doubled
_SHORT_OF_MU = 0.3
_COARSE = 1e-3  # of gamma^2, where starts are compared
_NEARLY = 1.01  # times gamma_T may be the exact gain of gains that a search starts near
_LONG = 5000  # steps in which the recursion is to come to its end
_SLOWER = 0.999  # errors that grow have to grow by so much less at twice the horizon, or the search ends
_SWEEPS_OF_THE_END = 40  # of the recursion: two exact gains, and a proof
_DECAYS_OF_THE_END = 10  # and as often it is seen that errors decay, or as long as that takes
_SECONDS_OF_A_CHOICE = 3.0  # that it gets however little time there is
_NOTHING = 1e-200  # gamma^2 below this is 0
_VANISHING = 1e-16  # and so is what falls below this part of what the start had: no network gains so much


class Progress(NamedTuple):
    """Where the descent is: after `steps` steps in all, gains with gamma_T < gamma are in hand."""

    start: str
    mu: float
    steps: int
    gamma: float
    seconds: float
    horizon: int  # T; the exact gain is that of all steps
    noise: float | None = None  # E|z_tilde|^2 in hand, where that is what falls
    phase: str | None = None  # what goes on in place of a search
    round: int = 1  # of `rounds`, one for each mu; some are gone through again over a longer horizon
    rounds: int = 0  # 0: not told
    whole: float = math.inf  # seconds that all will have taken if T stays; infinite: not told


class Candidate(NamedTuple):
    """Gains, what they guarantee, and their size: the Euclidean norm of all free entries, in natural units."""

    K_bar: Array
    H_bar: Array
    gain: Gain
    norm: float

    @property
    def cost(self) -> float:
        """What is kept low among gains that guarantee the same."""
        return _cost(self.norm, self.gain.radius)


def _cost(norm: float, radius: float) -> float:
    """Size times the steps that E|eta|^2 takes to decay."""
    return norm / (1.0 - radius) if radius < 1.0 else math.inf


def _rank_of(candidate: Candidate) -> tuple[float, float]:
    return _rank(candidate.gain)


def _rank(gain: Gain) -> tuple[float, float]:
    """The less, the better."""
    return gain.high, gain.radius


class _Stable(NamedTuple):
    """Mean-square stable gains on the way."""

    v: Array
    P: Array  # (modes, n_eta, n_eta), satisfies (17)
    decay: Decay

    @property
    def cost(self) -> float:
        """As that of a candidate."""
        return _cost(float(np.linalg.norm(self.v)), self.decay.radius)


class Descent(NamedTuple):
    """What the search found: `chosen` is at most 0.1 % above `least`, and smaller or faster to decay."""

    chosen: Candidate
    least: Candidate
    start: str
    steps: int
    ended: str  # "converged", "interrupted", "out of time", or why there was no search


class TooSlow(Exception):
    """Ends a search that does not see as far as errors last."""


def longest_horizon(problem: Problem) -> int:
    """The most steps that the search looks over, whether it comes to that or not."""
    numbers, horizon = len(problem.topologies) * (problem.plant_states + problem.n * problem.nx) ** 2, _HORIZON
    while 2 * horizon <= _LONGEST and 2 * horizon * numbers <= _NUMBERS:
        horizon *= 2
    return horizon


def descend(
    problem: Problem,
    starts: Mapping[str, StackedGains],
    *,
    first: float = math.inf,
    last: float = 0.0,
    budget: Budget | None = None,
    progress: Callable[[Progress], None] | None = None,
    held: NDArray[np.bool_] | None = None,
    fewest: int = 0,
) -> Descent:
    """The least exact gain found from the best of the given starts; larger mu than `first` are passed over, as are
    smaller ones than `last`.

    `held`: as `Entries` takes it.

    KeyboardInterrupt ends the search, not the program, and so does the end of the budget: the best gains so far are
    returned. Where `fewest` is not 0 the start is near what is sought: there is no search without time for so many
    evaluations, by what the first one takes, nor over a horizon that shows nothing of the start's exact gain.
    """
    search = _Search(problem, Budget() if budget is None else budget, progress, held, fewest)
    ended = "converged"
    try:
        with looking(search.budget.check):
            search.run(starts, tuple(mu for mu in _WEIGHTS if last <= mu <= first))
    except KeyboardInterrupt:
        ended = "interrupted"
    except TimeIsUp:
        ended = "out of time"
    except TooSlow:
        ended = f"errors decay too slowly for a search over {search.longest} steps"
    least, chosen = search.budget.to_its_end(lambda: search.choose(starts), lambda: search.at_hand(starts))
    search.refuse_nothing(least.gain.high**2)
    return Descent(chosen, least, search.start, search.steps, ended)


def follow(problem: Problem, start: StackedGains, weights: tuple[float, ...]) -> StackedGains | None:
    """Gains from which the barrier falls no further by these weights; None where they are not mean-square stable."""
    search = _Search(problem, Budget(), None)
    search.follow(search.barrier.entries.pack(*start), weights)
    return search.barrier.entries.unpack(search.stable[-1].v) if search.stable else None


class _Search:
    """The state of one `descend`, so that it is there when the search is interrupted."""

    def __init__(
        self,
        problem: Problem,
        budget: Budget,
        progress: Callable[[Progress], None] | None,
        held: NDArray[np.bool_] | None = None,
        fewest: int = 0,
    ) -> None:
        self.problem, self.budget, self.progress, self.fewest = problem, budget, progress, fewest
        self.barrier, self.longest = Barrier(problem, _HORIZON, held=held), longest_horizon(problem)
        self.start, self.steps, self.first = "", 0, 0.0  # first: gamma^2 of the start
        self.outlook, self.before = Outlook(problem.n), 0.0  # before: seconds that were spent when it began
        self.sweep = self.decay = 0.0  # the most seconds that one has taken
        self.best: Array | None = None  # [v; y] with the least y so far on this horizon
        self.stable: list[_Stable] = []  # the start and where the weights led to, as far as mean-square stable
        self.centred: list[Array] = []  # v of ever smaller gains

    # the way down
    def run(self, starts: Mapping[str, StackedGains], weights: tuple[float, ...]) -> None:
        """The best start by these weights, on longer horizons while T is too short; then to the centre."""
        self.start = next(iter(starts))
        if len(starts) > 1:
            found = {name: exact_gain(error_model(self.problem, *at), width=_COARSE) for name, at in starts.items()}
            self.start = min(found, key=lambda name: _rank(found[name]))
        v = self.barrier.entries.pack(*starts[self.start])
        P, _ = self._keep(v)
        if self.fewest and P is not None:
            self._lengthen(v, P)
        self.before = self.budget.spent
        x = self.follow(v, weights)
        if x is not None:
            self._centre(x)

    def follow(self, v: Array, weights: tuple[float, ...]) -> Array | None:
        """[v; y] at the end of these weights; None where the search ends before."""
        self.budget.check()  # before there is a horizon of anything
        x, radius, left = self._begin(v), math.inf, list(weights)
        while left:
            point = self._follow(left[0], x)
            x = point.x
            P, decays = self._keep(x[:-1])
            if P is None:
                if not self._may_be_longer() or not (self.stable or decays.radius < radius * _SLOWER):
                    return None
                if self.stable:
                    x = np.append(self.stable[-1].v, x[-1])
                else:
                    radius = decays.radius
            if P is None or self._is_short(x, P, left[0]):
                self.barrier.horizon, self.best = 2 * self.barrier.horizon, None
                x = self._begin(x[:-1])
            else:
                left.pop(0)
        return x

    def _keep(self, v: Array) -> tuple[Array | None, Decay]:
        """What `lyapunov` says of gains, which are kept if they are mean-square stable."""
        begun = self.budget.spent
        P, decays = lyapunov(self.barrier.operator(v))
        self.decay = max(self.decay, self.budget.spent - begun)
        self._keep_time()
        if P is not None:
            self.stable.append(_Stable(v, P, decays))
        return P, decays

    def _keep_time(self) -> None:
        """For the choice and the proof."""
        self.budget.keep(_SWEEPS_OF_THE_END * self.sweep + _DECAYS_OF_THE_END * self.decay)

    def _lengthen(self, v: Array, P: Array) -> None:
        """To a horizon over which these gains show nearly all of their exact gain."""
        operator, invariant = self.barrier.operator(v), InvariantSet(P)
        while True:
            self.budget.check()
            g = horizon_gain(operator, self.barrier.horizon, width=_NEARLY - 1.0)[1] * _NEARLY**2
            if recursion_holds(operator, g, _LONG, invariant=invariant).holds:
                return
            if not self._may_be_longer():
                raise TooSlow
            self.barrier.horizon *= 2

    def _may_be_longer(self) -> bool:
        return 2 * self.barrier.horizon <= self.longest

    def _is_short(self, x: Array, P: Array, mu: float) -> bool:
        """Whether the exact gain of these gains is above sqrt(g)."""
        operator, above = self.barrier.operator(x[:-1]), 1.0 + max(_SHORT, _SHORT_OF_MU * mu)
        begun = self.budget.spent
        g, invariant = above**2 * math.exp(x[-1]), InvariantSet(P)
        trial = recursion_holds(operator, g, _LONG, invariant=invariant)
        self.sweep = max(self.sweep, self.budget.spent - begun)
        self._keep_time()
        return trial.holds is False and self._may_be_longer()

    def _begin(self, v: Array) -> Array:
        """[v; y] with g 10 % above gamma_T^2."""
        _, g = horizon_gain(self.barrier.operator(v), self.barrier.horizon, width=1e-3)
        self.refuse_nothing(g)
        return np.append(v, math.log(1.1 * g))

    def refuse_nothing(self, g: float) -> None:
        """InputError where gamma^2 has come down to nothing."""
        self.first = max(self.first, g)
        if g < max(_NOTHING, _VANISHING * self.first):
            raise InputError(
                f"{self.problem.name}: its measurements show z exactly, so the error can be 0 and there is no least "
                "gain to design for; give every measurement noise of its own in D, or take --method decomposed"
            )

    def _follow(self, mu: float, x: Array) -> bfgs.Point:
        """The minimum of J, only as exactly as the next mu needs it."""
        number = _WEIGHTS.index(mu)

        def advance(x: Array) -> None:
            if self.best is None or x[-1] < self.best[-1]:
                self.best = x
            if self.progress is not None:
                gamma, spent, horizon = math.exp(x[-1] / 2.0), self.budget.spent, self.barrier.horizon
                at = Progress(self.start, mu, self.steps, gamma, spent, horizon, whole=self._whole(spent))
                self.progress(at._replace(round=number + 1, rounds=len(_WEIGHTS)))

        # L-BFGS begins anew each time: a start far away leaves it an inverse Hessian that misleads
        inverse_hessian = self.barrier.inverse_hessian(x, mu)
        return self._minimise(self.barrier.descent(mu), x, inverse_hessian, advance, number, enough=0.3 * mu)

    def _whole(self, spent: float) -> float:
        """Seconds of everything, by what the evaluations so far have taken."""
        a_step = (spent - self.before) / self.outlook.steps
        return spent + self.outlook.left * self.barrier.horizon * a_step + self.budget.kept

    def _centre(self, x: Array) -> None:
        """From the least gamma to smaller and faster gains, gamma held below _SLACK times the least."""
        v, y = x[:-1], float(x[-1]) + 2.0 * math.log(_SLACK)
        ridge = _RIDGE / float(v @ v)
        inverse_hessian = self.barrier.inverse_hessian(np.append(v, y), 1.0, ridge=ridge)
        J, advance = self.barrier.centre(y, ridge), self.centred.append
        self._minimise(J, v, inverse_hessian, advance, len(_WEIGHTS), enough=1e-2)

    def _minimise(
        self,
        function: bfgs.Function,
        x: Array,
        inverse_hessian: bfgs.Map,
        advance: Callable[[Array], None],
        number: int,
        *,
        enough: float,
    ) -> bfgs.Point:
        """L-BFGS within the budget, its steps and evaluations counted as those of a round, from 0."""
        self.outlook.begin(number, enough)

        def evaluated(x: Array) -> tuple[float, Array]:
            begun = self.budget.spent if self.fewest else 0.0
            found = function(x)
            self.outlook.evaluated(self.barrier.horizon)
            if self.fewest:
                self.budget.check(ahead=self.fewest * (self.budget.spent - begun))
                self.fewest = 0
            return found

        def counted(point: bfgs.Point) -> None:
            self.steps += 1
            self.outlook.fell(point.value)
            advance(point.x)

        return bfgs.minimise(self.budget.watched(evaluated), x, inverse_hessian, counted, enough=enough)

    # the choice
    def choose(self, starts: Mapping[str, StackedGains]) -> tuple[Candidate, Candidate]:
        """The least gain of all that was found, and the gains to take; fewer are compared where time is up."""
        self.budget.goes_on(phase := "choosing among the gains found, by their exact gain")
        if self.progress is not None:
            horizon = self.barrier.horizon
            self.progress(Progress(self.start, 0.0, self.steps, math.inf, self.budget.spent, horizon, phase=phase))
        offered = self._offered(starts)
        least = self._candidate(offered.pop(0))
        while offered and not least.gain.stable:
            least = self._less(least, offered.pop(0))
        chosen = None
        with suppress(TimeIsUp), looking(self.budget.choosing(_SECONDS_OF_A_CHOICE)):
            for v in offered:
                if self._may_be_less(v, least):
                    least = self._less(least, v)
            near = self._near(least) if least.gain.stable else None
            chosen = None if near is None else self._candidate(near)
        return (least, least) if chosen is None else (min(least, chosen, key=_rank_of), chosen)

    def at_hand(self, starts: Mapping[str, StackedGains]) -> tuple[Candidate, Candidate]:
        """Gains with a bound that takes no recursion, (17) and (18) alone: the first that have one."""
        for v in self._offered(starts):
            operator = self.barrier.operator(v)
            P, decays = lyapunov(operator)
            high = math.inf if P is None else least_gamma(operator.M, P) * (1.0 + _SHORT)
            found = Candidate(
                *self.barrier.entries.unpack(v), Gain(0.0, high, 1, P, *decays.rate), float(np.linalg.norm(v))
            )
            if P is not None:
                break
        return found, found

    def _offered(self, starts: Mapping[str, StackedGains]) -> list[Array]:
        """v of what may be best, the likely best first: a search over too few steps may end above where it was."""
        offered = [] if self.best is None else [self.best[:-1]]
        offered += [each.v for each in self.stable[::-1]]
        return offered + ([] if self.stable else [self.barrier.entries.pack(*gains) for gains in starts.values()])

    def _less(self, least: Candidate, v: Array) -> Candidate:
        return min(least, self._candidate(v), key=_rank_of)

    def _may_be_less(self, v: Array, least: Candidate) -> bool:
        """Whether no few steps show that the gain is not below this one."""
        operator, gain = self.barrier.operator(v), least.gain
        return not gain.stable or recursion_holds(operator, gain.low**2, 2 * gain.horizon).holds is not False

    def _near(self, least: Candidate) -> Array | None:
        """v of the gains of least cost that guarantee _SLACK times the least gamma; None where none cost less.

        They are sought among the last of the centred ones and every tenth before it: the last alone would not do, for
        what grows too slowly to be seen within T steps, centring lets grow.
        """
        offered = list(self.stable)
        for v in self.centred[::-10]:
            P, decays = lyapunov(self.barrier.operator(v))
            offered += [] if P is None else [_Stable(v, P, decays)]
        near = [each for each in offered if self._holds(each, _SLACK * least.gain.high)]
        best = min(near, key=lambda each: each.cost, default=None)
        return None if best is None or best.cost >= least.cost else best.v

    def _holds(self, stable: _Stable, gamma: float) -> bool:
        operator, invariant = self.barrier.operator(stable.v), InvariantSet(stable.P)
        return recursion_holds(operator, gamma**2, _LONG, invariant=invariant).holds is True

    def _candidate(self, v: Array) -> Candidate:
        K_bar, H_bar = self.barrier.entries.unpack(v)
        return Candidate(K_bar, H_bar, exact_gain(error_model(self.problem, K_bar, H_bar)), float(np.linalg.norm(v)))
