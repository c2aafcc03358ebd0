"""A bus whose door leads nowhere: what it makes of words that come in an order of the test's own."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from typing import Any

import pytest

from agent.contract.errors import RunBroken
from agent.contract.gains import Gains
from agent.contract.keys import COORDINATOR, RECORDER, measurement
from agent.contract.messages import Acknowledged, Control, Measurement, Mode, Ready
from agent.guard import FLOOD, Unfit
from agent.network.bus import Bus
from agent.network.configuration import Network
from agent.network.words import ChannelClosed, Duty, Incoming, Orphaned, Peer, Refused, Replayed, RunClosed, Sample
from agent.roles.joining import join

SAMPLE = Sample("mode", b"", None)
CLOSED = Acknowledged(steps=1, messages=1, missing=0, received={}, reached={}, lacking=[], closed=True)


class Nowhere:
    """A session that takes whatever is asked of it; `hear` is what the network does."""

    def __init__(self, network: Network, *, run: str, who: str, hand_over: Any) -> None:
        self.identity, self._hand_over = "2", hand_over
        self.said: list[str] = []

    def hear(self, *words: Incoming) -> None:
        for word in words:
            self.do(lambda word=word: word)

    def do(self, duty: Duty) -> None:
        self._hand_over(duty)

    def say(self, topic: str, payload: bytes) -> None:
        self.said.append(topic)

    def __getattr__(self, name: str) -> Any:
        return lambda *arguments, **more: None


def bus_of(who: str) -> Bus:
    return Bus(Network(wait=5.0), run="test", who=who, session=Nowhere, signals=lambda handler: {})


@pytest.fixture
def node() -> Iterator[Bus]:
    with bus_of("node-n0") as bus:
        yield bus


@pytest.fixture
def recorder() -> Iterator[Bus]:
    with bus_of(RECORDER) as bus:
        yield bus


def door(bus: Bus) -> Any:
    return bus._session


def order(word: str, *, step: int = 0) -> Control:
    return Control(order=word, steps=9, seed=1, window=8, external=[], reason="", step=step)


def ready(**more: Any) -> Ready:
    return Ready(who="node-n0", session="1", gains="", **more)


def test_who_joins_as_the_run_ends_is_told_so(node: Bus, gains: Gains) -> None:
    """The coordinator's reason is that there is none."""
    door(node).hear(order("close"))
    with pytest.raises(RunBroken, match=r'^the run had ended before node "n0" could join it$'):
        join(node, gains)


def test_what_is_said_to_a_coordinator_that_has_come_back_does_not_end_a_recorder_that_has(recorder: Bus) -> None:
    """Both hear it."""
    door(recorder).hear(ready(underway=True), Peer(COORDINATOR, True))
    assert list(recorder.meet([COORDINATOR])) == [COORDINATOR]
    with bus_of(COORDINATOR) as coordinator:
        door(coordinator).hear(ready(underway=True))
        with pytest.raises(Orphaned):
            list(coordinator.meet([RECORDER]))


def test_every_request_for_replay_is_answered_before_a_replay_is_over(recorder: Bus) -> None:
    """The answer to an earlier one says nothing of what was published since."""
    for _ in range(2):
        recorder.request_replay("node-n0", first=0)
    door(recorder).hear(Replayed("node-n0"), SAMPLE, Replayed("node-n0"))
    assert list(recorder.replayed(["node-n0"])) == [SAMPLE]
    recorder.request_replay("node-n0", first=1)
    door(recorder).hear(Replayed("node-n0"), SAMPLE)
    assert isinstance(recorder.receive(), Replayed)  # while the run goes on
    assert list(recorder.replayed(["node-n0"])) == []


def test_who_began_with_the_run_is_not_sent_away_by_who_came_later(node: Bus) -> None:
    """Nor is anybody, where nobody else of the name is to be seen."""
    for is_there in (False, True):
        if is_there:
            for session in ("1", "2"):
                node.guard.came("node-n0", session)
            node.has_begun = True
        door(node).do(lambda: node._refuse(b"taken"))
    door(node).hear(SAMPLE)
    assert node.receive() == SAMPLE
    node.is_late = True
    door(node).do(lambda: node._refuse(b"taken"))
    with pytest.raises(Refused, match=r'^node "n0" takes part in run "test" already; start it once$'):
        node.receive()


@pytest.mark.parametrize("patient", [False, True])
def test_the_end_of_a_paced_run_waits_for_a_recorder_on_its_way_back(node: Bus, patient: bool) -> None:
    """As long as the coordinator is there, which waits for it, too; in lock-step the recorder's end is the run's."""
    node.patient = patient
    door(node).hear(Peer(COORDINATOR, True), order("close"))
    assert node.receive() == Peer(COORDINATOR, True)
    with pytest.raises(RunClosed):
        node.receive()
    door(node).do(lambda: node._forget(CLOSED))
    assert node.wait_for_close() == (CLOSED if patient else None)
    node._ending.last_word = None
    door(node).hear(Peer(COORDINATOR, False))
    assert node.wait_for_close() is None


def test_a_late_recorder_waits_for_whom_it_has_not_seen(recorder: Bus) -> None:
    door(recorder).hear(Peer("node-n0", True), SAMPLE)
    recorder.wait_until_there(["node-n0"])
    assert recorder._words.take(time.monotonic()) == SAMPLE
    assert recorder._words.take(-math.inf) is None


def test_nothing_is_published_when_the_run_is_over(node: Bus) -> None:
    """Nobody would record it; whoever computes ends there."""
    node.publish("mode", Mode(step=0, mode="a"))
    assert node.unrecorded == 1
    node.is_over = True
    with pytest.raises(ChannelClosed):
        node.publish("mode", Mode(step=1, mode="a"))
    assert node.unrecorded == 1


def test_who_publishes_or_acknowledges_has_come_to_that_step(node: Bus, recorder: Bus) -> None:
    """Whatever the role, what is far ahead of it is refused; an event about the past takes it nowhere."""
    for step, now in ((0, 0), (5000, 5000), (4999, 5000)):
        node.publish("mode", Mode(step=step, mode="a"))
        assert node.guard.now == now
    recorder.acknowledge(CLOSED.model_copy(update={"steps": 5000}))
    assert recorder.guard.now == 5000


def test_a_run_ends_with_a_sentence_where_a_reading_is_lost_for_good(node: Bus, gains: Gains) -> None:
    """Its node would wait for it until others lose patience. Who leaves already does not need it."""
    name = gains.problem.node_names[0]
    topic = measurement(name)
    node.guard.know(gains.problem)
    node.guard.begin(steps=9, external=(name,), paced=False)
    with pytest.raises(Unfit, match=f"^{FLOOD}$"):
        node.guard.turn_away(topic, Measurement(step=3, y=[0.0]).encode(), None)
    with pytest.raises(RunBroken, match=rf'^node "n0" has no room for step 3 of {topic}: 8192 messages wait there; a '):
        node.receive()
    door(node).hear(CLOSED)
    node._forget(CLOSED)
    assert node.wait_for_close() == CLOSED
