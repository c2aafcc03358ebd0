"""Gains that runs share, in files."""

from __future__ import annotations

from pathlib import Path

import pytest

from agent.contract.gains import Gains


@pytest.fixture(scope="session")
def gains_path(gains: Gains, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The gains of three nodes and two modes, in a file."""
    path = tmp_path_factory.mktemp("gains") / "gains.json"
    gains.save(path)
    return path
