"""What many tests share. Networks and gains are made by `made_recordings`, without any solver."""

from __future__ import annotations

import pytest
from hypothesis import settings
from made_recordings import random_gains, random_problem

from agent.contract.gains import Gains

# The same examples every time: a test that fails, fails for everybody.
settings.register_profile("repeatable", derandomize=True, deadline=None, database=None)
settings.load_profile("repeatable")


@pytest.fixture(scope="session")
def gains() -> Gains:
    """Three nodes with 1, 2 and 1 measurements, two modes, weights that differ from 1."""
    return random_gains(random_problem(5, ny=(1, 2, 1), modes=2))
