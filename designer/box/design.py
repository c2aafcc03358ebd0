"""Gains for every model of a box: from the nominal design down the barrier of the worst models that are found.

Models at corners of the box join the descent one after the other, each the worst that the gains of that moment have.
Weights mu fall as in designer.search.descent; at the end of each, gamma for the whole box is proved, and where that is
no less than before the search ends: the last gains for the models that were met are not the best for all the others,
which may change at every step. docs/theory.md, section 13.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np

from agent.contract.errors import Unattainable, counted
from agent.contract.gains import Gains, LinkMatrices
from agent.contract.problem import Problem
from designer.box.extent import Box
from designer.box.natural import in_units
from designer.box.robust import Robust, robust
from designer.box.worst import real, worst
from designer.coordinates import Coordinates
from designer.gain.exact import Operator, horizon_gain
from designer.gain.sensitivity import Inputs
from designer.gain.worst_case import with_worst_case
from designer.ladder import Ladder, percent
from designer.model.error_model import link_gains, stacked_links
from designer.model.units import NaturalUnits
from designer.patience import Budget, TimeIsUp, looking
from designer.search import bfgs
from designer.search.barrier import Barrier
from designer.search.descent import Progress, longest_horizon
from designer.search.exact_design import certify, certify_at_once

_OF_THE_PROBLEM = ("floor", "lmi_gamma", "lmi_exact", "lmi_least", "lmi_weights", "lmi_why_not")
_WEIGHTS = (9e-3, 3e-3, 9e-4, 3e-4, 9e-5, 3e-5)  # mu
_ROUNDS = 3  # for each mu: models that join
_MOST_MODELS = 12
_HORIZON = 20
_SHORT = 1e-3  # a model that was met may exceed sqrt(g) by so much, before the horizon is doubled
_PROOFS_KEPT = 1.2  # as long as the first one: so much of the budget is for the last
_BETTER = 1e-4  # gamma has to be lower by so much of itself, or the search ends


class ForBox(NamedTuple):
    """The gains to take, and what is proved of them and of the nominal design."""

    gains: Gains
    robust: Robust  # of `gains`
    nominal: Gains
    before: Robust  # of `nominal`
    searched: str  # how the search went

    @property
    def better(self) -> bool:
        """Whether the gains are others than those of the nominal design; then gamma for the box is less."""
        return self.gains is not self.nominal

    def on(self, ladder: Ladder) -> Ladder:
        """The ladder of the gains with the rungs of the box, and those of the nominal design."""
        found = self.robust.found if math.isfinite(self.robust.found) else None
        ladder = ladder._replace(found_in_box=found, proved_in_box=self.robust.gamma)
        if not self.better:
            return ladder
        exact = self.nominal.certificate.exact
        return ladder._replace(nominal_exact=exact and exact[1], nominal_in_box=self.before.gamma)

    def document(self) -> dict[str, Any]:
        """For --json."""
        nominal = {"gamma": self.nominal.gamma, "proved": self.before.gamma, "kept": not self.better}
        return {**self.robust.document(), "nominal": nominal, "said": self.lines()}

    def lines(self) -> list[str]:
        """For people, below the ladder."""
        return [*self.robust.lines(), f"           {self._worth()}"]

    def _worth(self) -> str:
        after, before = self.robust.gamma, self.before.gamma
        if not self.better:
            return f"the nominal design is kept: {self.searched}"
        assert after is not None
        price = f"{percent(self.gains.gamma / self.nominal.gamma - 1.0)} without uncertainty"
        if before is None:
            return f"for the nominal design no gamma is proved; against it {price}: {self.searched}"
        return f"against the nominal design {percent(after / before - 1.0)} in the box, {price}: {self.searched}"


def design_for_box(
    problem: Problem,
    box: Box,
    nominal: Gains,
    *,
    search: bool = True,
    budget: Budget | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> ForBox:
    """Gains with a lower proved gamma for the box than the nominal design, or that.

    KeyboardInterrupt ends the search, and so does the end of the budget; what was best is returned. Gains of another
    method than "exact" are taken as they are, and so are all where not to `search`.
    """
    started, budget = time.perf_counter(), Budget() if budget is None else budget
    try:
        before = robust(problem, nominal.K, nominal.H, box, budget=budget)
    except KeyboardInterrupt:  # without it nothing is known of the box
        if budget.asked > 1:
            raise
        before, search = robust(problem, nominal.K, nominal.H, box, budget=budget), False
    budget.keep(_PROOFS_KEPT * (time.perf_counter() - started))
    if nominal.method != "exact":
        return ForBox(nominal, before, nominal, before, f"method {nominal.method} does not design for a box")
    if not search:
        return ForBox(nominal, before, nominal, before, "interrupted, nothing else was tried")
    descent = _Search(problem, box, nominal, before, budget, progress)
    ended = descent.run()
    searched = f"{ended} after {counted(descent.steps, 'change')} at {counted(len(descent.met), 'corner')} of the box"
    if descent.best is None:
        return ForBox(nominal, before, nominal, before, f"nothing better was found; {searched}")
    K, H, after = descent.best
    budget.end()
    try:
        certificate = budget.to_its_end(
            lambda: certify(problem, K, H, budget=budget), lambda: certify_at_once(problem, K, H)
        )
    except Unattainable:
        return ForBox(nominal, before, nominal, before, f"what was found has no certificate; {searched}")
    known = {name: getattr(nominal.certificate, name) for name in _OF_THE_PROBLEM}
    status, steps = f"{nominal.solver.status}; for {box.extent}: {searched}", nominal.solver.iterations + descent.steps
    spent = time.perf_counter() - started
    update = {
        "K": K,
        "H": H,
        "certificate": certificate.model_copy(update=known),
        "solver": nominal.solver.model_copy(update={"status": status, "iterations": steps}),
        "seconds": nominal.seconds | {"box": spent, "total": nominal.seconds["total"] + spent},
    }
    return ForBox(with_worst_case(nominal.model_copy(update=update)), after, nominal, before, searched)


class _Search:
    """The state of one `design_for_box`, in natural units, so that it is there when the search is interrupted."""

    def __init__(
        self,
        problem: Problem,
        box: Box,
        start: Gains,
        before: Robust,
        budget: Budget,
        progress: Callable[[Progress], None] | None,
    ) -> None:
        self.problem, self.box, self.budget, self.progress = problem, box, budget, progress
        self.natural = NaturalUnits(problem, None if box.entries else Coordinates.of(problem))
        self.natural_box = in_units(box, self.natural)
        self.barrier = Barrier(self.natural.problem, _HORIZON, held=self.natural.held)
        self.longest = longest_horizon(problem)
        there = self.natural.there(start.K, start.H)
        self.v = self.begin = self.barrier.entries.pack(*stacked_links(self.natural.problem, *there))
        self.is_proved, self.steps = True, 0  # whether v was looked at; how many came before
        self.met: set[tuple[tuple[int, ...], ...]] = set()  # corners
        self.least = math.inf if before.gamma is None else before.gamma
        self.best: tuple[LinkMatrices, LinkMatrices, Robust] | None = None  # that has this gamma, if it is not `before`

    def run(self) -> str:
        """How it ended."""
        try:
            with looking(self.budget.check):
                self.descend()
        except KeyboardInterrupt:
            return self._stopped("interrupted")
        except TimeIsUp:
            return self._stopped("out of time")
        return "converged"

    def _stopped(self, why: str) -> str:
        if not self.is_proved:
            with suppress(KeyboardInterrupt):  # what was proved before is there
                self.prove()
        return why

    def descend(self) -> None:
        """Down the weights, until gamma for the box falls no further."""
        self.budget.check()
        self.meet(math.inf, most=1)
        last = math.inf
        for mu in _WEIGHTS:
            most = min(len(self.met) + _ROUNDS, _MOST_MODELS)
            while self.meet(self.follow(mu), most=most):
                self.budget.check()
            gamma = self.prove()
            if self.best is not None and not gamma < last * (1.0 - _BETTER):
                break
            last = gamma

    def follow(self, mu: float) -> float:
        """To the minimum of J for the models met so far; sqrt(g) there, in natural units."""
        operators = [
            Operator(inputs.model(*self.barrier.entries.unpack(self.v)), inputs.pattern)
            for inputs in self.barrier.models
        ]
        g = max(horizon_gain(operator, self.barrier.horizon, width=1e-3)[1] for operator in operators)
        x = np.append(self.v, math.log(1.02 * g))

        def advance(point: bfgs.Point) -> None:
            self.v, self.is_proved = point.x[:-1], False
            self.steps += 1
            if self.progress is not None:
                start = f"the nominal design, with {counted(len(self.met), 'corner')} of the box"
                gamma = self.natural.output * math.exp(point.x[-1] / 2.0)
                self.progress(Progress(start, mu, self.steps, gamma, self.budget.spent, self.barrier.horizon))

        first = self.barrier.inverse_hessian(x, mu)
        function = self.budget.watched(self.barrier.descent(mu))
        return math.exp(bfgs.minimise(function, x, first, advance, enough=0.3 * mu).x[-1] / 2.0)

    def meet(self, gamma: float, *, most: int) -> bool:
        """Whether there is more to do on this weight: one corner more, up to so many, or a horizon twice as long."""
        problem, gains = self.natural.problem, self.barrier.entries.unpack(self.v)
        found = worst(problem, *link_gains(problem, *gains), self.natural_box)
        corner = found.ends, found.rows, found.signs
        if corner not in self.met:
            if len(self.met) == most:
                return False
            self.met.add(corner)
            carry = self.box.carry or problem.carries_plant
            self.barrier.models.append(Inputs(problem, real(problem, found.truth), carry=carry))
            return True
        if found.gain > gamma * (1.0 + _SHORT) and 2 * self.barrier.horizon <= self.longest:
            self.barrier.horizon *= 2
            if math.isinf(found.gain):  # gamma_T leads to gains that are not stable, too
                self.v = self.begin
            return True
        return False

    def prove(self) -> float:
        """Gamma of v for the box, infinite where none is proved; kept, if it is the least."""
        K, H = self.natural.back(*link_gains(self.natural.problem, *self.barrier.entries.unpack(self.v)))
        found = robust(self.problem, K, H, self.box, budget=self.budget)
        self.is_proved = True
        gamma = math.inf if found.gamma is None else found.gamma
        if gamma < self.least:
            self.least, self.best = gamma, (K, H, found)
        return gamma
