"""Gains that runs share, in files."""

from __future__ import annotations

from pathlib import Path

import pytest
from made_recordings import random_gains, random_problem

from agent.contract.gains import Gains


@pytest.fixture(scope="session")
def pair() -> Gains:
    """Two nodes that hear each other in one of two modes."""
    return random_gains(random_problem(11, ny=(1, 2), modes=2))


@pytest.fixture(scope="session")
def lone() -> Gains:
    """One node."""
    return random_gains(random_problem(1, ny=(2,), modes=2))


@pytest.fixture(scope="session")
def paths(gains: Gains, pair: Gains, lone: Gains, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Files of gains. Every node is a process that takes a quarter of a second to start."""
    folder = tmp_path_factory.mktemp("gains")
    for name, each in (("three", gains), ("pair", pair), ("lone", lone)):
        each.save(folder / f"{name}.json")
    return {path.stem: path for path in folder.iterdir()}


@pytest.fixture(scope="session")
def gains_path(paths: dict[str, Path]) -> Path:
    """Three nodes and two modes, weights that differ from 1."""
    return paths["three"]


@pytest.fixture(scope="session")
def pair_path(paths: dict[str, Path]) -> Path:
    """Where one node more than the one that suffers is enough."""
    return paths["pair"]


@pytest.fixture(scope="session")
def lone_path(paths: dict[str, Path]) -> Path:
    """One node, for what does not depend on the nodes."""
    return paths["lone"]
