"""The schedule of a paced run does not drift, and durations are counted as they are."""

from __future__ import annotations

import numpy as np
import pytest

from agent.pacing.beat import Beat
from agent.pacing.spread import Spread


def test_a_minute_of_ticks_does_not_drift() -> None:
    """However late each tick is within its period, the next is due on the absolute schedule."""
    beat, rng, now = Beat(period=0.02, begin=100.0), np.random.default_rng(1), 0.0
    for step in range(3001):
        now = max(now, beat.due(step)) + rng.uniform(0.0, 0.019)
        assert beat.catch_up(step, now) == 0.0
    assert beat.due(3000) == pytest.approx(160.0, abs=1e-9)


def test_a_clock_that_stood_goes_on_from_where_it_stood() -> None:
    """No burst of ticks: the schedule moves as a whole, by what is told."""
    beat = Beat(period=0.02, begin=0.0)
    assert beat.catch_up(10, 0.2 + 2.0) == pytest.approx(2.0)
    assert beat.due(10) == pytest.approx(2.2)
    assert beat.due(11) == pytest.approx(2.22)
    assert beat.catch_up(11, 2.23) == 0.0


def test_a_schedule_may_begin_anywhere() -> None:
    assert Beat(period=0.5, begin=7.0, first=40).due(42) == 8.0


@pytest.mark.parametrize("part", [0.01, 0.5, 0.99, 1.0])
def test_quantiles_are_within_a_percent(part: float) -> None:
    durations = np.exp(np.random.default_rng(2).normal(-6.0, 2.0, 5000))
    spread = Spread()
    for duration in durations:
        spread.add(float(duration))
    exact = float(np.quantile(durations, part, method="inverted_cdf"))
    assert exact <= spread.quantile(part) <= 1.0101 * exact
    assert spread.longest == durations.max()


def test_nothing_has_no_duration() -> None:
    assert (Spread().quantile(0.5), Spread().longest) == (0.0, 0.0)
