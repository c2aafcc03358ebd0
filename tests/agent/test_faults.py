"""Faults mean what they say, happen once, and what is impossible is refused in a sentence."""

from __future__ import annotations

import math

import pytest
from made_recordings import random_gains, random_problem

from agent.contract.errors import InputError
from agent.faults import Arriving, Fault, Ordeal, parse

PROBLEM = random_gains(random_problem(3)).problem
STEPS = 200


def fault(text: str) -> Fault:
    return parse(text, PROBLEM, steps=STEPS)


def a_link() -> tuple[str, str]:
    """A sender and a receiver that hears it in some mode."""
    for i, receiver in enumerate(PROBLEM.node_names):
        for j in PROBLEM.ever_heard(i):
            if j != i:
                return PROBLEM.node_names[j], receiver
    raise AssertionError("nobody hears anybody")


@pytest.mark.parametrize(
    ("text", "kind", "who", "steps", "seconds"),
    [
        ("kill:node=n2,step=100", "kill", "node-n2", (100, 100), 0.0),
        ("kill:coordinator,step=0", "kill", "coordinator", (0, 0), 0.0),
        ("kill:recorder,step=7", "kill", "recorder", (7, 7), 0.0),
        ("freeze:node=n3,step=50,for=2s", "freeze", "node-n3", (50, 50), 2.0),
        ("freeze:plant,for=250ms,step=5", "freeze", "plant", (5, 5), 0.25),
        ("delay:node=n1,by=30ms", "delay", "node-n1", (0, STEPS - 1), 0.03),
        ("delay:node=n1,by=1.5s,steps=50-80", "delay", "node-n1", (50, 80), 1.5),
        ("mute-link:plant>n0,steps=9", "mute-link", "plant", (9, 9), 0.0),
        ("drop:probability=0.05", "drop", "", (0, STEPS - 1), 0.0),
    ],
)
def test_a_fault_means_what_it_says(text: str, kind: str, who: str, steps: tuple[int, int], seconds: float) -> None:
    found = fault(text)
    assert (found.text, found.kind, found.who, (found.first, found.last)) == (text, kind, who, steps)
    assert found.seconds == pytest.approx(seconds)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("burn:node=n1,step=3", "there is no 'burn'"),
        ("kill", "must say whom"),
        ("kill:step=3", "must say whom"),
        ("kill:nobody,step=3", "must say whom"),
        ("kill:node=9,step=3", 'node "9" does not exist'),
        ("kill:node=n1", '"step" is missing'),
        ("kill:node=n1,step=200", "200 is not within the steps of the run, 0-199"),
        ("kill:node=n1,step=3-5", "is neither a step"),
        ("kill:node=n1,step=-1", "is neither a step"),
        ("kill:node=n1,step=3,steps=4", 'kill takes no "steps"'),
        ("freeze:node=n1,step=3", '"for" is missing'),
        ("freeze:node=n1,step=3,for=2", "2 is not a time"),
        ("freeze:node=n1,step=3,for=0s", "0s is not a time"),
        ("mute-link:n1", "a link looks like 1>3"),
        ("mute-link:n1>n1", "in no mode"),
        ("mute-link:n1>9", 'node "9" does not exist'),
        ("mute-link:9>n1", 'node "9" does not exist'),
        ("delay:node=n1", '"by" is missing'),
        ("delay:plant,by=3ms", "must say whom"),
        ("drop:probability=0", "0 is not a probability"),
        ("drop:probability=1.5", "1.5 is not a probability"),
        ("drop:node=n1,probability=0.5", "about all messages"),
        ("drop:probability=0.5,steps=80-50", "80-50 is not within"),
        ("drop:probability=0.5,what", "'what' is no value"),
    ],
)
def test_what_is_impossible_is_refused_in_a_sentence(text: str, why: str) -> None:
    with pytest.raises(InputError) as caught:
        fault(text)
    assert why in str(caught.value)
    assert "\n" not in str(caught.value)


def test_what_befalls_a_process_does_so_once() -> None:
    """At its step, or where that was missed at the next one; and not again to the process that follows."""
    faults = [fault("kill:node=n1,step=10"), fault("freeze:node=n1,step=20,for=1s"), fault("kill:plant,step=10")]
    first = Ordeal(faults, "node-n1", begin=0, again=False)
    assert first.due(9) == []
    assert first.due(11) == [faults[0]]
    assert first.due(12) == []
    again = Ordeal(faults, "node-n1", begin=11, again=True)
    assert again.due(15) == []
    assert again.due(20) == [faults[1]]
    assert Ordeal(faults, "plant", begin=10, again=True).due(100) == []
    assert Ordeal(faults, "node-n2", begin=0, again=False).due(100) == []
    at_once = [fault("kill:coordinator,step=0")]
    assert Ordeal(at_once, "coordinator", begin=0, again=False).due(0) == at_once
    assert Ordeal(at_once, "coordinator", begin=0, again=True).due(0) == []


def test_a_muted_link_is_muted_one_way_and_for_its_steps() -> None:
    sender, receiver = a_link()
    faults = [fault(f"mute-link:{sender}>{receiver},steps=5-9")]
    there = Arriving(faults, PROBLEM, receiver, seed=1)
    topic = f"node/{sender}/estimate"
    assert [there.delay(topic, step) for step in (4, 5, 9, 10)] == [0.0, math.inf, math.inf, 0.0]
    assert there.delay("mode", 6) == there.delay(f"node/{receiver}/measurement", 6) == 0.0
    for other in PROBLEM.node_names:
        if other != receiver:
            assert Arriving(faults, PROBLEM, other, seed=1).delay(topic, 6) == 0.0


def test_delays_add_up_and_concern_one_sender() -> None:
    sender, receiver = a_link()
    faults = [fault(f"delay:node={sender},by=30ms"), fault(f"delay:node={sender},by=1s,steps=3")]
    there = Arriving(faults, PROBLEM, receiver, seed=1)
    assert there.delay(f"node/{sender}/estimate", 2) == pytest.approx(0.03)
    assert there.delay(f"node/{sender}/estimate", 3) == pytest.approx(1.03)
    assert there.delay(f"node/{receiver}/measurement", 3) == 0.0


def test_drops_are_the_seeds_and_as_many_as_was_asked_for() -> None:
    sender, receiver = a_link()
    faults = [fault("drop:probability=0.25")]
    topics = (f"node/{sender}/estimate", f"node/{receiver}/measurement")
    for topic in topics:
        drops = [
            [Arriving(faults, PROBLEM, receiver, seed=seed).delay(topic, k) for k in range(STEPS)] for seed in (1, 1, 2)
        ]
        assert drops[0] == drops[1] != drops[2]
        assert 0.15 * STEPS < sum(delay == math.inf for delay in drops[0]) < 0.35 * STEPS
    both = [[Arriving(faults, PROBLEM, receiver, seed=1).delay(topic, k) for k in range(STEPS)] for topic in topics]
    assert both[0] != both[1]
    assert Arriving(faults, PROBLEM, receiver, seed=1).delay("mode", 3) == 0.0
