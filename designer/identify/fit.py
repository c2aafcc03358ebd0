"""Counts against probabilities, by tests whose levels hold for every number of trials.

A probability: exact binomial, p = 2 min(P(X <= hits), P(X >= hits)), 1 at most. A row of Pi: the likelihood ratio,
its distribution by simulation from the row itself, p = (1 + those not below it) / (1 + simulated), which is exact for
a given number of exits from the mode. Several tests at once: Holm (1979), so that a model that is right in all is
accused of anything with probability `level` at most. Intervals: Clopper and Pearson (1934), each by itself.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import stats

from agent.contract.arrays import Array
from agent.contract.errors import counted
from agent.contract.problem import Problem
from designer.identify.counts import Count, Counts
from designer.replay.topics import Numbers

_SIMULATED, _MOST_SIMULATED = 10_000, 1_000_000
_SEED = 1  # of the simulation: the same counts get the same answer


@dataclass(frozen=True)
class Value:
    """One probability."""

    name: str
    model: float
    count: Count
    interval: tuple[float, float]


@dataclass(frozen=True)
class Finding:
    """One test."""

    what: str
    values: tuple[Value, ...]  # one, or a row of Pi
    p: float | None  # None: there was nothing to test
    is_certain: bool  # the model admits one outcome alone, so that nothing is left to chance
    fits: bool

    @property
    def trials(self) -> int:
        return sum(value.count.trials for value in self.values[:1])

    def lines(self) -> Iterator[str]:
        """For people."""
        verdict = "fits" if self.fits else "DOES NOT FIT"
        if self.p is None:
            verdict = "never tried"
        p = "" if self.p is None or self.is_certain else f", p = {self.p:.2g}"
        yield f"{self.what}: {verdict}, {counted(self.trials, 'trial')}{p}"
        for value in self.values if self.trials else ():
            low, high = value.interval
            name = f"{value.name}: " if value.name else ""
            yield f"  {name}model {value.model:.6g}, observed {value.count.share:.6g} [{low:.4g}, {high:.4g}]"

    def document(self) -> dict[str, Any]:
        return {
            "what": self.what,
            "fits": self.fits,
            "p": self.p,
            "trials": self.trials,
            "values": [
                {
                    "name": value.name,
                    "model": value.model,
                    "hits": value.count.hits,
                    "observed": value.count.share if value.count.trials else None,
                    "interval": list(value.interval),
                }
                for value in self.values
            ],
        }


def findings(problem: Problem, counts: Counts, *, level: float) -> list[Finding]:
    """All tests, none of which is left out, whatever it says; links that cannot and do not lose are not named."""
    found, nodes, modes = [], problem.node_names, problem.mode_names
    for name, beta, count in zip(nodes, problem.beta, counts.arrivals, strict=True):
        found.append(_binomial(f'arrivals at node "{name}"', float(beta), count, level))
    for (i, j), count in counts.deliveries.items():
        rho = float(problem.delivery[i, j])
        if rho < 1.0 or count.hits < count.trials:
            found.append(_binomial(f'deliveries from "{nodes[j]}" to "{nodes[i]}"', rho, count, level))
    simulated = min(max(_SIMULATED, math.ceil(20 * (len(found) + len(modes)) / level)), _MOST_SIMULATED)
    rng = np.random.default_rng(_SEED)
    for name, row, exits in zip(modes, problem.markov.transition, counts.transitions, strict=True):
        what = f'transitions from mode "{name}"'
        trials = int(exits.sum())
        each = [Count(int(hits), trials) for hits in exits]
        values = tuple(
            Value(f'to "{to}"', float(pi), count, interval(count, level))
            for to, pi, count in zip(modes, row, each, strict=True)
        )
        is_certain = bool((row > 0.0).sum() == 1 or exits[row == 0.0].any())
        p = None if not trials else likelihood_ratio(exits, row, simulated, rng)
        found.append(Finding(what, values, p, is_certain, True))
    return _holm(found, level)


def _binomial(what: str, probability: float, count: Count, level: float) -> Finding:
    value = Value("", probability, count, interval(count, level))
    p = binomial(count, probability) if count.trials else None
    return Finding(what, (value,), p, is_certain=probability == 1.0, fits=True)


def binomial(count: Count, probability: float) -> float:
    """The p-value: 0.5 level on either side, so that it agrees with the interval."""
    below = stats.binom.cdf(count.hits, count.trials, probability)
    above = stats.binom.sf(count.hits - 1, count.trials, probability)
    return float(min(1.0, 2.0 * min(below, above)))


def interval(count: Count, level: float) -> tuple[float, float]:
    """Clopper and Pearson's, which has the true probability with 1 - level at least."""
    hits, misses = count.hits, count.trials - count.hits
    low = stats.beta.ppf(level / 2.0, hits, misses + 1) if hits else 0.0
    high = stats.beta.isf(level / 2.0, hits + 1, misses) if misses else 1.0
    return float(low), float(high)


def likelihood_ratio(exits: Numbers, row: Array, simulated: int, rng: np.random.Generator) -> float:
    """The p-value of a row of Pi; 0 where it admits no such transition, 1 where it admits no other."""
    if exits[row == 0.0].any():
        return 0.0
    possible = row > 0.0
    pi, seen = row[possible] / row[possible].sum(), exits[possible]
    if len(pi) == 1:
        return 1.0
    drawn = rng.multinomial(int(seen.sum()), pi, size=simulated)
    least = _ratio(seen[None], pi)[0] * (1.0 - 1e-12)  # equal counts in another order may differ by a rounding
    return (1.0 + int((_ratio(drawn, pi) >= least).sum())) / (1.0 + simulated)


def _ratio(exits: Numbers, pi: Array) -> Array:
    """Sum of n log(n / N pi), (cases,)."""
    n = exits.astype(float)
    expected = n.sum(axis=1, keepdims=True) * pi
    return np.asarray((n * np.log(np.where(n > 0.0, n, 1.0) / np.where(n > 0.0, expected, 1.0))).sum(axis=1))


def _holm(found: list[Finding], level: float) -> list[Finding]:
    """Rejects the smallest p while it is below level / (tests left)."""
    tested = [k for k, finding in enumerate(found) if finding.p is not None and not finding.is_certain]
    fits = {k: found[k].p != 0.0 for k, finding in enumerate(found) if finding.is_certain}
    left = len(tested)
    for k in sorted(tested, key=lambda k: float(found[k].p or 0.0)):
        if float(found[k].p or 0.0) > level / left:
            break
        fits[k] = False
        left -= 1
    return [replace(finding, fits=fits.get(k, True)) for k, finding in enumerate(found)]
