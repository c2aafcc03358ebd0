"""Gains that let through the least noise while their exact gain stays within a share of the least one.

Gains of least exact gain are one end of a curve, gains of least noise the other; in between a gamma that is one per
cent larger may leave half of the noise. The curve is followed as the least gain is: from inside, along the minima of

    log E|z_tilde|^2 - mu sum over steps and modes of log det (I - B'Y_bar B / g)

while mu falls, g held at the gamma^2 that is allowed. docs/theory.md, section 7.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agent.contract.arrays import Array
from agent.contract.errors import InputError
from agent.contract.problem import Problem
from designer.gain.exact import Gain, exact_gain
from designer.gain.noise import steady_state
from designer.model.error_model import StackedGains
from designer.patience import Budget, TimeIsUp, looking
from designer.search import bfgs
from designer.search.barrier import Barrier
from designer.search.descent import Progress, longest_horizon
from designer.search.effort import whole_fits
from designer.search.starts import least_variance_gains

_WEIGHTS = (1e-1, 3e-2, 1e-2, 3e-3, 1e-3, 3e-4, 1e-4, 3e-5, 1e-5)  # mu
_HORIZON = 20
_UNSEEN = 1e-3  # so much of the noise may come from before the horizon
_INSIDE = 1e-7  # by this part the search keeps away from the gamma that is allowed, for the proof


class Quiet(NamedTuple):
    """Gains, their exact gain as computed, and E|z_tilde|^2 in the steady state under white w of unit covariance."""

    K_bar: Array
    H_bar: Array
    gain: Gain
    noise: float

    @property
    def gamma(self) -> float:
        return self.gain.high


class Found(NamedTuple):
    """What a search for less noise found, and what it began with."""

    gains: Quiet
    start: Quiet
    steps: int
    ended: str  # "converged", "interrupted" or "out of time"


def quieter(
    problem: Problem,
    gains: StackedGains,
    gamma: float,
    *,
    budget: Budget | None = None,
    progress: Callable[[Progress], None] | None = None,
    held: NDArray[np.bool_] | None = None,
) -> Found:
    """From gains whose exact gain is below `gamma` to those of least noise, of which it is still below.

    KeyboardInterrupt and the end of the budget end the search: the best so far is returned. InputError where the
    memory does not suffice, or where no noise is left to be made less. `held`: as `Entries` takes it.
    """
    if not whole_fits(problem):
        raise InputError(f"{problem.name} is too large for --peak-slack: its {problem.n} nodes are searched at once")
    search = _Search(problem, gamma * (1.0 - _INSIDE), Budget() if budget is None else budget, progress, held)
    start = search.measured(search.barrier.entries.pack(*gains))
    if start is None or not start.noise > 0.0:
        raise InputError(f"{problem.name}: the noise of gains of least peak has not settled, so none can be compared")
    ended = "converged"
    try:
        with looking(search.budget.check):
            search.run(search.barrier.entries.pack(*gains))
    except KeyboardInterrupt:
        ended = "interrupted"
    except TimeIsUp:
        ended = "out of time"
    return Found(min([start, *search.found], key=lambda each: each.noise), start, search.steps, ended)


class _Search:
    """The state of one `quieter`, so that it is there when the search is interrupted."""

    def __init__(
        self,
        problem: Problem,
        gamma: float,
        budget: Budget,
        progress: Callable[[Progress], None] | None,
        held: NDArray[np.bool_] | None,
    ) -> None:
        self.problem, self.gamma, self.budget, self.progress = problem, gamma, budget, progress
        self.barrier, self.longest = Barrier(problem, _HORIZON, held=held), longest_horizon(problem)
        self.y, self.steps = 2.0 * math.log(gamma), 0
        self.found: list[Quiet] = []

    def run(self, v: Array) -> None:
        """From v, or from gains of least variance where they do; on longer horizons while this one is too short."""
        greedy = self.barrier.entries.pack(*least_variance_gains(self.problem, self.barrier.entries.held))
        if self._kept(greedy):
            v = greedy
        while True:
            ends = self._followed(v)
            if self._kept(ends) and self._seen(ends):
                return
            if 2 * self.barrier.horizon > self.longest:
                return
            self.barrier.horizon *= 2

    def measured(self, v: Array) -> Quiet | None:
        """None where the errors do not die out, or the noise has not settled."""
        model = self.barrier.model(v)
        noise = steady_state(model, initial=self.problem.mode_index(self.problem.markov.initial))
        if noise is None:
            return None
        return Quiet(*self.barrier.entries.unpack(v), exact_gain(model), noise.total)

    def _kept(self, v: Array) -> bool:
        """Whether these gains are what is asked for; if so they are kept."""
        found = self.measured(v)
        if found is None or found.gamma > self.gamma:
            return False
        self.found.append(found)
        return True

    def _seen(self, v: Array) -> bool:
        """Whether nearly all of the noise is that of the horizon."""
        return self.barrier.noise_of(v) >= (1.0 - _UNSEEN) * self.found[-1].noise

    def _followed(self, v: Array) -> Array:
        """The minimum at the last mu; every minimum on the way is kept where it is allowed."""
        for mu in _WEIGHTS:
            v = self._minimised(v, mu)
            if mu != _WEIGHTS[-1]:
                self._kept(v)
        return v

    def _minimised(self, v: Array, mu: float) -> Array:
        def advance(point: bfgs.Point) -> None:
            self.steps += 1
            self._tell(mu, point.value)

        noise, first = self.barrier.noise(self.y, mu), self.barrier.inverse_hessian_of_noise(v, self.y, mu)
        return bfgs.minimise(self.budget.watched(noise), v, first, advance, enough=0.1 * mu).x

    def _tell(self, mu: float, value: float) -> None:
        if self.progress is not None:
            noise, horizon = float(np.exp(value)), self.barrier.horizon
            at = Progress("", mu, self.steps, self.gamma, self.budget.spent, horizon, noise)
            self.progress(at._replace(round=_WEIGHTS.index(mu) + 1, rounds=len(_WEIGHTS)))
