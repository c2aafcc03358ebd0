"""What the coordinator says of a run that makes no progress, or that cannot be recorded."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
from made_recordings import random_gains, random_problem

from agent.contract.errors import RecordingFailed, RunBroken
from agent.contract.messages import Acknowledged, BrokenOff, Event
from agent.guard import Guard
from agent.network.words import Incoming
from agent.plan import Plan
from agent.roles import coordinator
from agent.roles.coordinator import Conductor

DEADLINE = 10.0


class Scripted:
    """A bus of which every word comes so many seconds after the last one; then there is silence."""

    who = "coordinator"

    def __init__(self, *words: tuple[float, Incoming]) -> None:
        self.now = 1000.0
        self._words = list(words)
        self.published: list[tuple[str, object]] = []
        self.guard = Guard()

    def receive(self, *, timeout: float) -> Incoming | None:
        if self._words and self._words[0][0] <= timeout:
            seconds, word = self._words.pop(0)
            self.now += seconds
            return word
        self.now += timeout
        return None

    def publish(self, topic: str, message: object) -> None:
        self.published.append((topic, message))


def acknowledged(steps: int, *lacking: str) -> Acknowledged:
    return Acknowledged(
        steps=steps, messages=0, missing=0, received={}, reached={}, lacking=list(lacking), closed=False
    )


def give_out_modes(bus: Scripted, monkeypatch: pytest.MonkeyPatch, *, steps: int = 2) -> None:
    monkeypatch.setattr(coordinator, "time", SimpleNamespace(monotonic=lambda: bus.now))
    plan = Plan(steps=steps, seed=0, window=1, deadline=DEADLINE)
    Conductor(bus, random_gains(random_problem(1)), plan, lambda word: None).give_out_modes()  # type: ignore[arg-type]


def test_whoever_lacks_is_named_though_the_recorder_says_so_late(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a busy machine the recorder's word may come after the deadline; the blame is not the recorder's."""
    bus = Scripted((1.5 * DEADLINE, acknowledged(0, "node/n1/estimate")))
    with pytest.raises(RunBroken, match=r"^step 0 lacks node/n1/estimate after 10 s$"):
        give_out_modes(bus, monkeypatch)


def test_a_recorder_that_complains_in_time_ends_the_run_at_the_deadline(monkeypatch: pytest.MonkeyPatch) -> None:
    bus = Scripted((1.0, acknowledged(1)), (1.0, acknowledged(1, "plant/state")))
    with pytest.raises(RunBroken, match=r"^step 1 lacks plant/state after 10 s$"):
        give_out_modes(bus, monkeypatch)
    assert bus.now == 1000.0 + 1.0 + DEADLINE


def test_a_recorder_that_says_nothing_at_all_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(RunBroken, match=r"^the recorder has acknowledged nothing for 20 s, at step 0$"):
        give_out_modes(Scripted(), monkeypatch)


def test_progress_after_the_deadline_is_progress(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where nobody has said what is late, the run goes on."""
    give_out_modes(Scripted((1.5 * DEADLINE, acknowledged(1)), (1.0, acknowledged(2))), monkeypatch)


def test_a_run_that_goes_on_without_a_recording_is_announced_once() -> None:
    bus, words = Scripted(), list[dict[str, Any]]()
    conductor = Conductor(bus, random_gains(random_problem(1)), Plan(steps=9, seed=0), words.append)  # type: ignore[arg-type]
    conductor._heed(None)
    for _ in range(3):
        conductor._heed(BrokenOff(reason="the disk is full", steps=7, stop=False))
    sentence = "the disk is full; there is no recording from step 7 on"
    assert bus.published == [("event", Event(step=0, kind="unrecorded", who="recorder", detail=sentence))]
    assert words == [{"broken_off": sentence}]


def test_a_recorder_may_have_the_run_stop(monkeypatch: pytest.MonkeyPatch) -> None:
    off = BrokenOff(reason="the disk is full", steps=7, stop=True)
    bus = Scripted((1.0, acknowledged(0).model_copy(update={"broken_off": off})))
    with pytest.raises(RecordingFailed, match=r"^the disk is full; there is no recording from step 7 on$"):
        give_out_modes(bus, monkeypatch)
