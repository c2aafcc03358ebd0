"""Runs to report: recordings made without any network, and their accounts."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from made_recordings import observer_gains, random_gains, random_problem, real_problem, record, simulate

from designer.report.account import Account


def recorded(
    folder: Path, *, ny: Sequence[int] = (1, 2, 1, 1), nz: int = 1, steps: int = 50, modes: int = 3, **misdeeds: Any
) -> Path:
    """A whole run with random gains."""
    gains = random_gains(random_problem(3, ny=ny, nz=nz, modes=modes))
    return record(folder / "run.mcap", gains, simulate(gains, steps=steps, **misdeeds), steps=steps)


def recorded_network(folder: Path, *, steps: int = 50, **sizes: Any) -> Path:
    """A whole run of a network that sees losses and loses messages, with gains that track the plant."""
    gains = observer_gains(real_problem(5, ny=(1, 2, 1), **sizes))
    return record(folder / "network.mcap", gains, simulate(gains, steps=steps), steps=steps)


def account_of(folder: Path, **sizes: Any) -> Account:
    """The account of such a run."""
    return Account.of(recorded(folder, **sizes))
