"""No message of a run is larger than the network lets through."""

from __future__ import annotations

import sys

import pytest
from made_recordings import random_problem

from agent.contract.keys import data_topics, participants, sensor_who
from agent.contract.messages import (
    DIGEST_SIZE,
    Acknowledged,
    BrokenOff,
    Control,
    Estimate,
    Event,
    Measurement,
    PlantState,
    Stamp,
)
from agent.contract.problem import Problem
from agent.contract.sizes import largest

LONGEST, LAST = -sys.float_info.min, 2**63 - 1  # no float has more digits, no step
SENTENCE = "…" * 1000  # three bytes each


def extremes(problem: Problem) -> list[bytes]:
    """The largest of every kind."""
    names = problem.node_names
    everybody = [*participants(problem), *map(sensor_who, names)]
    who, mode, most = (
        max(everybody, key=len),
        max(problem.mode_names, key=len),
        max(len(node.C) for node in problem.nodes),
    )
    x, y, z, w = ([LONGEST] * size for size in (problem.nx, most, problem.nz, problem.nw))
    data = [
        Estimate(
            step=LAST, x_hat=x, innovation=y, z_hat=z, mode=mode, heard=list(names), measured=False, origin=max(names)
        ),
        PlantState(step=LAST, x=x, z=z, w=w, arrived=[1] * problem.n),
        Measurement(step=LAST, y=y),
        Event(step=LAST, kind=who, who=who, detail=SENTENCE, about=who, steps=[LAST] * 1024, seconds=[LONGEST] * 1024),
    ]
    counts = dict.fromkeys(everybody, 2**53)
    words = [
        Acknowledged(
            steps=LAST,
            messages=LAST,
            missing=LAST,
            received=counts,
            reached=counts,
            lacking=data_topics(problem),
            closed=False,
            broken_off=BrokenOff(reason=SENTENCE, steps=LAST, stop=False),
            greets=who,
        ),
        Control(
            order="start",
            steps=LAST,
            seed=LAST,
            window=1024,
            external=list(names),
            reason=SENTENCE,
            faults=["mute-link:node-100>node-101,steps=1000-2000"] * 500,
            cast=dict.fromkeys(everybody, f"{LAST:020d}-{2**128 - 1:x}"),
        ),
    ]
    stamp = Stamp(LAST, LAST, who, bytes(DIGEST_SIZE)).encode()
    return [message.encode() + stamp for message in data] + [word.model_dump_json().encode() for word in words]


@pytest.mark.parametrize(
    "problem",
    [
        random_problem(1, ny=(1,)),
        random_problem(2, ny=(3, 1), nx=300, nz=200, nw=7),
        random_problem(3, ny=(1,) * 60, nx=2, modes=1),
        random_problem(4, ny=(900,), nw=700),
    ],
    ids=["small", "many states", "many nodes", "many measurements"],
)
def test_every_message_is_let_through(problem: Problem) -> None:
    """And not much more: half of the room is for what a problem has, or for an event about 1024 steps."""
    size = max(map(len, extremes(problem)))
    assert size <= largest(problem) <= 3 * size
