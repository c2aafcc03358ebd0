"""Gains that runs share, in files."""

from __future__ import annotations

from pathlib import Path

import pytest
from made_recordings import random_gains, random_problem

from agent.contract.gains import Gains


@pytest.fixture(scope="session")
def pair() -> Gains:
    """Two nodes that hear each other in one of two modes: the least network, five processes, for what does not depend
    on the number of nodes."""
    return random_gains(random_problem(11, ny=(1, 2), modes=2))


@pytest.fixture(scope="session")
def pair_path(pair: Gains, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The gains of two nodes, in a file."""
    path = tmp_path_factory.mktemp("pair") / "gains.json"
    pair.save(path)
    return path


@pytest.fixture(scope="session")
def gains_path(gains: Gains, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The gains of three nodes and two modes, in a file."""
    path = tmp_path_factory.mktemp("gains") / "gains.json"
    gains.save(path)
    return path
