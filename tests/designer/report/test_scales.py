"""Axes end near the data, and a long run keeps its extremes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from designer.report.scales import Scale, brief, columns, linear, logarithmic, step_ticks

FLOATS = st.floats(-1e150, 1e150)


@given(st.lists(FLOATS, min_size=1, max_size=20), st.booleans())
def test_a_linear_axis_holds_the_data_and_ends_near_it(values: list[float], from_zero: bool) -> None:
    data = np.abs(values) if from_zero else np.array(values)
    scale = linear([data, np.array([np.nan])], from_zero=from_zero)
    assert scale.low <= data.min() <= data.max() <= scale.high
    span = data.max() - (0.0 if from_zero else data.min())
    assert scale.high - scale.low <= 1.0801 * span or span == 0.0
    assert ((scale.of(data) >= 0.0) & (scale.of(data) <= 1.0)).all()


@given(st.floats(-1e6, 1e6), st.floats(1e-6, 1e6))
def test_ticks_are_few_round_and_within(low: float, span: float) -> None:
    scale = Scale(low, low + span)
    ticks = scale.ticks()
    assert 2 <= len(ticks) <= 8
    steps = np.diff(ticks)
    assert np.allclose(steps, steps[0])
    assert all(low - 1e-6 * span <= tick <= low + (1.0 + 1e-6) * span for tick in ticks)


def test_a_logarithmic_axis_has_decades() -> None:
    scale = logarithmic([np.array([3e-18, 0.0, np.nan]), np.array([1e-14])])
    assert scale.low <= 3e-18
    assert scale.high >= 1e-14
    assert scale.ticks() == [1e-17, 1e-16, 1e-15, 1e-14]
    assert logarithmic([np.array([1e-9, 1.0])], decades=4).low == pytest.approx(1e-4)
    assert len(logarithmic([np.array([1e-30, 1.0])]).ticks()) <= 6


@given(st.integers(1, 5000), st.integers(1, 300), st.data())
def test_columns_keep_the_extremes_of_every_stretch(steps: int, most: int, data: st.DataObject) -> None:
    first = data.draw(st.integers(0, steps - 1))
    values = np.random.default_rng(steps).normal(size=(steps, 2))
    values[:: data.draw(st.integers(1, 9)), 0] = np.nan
    shown = columns(first, steps, most)
    low, high = shown.extremes(values)
    assert len(low) == len(high) == shown.number <= most
    for column in {0, shown.number // 2, shown.number - 1}:
        part = values[first + column * shown.stretch : first + (column + 1) * shown.stretch]
        for node in range(2):
            known = part[np.isfinite(part[:, node]), node]
            if len(known):
                assert (low[column, node], high[column, node]) == (known.min(), known.max())
                assert shown.means(values)[column, node] == pytest.approx(known.mean())
            else:
                assert np.isnan([low[column, node], high[column, node], shown.means(values)[column, node]]).all()


@given(st.integers(0, 10**6), st.integers(0, 10**6))
def test_ticks_of_steps_are_whole_steps(first: int, more: int) -> None:
    ticks = step_ticks(first, first + more)
    assert all(first <= tick <= first + more for tick in ticks)
    assert len(ticks) <= 14
    assert len(ticks) >= 2 or more < 4


def test_numbers_for_people() -> None:
    assert brief(0.0880713) == "0.08807"
    assert brief(-2.5e-16, 2) == "−2.5·10⁻¹⁶"
    assert brief(3.45e14) == "3.45·10¹⁴"
    assert brief(0.0) == "0"
