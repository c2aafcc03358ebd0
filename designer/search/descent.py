"""Gains designed for the exact gain: the least gamma over all K_ij and H_ij that the topologies allow.

gamma_T is not smooth where several modes and directions are critical at once, and at its minimum they are. So the
minimum is approached from inside, along the path of the minima of designer.search.barrier's J while mu falls; J is
smooth, and BFGS follows it. docs/theory.md, section 6, has what else was tried.

The last word is the exact gain of the gains found. If it shows that the horizon T was too short, T is doubled. That
is so for gains that are not mean-square stable too: gamma_T is finite for them, and the longer T is, the more it is
what grows in the errors that is made small. Where that rate falls no further from T to 2 T, the search ends.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from agent.contract.arrays import Array
from agent.contract.errors import InputError
from agent.contract.problem import Problem
from designer.gain.exact import Gain, exact_gain, horizon_gain
from designer.model.error_model import StackedGains, error_model
from designer.search import bfgs
from designer.search.barrier import Barrier, Entries

_COARSE = (3e-2, 9e-3, 3e-3, 9e-4)  # mu: enough to see which start leads lowest
_FINE = (3e-4, 9e-5, 3e-5, 9e-6)
_SLACK = 1.001  # gamma may be this factor above the least one found, for gains that are small and decay fast
_RIDGE = 20.0  # of the centring: with less, gains of a flat minimum shrink so slowly that the search ends first
_HORIZON = 30
_LONGEST = 480
_SHORT = 1e-4  # gamma may exceed gamma_T by so much of itself before T is doubled
_SLOWER = 0.999  # errors that grow have to grow by so much less at twice the horizon, or the search ends
_PATIENCE = 10
_MOST_STEPS = 1000
_NOTHING = 1e-200  # gamma^2 below this is 0


class Progress(NamedTuple):
    """Where the descent is: after `steps` steps in all, gains with gamma_T < gamma are in hand."""

    start: str
    mu: float
    steps: int
    gamma: float
    seconds: float


class Candidate(NamedTuple):
    """Gains, what they guarantee, and their size: the Euclidean norm of all free entries, in natural units."""

    K_bar: Array
    H_bar: Array
    gain: Gain
    norm: float

    @property
    def cost(self) -> float:
        """Size times the steps that E|eta|^2 takes to decay: what is kept low among gains that guarantee the same."""
        return self.norm / (1.0 - self.gain.radius) if self.gain.radius < 1.0 else math.inf

    @property
    def rank(self) -> tuple[float, float]:
        """The least gain comes first; of gains that are not mean-square stable, what grows least."""
        return self.gain.high, self.gain.low if self.gain.stable else self.gain.radius


class Descent(NamedTuple):
    """What the search found: `chosen` is at most 0.1 % above `least`, and smaller or faster to decay."""

    chosen: Candidate
    least: Candidate
    starts: dict[str, float]  # gamma_T that each start led to, before the best one was taken further
    steps: int
    interrupted: bool


def descend(
    problem: Problem,
    starts: Mapping[str, StackedGains],
    *,
    progress: Callable[[Progress], None] | None = None,
) -> Descent:
    """The least exact gain found from the given starts.

    KeyboardInterrupt ends the search, not the program: the best gains so far are returned.
    """
    search = _Search(problem, progress)
    interrupted = False
    try:
        search.run(starts)
    except KeyboardInterrupt:
        interrupted = True
    entries = search.barrier.entries
    found = [_candidate(entries, *gains) for gains in (*starts.values(), *search.in_hand())]
    least = min(found, key=lambda candidate: candidate.rank)
    near = [candidate for candidate in found if candidate.gain.high <= _SLACK * (1.0 + 1e-6) * least.gain.high]
    chosen = min(near, key=lambda candidate: candidate.cost) if least.gain.stable else least
    return Descent(chosen, least, search.found, search.steps, interrupted)


def _candidate(entries: Entries, K_bar: Array, H_bar: Array) -> Candidate:
    norm = float(np.linalg.norm(entries.pack(K_bar, H_bar)))
    return Candidate(K_bar, H_bar, exact_gain(error_model(entries.problem, K_bar, H_bar)), norm)


class _Search:
    """The state of one `descend`, so that it is there when the search is interrupted."""

    def __init__(self, problem: Problem, progress: Callable[[Progress], None] | None) -> None:
        self.problem, self.progress = problem, progress
        self.barrier = Barrier(problem, _HORIZON)
        self.begun, self.steps = time.perf_counter(), 0
        self.found: dict[str, float] = {}
        self.best: Array | None = None  # [v; y] with the least y so far
        self.ends: list[Array] = []  # v of what each start led to
        self.centred: list[Array] = []  # v of ever smaller gains

    def in_hand(self) -> list[StackedGains]:
        """What each start led to, the best gains so far, and the last of the centred ones and every tenth before it.

        The last alone would not do: what grows too slowly to be seen within T steps, centring lets grow.
        """
        best = [] if self.best is None else [self.best[:-1]]
        return [self.barrier.entries.unpack(v) for v in (*self.ends, *best, *self.centred[::-10])]

    def run(self, starts: Mapping[str, StackedGains]) -> None:
        """Every start by the coarse weights, the best by the fine ones, on longer horizons while T is too short."""
        coarse: dict[str, bfgs.Point] = {}
        for name, gains in starts.items():
            coarse[name] = self._follow(name, _COARSE, self._begin(gains))
            self.ends.append(coarse[name].x[:-1])
            self.found[name] = math.exp(coarse[name].x[-1] / 2.0)
        name = min(self.found, key=lambda start: self.found[start])
        point = self._lengthen(name, _COARSE[-1:], coarse[name])
        point = self._follow(name, _FINE, point.x)
        point = self._lengthen(name, _FINE, point)
        if self._gain(point.x).stable:
            self._centre(point)

    def _lengthen(self, name: str, weights: tuple[float, ...], point: bfgs.Point) -> bfgs.Point:
        """Double T, and follow again, while T is too short for the gains in hand; the point on the last T."""
        gain, radius = self._gain(point.x), math.inf
        while self._horizon_is_short(gain, point.x) and (gain.stable or gain.radius < radius * _SLOWER):
            radius = gain.radius
            self.barrier, self.best = Barrier(self.problem, 2 * self.barrier.horizon), None
            point = self._follow(name, weights, self._begin(self.barrier.entries.unpack(point.x[:-1])))
            gain = self._gain(point.x)
        return point

    def _gain(self, x: Array) -> Gain:
        return exact_gain(error_model(self.problem, *self.barrier.entries.unpack(x[:-1])))

    def _horizon_is_short(self, gain: Gain, x: Array) -> bool:
        if 2 * self.barrier.horizon > _LONGEST:
            return False
        _, g = horizon_gain(self.barrier.operator(x[:-1]), self.barrier.horizon)
        return gain.high > math.sqrt(g) * (1.0 + _SHORT)

    def _begin(self, gains: StackedGains) -> Array:
        """[v; y] with g 10 % above gamma_T^2."""
        v = self.barrier.entries.pack(*gains)
        _, g = horizon_gain(self.barrier.operator(v), self.barrier.horizon)
        if g < _NOTHING:
            raise InputError(
                f"{self.problem.name}: its measurements show z exactly, so the error can be 0 and there is no least "
                "gain to design for; give every measurement noise of its own in D, or take --method decomposed"
            )
        return np.append(v, math.log(1.1 * g))

    def _follow(self, name: str, weights: tuple[float, ...], x: Array) -> bfgs.Point:
        """The minima of J for falling mu, each only as exactly as the next one needs."""

        def advance(x: Array) -> None:
            if self.best is None or x[-1] < self.best[-1]:
                self.best = x
            if self.progress is not None:
                gamma, seconds = math.exp(x[-1] / 2.0), time.perf_counter() - self.begun
                self.progress(Progress(name, mu, self.steps, gamma, seconds))

        for mu in weights:  # BFGS begins anew each time: a start far away leaves it an inverse Hessian that misleads
            inverse_hessian = self.barrier.inverse_hessian(x, mu)
            point = self._minimise(self.barrier.descent(mu), x, inverse_hessian, advance, enough=0.3 * mu)
            x = point.x
        return point

    def _centre(self, point: bfgs.Point) -> None:
        """From the least gamma to smaller and faster gains, gamma held below _SLACK times the least."""
        v, y = point.x[:-1], float(point.x[-1]) + 2.0 * math.log(_SLACK)
        ridge = _RIDGE / float(v @ v)
        inverse_hessian = self.barrier.inverse_hessian(np.append(v, y), 1.0, ridge=ridge)[:-1, :-1]
        self._minimise(self.barrier.centre(y, ridge), v, inverse_hessian, self.centred.append, enough=1e-2)

    def _minimise(
        self,
        function: bfgs.Function,
        x: Array,
        inverse_hessian: Array,
        advance: Callable[[Array], None],
        *,
        enough: float,
    ) -> bfgs.Point:
        """BFGS until the last few steps together gain less than `enough`."""
        point = bfgs.start(function, x, inverse_hessian)
        values = [point.value]
        while len(values) < _MOST_STEPS:
            following = bfgs.step(function, point)
            if following is None:
                break
            point = following
            values.append(point.value)
            self.steps += 1
            advance(point.x)
            if len(values) > _PATIENCE and values[-1 - _PATIENCE] - values[-1] < enough:
                break
        return point
