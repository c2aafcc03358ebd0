"""What a receiver says of messages that were not there in time."""

from __future__ import annotations

import pytest

from agent.contract.messages import Way
from agent.pacing.reasons import TELL_SECONDS, Reasons

TOPIC = "node/2/estimate"
QUICK, SLOW = Way(0.001, 0.002, 0.003), Way(0.01, 0.02, 0.03)


def told(*came: tuple[float, Way | None]) -> tuple[str, list[float], list[float]]:
    """What is said of messages that came so many seconds after their deadline, on such ways."""
    reasons = Reasons("node-1", patience=1.0)
    for step, (seconds, way) in enumerate(came):
        reasons.missed(step, TOPIC, deadline=float(step), gone=False)
        assert reasons.came(step, TOPIC, step + seconds, lambda way=way: way)  # type: ignore[misc]
    (event,) = reasons.events(len(came) + TELL_SECONDS, step=9)
    assert event.steps == list(range(len(came)))
    return event.detail, event.seconds, event.way


def test_of_late_messages_the_way_of_the_latest_is_told() -> None:
    detail, seconds, way = told((0.004, QUICK), (0.08, SLOW), (0.002, QUICK))
    assert seconds == pytest.approx([0.004, 0.08, 0.002])
    assert way == list(SLOW)
    assert "late by up to 80 ms (60 ms on its way)" in detail


def test_a_way_that_is_not_known_is_not_told() -> None:
    """A sensor may be without a trace."""
    detail, _, way = told((0.08, None), (0.004, QUICK))
    assert way == []
    assert "way" not in detail


def test_nobody_asks_for_the_way_of_a_message_that_nobody_waited_for() -> None:
    def never() -> Way | None:
        raise AssertionError

    assert not Reasons("node-1", patience=1.0).came(3, TOPIC, 3.0, never)


def test_of_what_did_not_come_there_is_no_way() -> None:
    reasons = Reasons("node-1", patience=1.0)
    reasons.missed(0, TOPIC, deadline=0.0, gone=False)
    reasons.missed(0, "node/3/estimate", deadline=0.0, gone=True)
    assert [event.way for event in reasons.events(9.0, step=9, hurry=True)] == [[], []]
