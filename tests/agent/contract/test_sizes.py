"""No message of a run is larger than the network lets through."""

from __future__ import annotations

import sys

import pytest
from made_recordings import random_problem

from agent.contract.keys import (
    ACCOUNT,
    EVENT,
    MODE,
    PLANT_STATE,
    data_topics,
    estimate,
    measurement,
    participants,
    sensor_who,
)
from agent.contract.messages import (
    DIGEST_SIZE,
    TAG_SIZE,
    Account,
    Acknowledged,
    BrokenOff,
    Control,
    Estimate,
    Event,
    Measurement,
    Message,
    Mode,
    PlantState,
    Stamp,
)
from agent.contract.problem import Problem
from agent.contract.sizes import largest, longest

LONGEST, LAST = -sys.float_info.min, 2**63 - 1  # no float has more digits, no step
SENTENCE = "…" * 1000  # three bytes each


def people(problem: Problem) -> list[str]:
    return [*participants(problem), *map(sensor_who, problem.node_names)]


def stamp_of(problem: Problem) -> bytes:
    return Stamp(LAST, LAST, max(people(problem), key=len), bytes(DIGEST_SIZE), bytes(TAG_SIZE)).encode()


def data(problem: Problem) -> dict[str, bytes]:
    """The largest message of every topic."""
    names = problem.node_names
    who, mode = max(people(problem), key=len), max(problem.mode_names, key=len)
    x, z, w = ([LONGEST] * size for size in (problem.nx, problem.nz, problem.nw))
    times = {f"to_{what}_{which}": LONGEST for what in ("estimate", "step") for which in ("median", "p99", "max")}
    counts = dict.fromkeys(("steps", "pairs", "pairs_substituted", "measurements_substituted", "late"), LAST)
    found: dict[str, Message] = {
        MODE: Mode(step=LAST, mode=mode, index=len(problem.mode_names) - 1),
        PLANT_STATE: PlantState(step=LAST, x=x, z=z, w=w, arrived=[1] * problem.n),
        EVENT: Event(
            step=LAST, kind=who, who=who, detail=SENTENCE, about=who, steps=[LAST] * 1024, seconds=[LONGEST] * 1024
        ),
        ACCOUNT: Account(step=LAST, who=who, processor=LONGEST, **counts, **times),
    }
    for node in problem.nodes:
        y = [LONGEST] * len(node.C)
        found[measurement(node.name)] = Measurement(step=LAST, y=y)
        found[estimate(node.name)] = Estimate(
            step=LAST, x_hat=x, innovation=y, z_hat=z, mode=mode, heard=list(names), measured=False, origin=max(names)
        )
    return {topic: message.encode() for topic, message in found.items()}


def words(problem: Problem) -> list[bytes]:
    """The largest words of the two who say most."""
    everybody = people(problem)
    counts = dict.fromkeys(everybody, 2**53)
    said = [
        Acknowledged(
            steps=LAST,
            messages=LAST,
            missing=LAST,
            received=counts,
            reached=counts,
            lacking=data_topics(problem),
            closed=False,
            broken_off=BrokenOff(reason=SENTENCE, steps=LAST, stop=False),
            greets=max(everybody, key=len),
        ),
        Control(
            order="start",
            steps=LAST,
            seed=LAST,
            window=1024,
            external=list(problem.node_names),
            reason=SENTENCE,
            faults=["mute-link:node-100>node-101,steps=1000-2000"] * 500,
            cast=dict.fromkeys(everybody, f"{LAST:020d}-{2**128 - 1:x}"),
        ),
    ]
    return [word.model_dump_json().encode() for word in said]


PROBLEMS = pytest.mark.parametrize(
    "problem",
    [
        random_problem(1, ny=(1,)),
        random_problem(2, ny=(3, 1), nx=300, nz=200, nw=7),
        random_problem(3, ny=(1,) * 60, nx=2, modes=1),
        random_problem(4, ny=(900,), nw=700),
    ],
    ids=["small", "many states", "many nodes", "many measurements"],
)


@PROBLEMS
def test_every_message_is_let_through(problem: Problem) -> None:
    """And not much more: half of the room is for what a problem has, or for an event about 1024 steps."""
    stamp = stamp_of(problem)
    size = max(map(len, [*(message + stamp for message in data(problem).values()), *words(problem)]))
    assert size <= largest(problem) <= 3 * size


@PROBLEMS
def test_the_network_lets_through_what_the_guard_would_look_at(problem: Problem) -> None:
    """Topic by topic the guard lets in the largest message; whatever it would let in comes so far."""
    by_topic, messages = longest(problem), data(problem)
    assert by_topic.keys() == messages.keys()
    assert all(len(message) <= by_topic[topic] for topic, message in messages.items())
    assert max(by_topic.values()) + len(stamp_of(problem)) <= largest(problem)
