"""The floor, whatever the units."""

from __future__ import annotations

import numpy as np
import pytest

from agent.contract.problem import Problem
from designer.gain.floor import floor, floor_below


def pendulum(unit: float) -> Problem:
    """Its angle is measured; the rate is in units of 1/unit, and the disturbance moves both."""
    return Problem.from_arrays(
        "pendulum",
        A=[[1.05, 0.02 / unit], [0.2 * unit, 1.0]],
        B=[[1.0, 0.0], [0.3 * unit, 0.0]],
        M=[[1.0, 0.5 / unit]],
        C={"a": [[1.0, 0.0]]},
        D={"a": [[0.0, 0.1]]},
        adjacency={"on": [[1.0]]},
        unbiased=True,
    )


@pytest.mark.parametrize("unit", [2.0**-40, 2.0**-20, 2.0**20, 2.0**40])
def test_it_is_the_same_in_any_units(unit: float) -> None:
    assert floor(pendulum(unit)) == floor(pendulum(1.0))


def test_a_state_that_hardly_moves_the_output_is_not_lost() -> None:
    """Here z is of the small unit, and what is measured of the other one: that is still measured."""
    document = pendulum(1.0).document()
    document["plant"] |= {"A": [[1.05, 0.02e-6], [0.2e6, 1.0]]}
    assert np.isfinite(floor(Problem.from_document(document)))


def test_above_what_is_proved_there_is_none() -> None:
    problem = pendulum(1.0)
    assert floor_below(problem, floor(problem)) == floor(problem)
    assert floor_below(problem, 0.99 * floor(problem)) is None
