"""What each participant may do on the network: the table of `keys`, as key expressions. Pure.

Access control allows this, and nothing else.
"""

from __future__ import annotations

from typing import NamedTuple

from agent.contract.keys import (
    ACCOUNT,
    ACKNOWLEDGED,
    CONTROL,
    COORDINATOR,
    EVENT,
    FACTS,
    MODE,
    PLANT,
    RECORDER,
    VIEWER,
    alive,
    data_topics,
    estimate,
    joining,
    key,
    leaving,
    measurement,
    node_who,
    participants,
    ready,
    refusals,
    refused,
    replay,
    sender_of,
    sensor_who,
    session,
    watch,
)
from agent.contract.problem import Problem


class Rights(NamedTuple):
    """Key expressions that one participant may use, by what for."""

    says: list[str]  # publishes
    hears: list[str]  # subscribes to
    shows: list[str]  # has liveliness tokens
    sees: list[str]  # is told of others' tokens
    answers: list[str]  # is asked
    asks: list[str]


def everybody(problem: Problem) -> list[str]:
    """Everybody who may have a certificate: participants, sensors, and who looks on."""
    return [*participants(problem), *map(sensor_who, problem.node_names), VIEWER]


def rights(problem: Problem, *, run: str) -> dict[str, Rights]:
    """Of everybody, in run `run`."""
    return {who: _rights(who, problem, run) for who in everybody(problem)}


def _rights(who: str, problem: Problem, run: str) -> Rights:
    def keys(*topics: str) -> list[str]:
        return [key(run, topic, who=who) for topic in topics]

    if who == VIEWER:
        found = key("*", alive(COORDINATOR))  # whatever the run is called that it looks for
        return Rights([], [key(run, watch("**"))], [], [*keys(alive("*"), session("*", "*")), found], [], keys(FACTS))
    data = _data(who, problem)
    if who.startswith(sensor_who("")):
        return Rights(keys(*data), keys(MODE), keys(alive(who)), keys(alive("*")), [], [])
    own = refused(who, "*"), session(who, "*")
    words = {COORDINATOR: [CONTROL], RECORDER: [ACKNOWLEDGED]}.get(who, [])
    return Rights(
        says=keys(*data, *map(watch, data), *words, own[0], joining(who), leaving(who), ready(who), refusals(who)),
        hears=[key(run, topic) for topic in (*_heard(who, problem), own[0])],
        shows=keys(alive(who), own[1]),
        sees=keys(alive("*"), session("*", "*")),
        answers=keys(replay(who), *([FACTS] if who == RECORDER else [])),
        asks=keys(*map(replay, participants(problem))) if who == RECORDER else [],
    )


def _data(who: str, problem: Problem) -> list[str]:
    """The topics on which `who` may publish data; a measurement is the plant's or its sensor's."""
    names = problem.node_names
    own = [topic for topic in data_topics(problem) if who in (sender_of(topic), sender_of(topic, external=names))]
    return [*own, EVENT, *([ACCOUNT] if who.startswith(node_who("")) else [])]


def _heard(who: str, problem: Problem) -> list[str]:
    """The topics to which a participant listens."""
    if who == RECORDER:
        return [*data_topics(problem), EVENT, ACCOUNT, ready("*"), CONTROL]
    if who == COORDINATOR:
        return [ACCOUNT, ACKNOWLEDGED, joining("*"), leaving("*"), ready("*"), refusals("*")]
    if who == PLANT:
        return [MODE, CONTROL, ACKNOWLEDGED]
    i = next(i for i, name in enumerate(problem.node_names) if node_who(name) == who)
    others = (problem.node_names[j] for j in problem.ever_heard(i) if j != i)
    return [MODE, measurement(problem.node_names[i]), *map(estimate, others), CONTROL, ACKNOWLEDGED]
