"""What single runs keep with a probability, held against many of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from made_recordings import record, simulate

from agent.contract.arrays import Array
from agent.contract.gains import Gains
from designer import simulation
from designer.chance import Chance, chance
from designer.problems import find
from designer.replay import replay
from designer.synthesis import design

STEPS, RUNS = 40, 1000
CONFIDENCES = np.linspace(0.05, 0.99, 95)


@pytest.fixture(scope="module", params=["noise", "start"])
def gains(request: pytest.FixtureRequest) -> Gains:
    """Of two nodes in white noise, from 0 and from elsewhere."""
    problem = find("two-nodes").with_(disturbance={"kind": "white", "deviation": 0.1})
    if request.param == "start":
        problem = problem.with_(plant={"initial_error": [3.0] * problem.nx})
    return design(problem, method="least-variance")


def refuted(found: Chance, peaks: Array) -> bool:
    """Whether at some c more of the runs than may be come to it."""
    return any((peaks >= found.level(share)).mean() > 1.0 - share for share in CONFIDENCES)


def test_no_more_runs_exceed_it_than_may(gains: Gains) -> None:
    """A bound that is much smaller is seen to be false: by half where all are from the same start."""
    peaks = simulation.simulate(gains, runs=RUNS, steps=STEPS, processes=1).peaks
    found = chance(gains, steps=STEPS, energy=0.0)
    assert found is not None
    assert not refuted(found, peaks)
    smaller = 2.0 if gains.problem.initial_error.any() else 15.0
    assert refuted(found._replace(gamma=found.gamma / smaller), peaks)


def test_replay_says_it_of_a_run_that_is_as_the_model(gains: Gains, tmp_path: Path) -> None:
    """Also while what the start leaves is still owed, as it is at first."""
    short = replay(record(tmp_path / "short.mcap", gains, simulate(gains, steps=3), steps=3))
    assert short.chance == chance(gains, steps=3, energy=0.0)
    verdict = replay(record(tmp_path / "run.mcap", gains, simulate(gains, steps=STEPS), steps=STEPS))
    assert verdict.chance == chance(gains, steps=STEPS, energy=0.0)
    assert verdict.chance is not None
    assert verdict.chance.text() in verdict.text()
    assert verdict.document()["one_run"]["bound"] == verdict.chance.level()
