"""Units in which numbers are near 1."""

from __future__ import annotations

import numpy as np
from networks import random_problem

from designer.model.units import natural_units, rescaled


def test_states_that_overflow_keep_their_units() -> None:
    """Units stay finite, and what is rescaled stays a problem."""
    problem = random_problem(1)
    huge = problem.plant.model_copy(update={"A": [[0.5, 1e200], [0.0, 0.5]]})
    units = natural_units(problem.model_copy(update={"plant": huge}))
    assert units.state[0] == 1.0
    assert np.isfinite([*units.state, units.output]).all()
    rescaled(problem.model_copy(update={"plant": huge}), units)
