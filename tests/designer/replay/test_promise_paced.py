"""What the ledger is told of paced runs: who was away, what was late, and what nobody asked for."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_recordings import record
from paced_runs import PACE, SOON, PacedRun
from places import ROOT

from agent.contract.gains import Gains
from designer.ledger.deviation import Deviation
from designer.ledger.exact import Ledger
from designer.replay import ledger, proofs, replay
from designer.replay.central import Central
from designer.replay.coupling import Coupling
from designer.replay.inputs import draw, logged_inputs
from designer.replay.log import load
from designer.replay.promise import _filled, faults_of

GOLDEN = Gains.load(ROOT / "recordings" / "golden" / "zhu2020-lossy.gains.json")
STEPS = 50


def run(folder: Path, **faults: Any) -> Path:
    sent = PacedRun(GOLDEN, steps=STEPS, **faults).messages
    return record(folder / "run.mcap", GOLDEN, sent, steps=STEPS, period=str(PACE.period))


def told(path: Path) -> dict[int, Deviation]:
    """What the ledger is told."""
    log, central = load(path), Central.of(GOLDEN)
    drawn = draw(log, central)
    hears = proofs.to_be_heard(log, central, drawn)
    return faults_of(Coupling.of(log, central, logged_inputs(log, central, drawn), drawn, hears), hears)


def test_without_faults_the_promise_is_whole(tmp_path: Path) -> None:
    path = run(tmp_path)
    assert told(path) == {}
    assert replay(path).ledger.is_plain


def test_a_node_that_was_away_is_absent_and_begins_again(tmp_path: Path) -> None:
    path = run(tmp_path, away={"1": range(30, 36)})
    found = told(path)
    assert [k for k, deviation in found.items() if 0 in deviation.absent] == list(range(30, 36))
    ((beginner, origin),) = found[36].begun
    assert beginner == 0
    assert origin is None or origin in {1, 2, 3}
    book = Ledger.of(GOLDEN)
    for k in range(36):
        book.tell(found.get(k, Deviation()))
        book.step()
    book.tell(found[36])
    verdict = replay(path)
    assert verdict.agrees
    assert verdict.ledger.worst.factor >= book.gain() / book.gamma > 1.2
    assert verdict.ledger.last.status == "valid"
    assert "steps with faults" in verdict.text()


@pytest.mark.parametrize("faults", [{}, {"away": {"1": range(30, 36)}}, {"frozen": {"2": range(20, 26)}}])
def test_the_ledger_alone_says_what_the_whole_replay_says(tmp_path: Path, faults: dict[str, Any]) -> None:
    path = run(tmp_path, **faults)
    account = ledger([path])
    assert account == replay(path).ledger
    assert account.is_plain == (not faults)


def test_a_message_that_is_lost_on_the_way_is_told_and_a_measurement_too(tmp_path: Path) -> None:
    def delay(receiver: str, topic: str, step: int) -> float:
        lost = (receiver, topic) == ("4", "node/2/estimate") and 10 <= step < 20
        lost |= (receiver, topic, step) == ("3", "node/3/measurement", 25)
        return math.inf if lost else SOON

    found = told(run(tmp_path, delay=delay))
    assert found.pop(25) == Deviation(unmeasured=frozenset({2}))
    assert set(found.values()) == {Deviation(substituted=frozenset({(3, 1)}))}
    assert set(found) >= set(range(13, 17))  # also in modes in which node "4" did not ask


def test_what_nobody_asked_for_is_as_at_the_nearest_steps_that_did() -> None:
    asked = np.array([0, 1, 0, 0, 1, 0, 1, 0, 0, 1, 0], dtype=bool).reshape(-1, 1, 1)
    failed = np.array([0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0], dtype=bool).reshape(-1, 1, 1)
    assert _filled(failed, asked).astype(int).ravel().tolist() == [0, 0, 1, 1, 1, 1, 0, 0, 0, 0, 0]
