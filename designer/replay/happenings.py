"""What happened in a recorded run, one by one: losses, substitutions, refusals, missing messages, divergences."""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from agent.contract.keys import PLANT_STATE, data_topics, estimate, measurement
from designer.replay.log import Log
from designer.replay.times import Times
from designer.replay.verdict import Divergence


class Happening(NamedTuple):
    """`kind` is a word, `text` a sentence; `time` is in ns since the epoch."""

    kind: str
    step: int
    who: str  # the name of a node; "" for the plant and the coordinator
    text: str
    is_fault: bool
    time: int


def happenings(log: Log, divergences: list[Divergence], times: Times) -> Iterator[Happening]:
    """In the order of the steps; the divergences as they are given, by step."""
    kinds = [_losses(log, times), _substitutions(log, times), _refusals(log, times), _missing(log, times)]
    return heapq.merge(*kinds, _divergences(divergences, times), key=lambda happening: happening.step)


def _losses(log: Log, times: Times) -> Iterator[Happening]:
    """Measurements that the plant is not in: of the model, where it lost them, or empty ones, of nodes that see it."""
    lost = (log.theta == 0.0) & ~np.array(log.external)
    lost |= log.measured == 0.0
    for step, i in np.argwhere(lost).tolist():
        name = log.gains.problem.node_names[i]
        told = measurement(name) if log.measured[step, i] == 0.0 else PLANT_STATE
        yield Happening("loss", step, name, f'the measurement of node "{name}" was lost', False, times.of(told, step))


def _substitutions(log: Log, times: Times) -> Iterator[Happening]:
    """Messages of neighbours in the present mode that a node did not use, by what it says of its next estimate."""
    problem, members = log.gains.problem, log.senders.members()
    found: list[tuple[int, int, int]] = []  # step, receiver, sender
    heard, mode = log.heard[1:], log.mode[:-1]
    for i in range(problem.n):
        for s in range(len(problem.topologies)):
            at = np.flatnonzero((mode == s) & (heard[:, i] >= 0))
            for j in problem.neighbours(s, i):
                found += [(int(step), i, j) for step in at[~members[heard[at, i], j]]]
    for step, i, j in sorted(found):
        receiver, sender = problem.node_names[i], problem.node_names[j]
        text = f'node "{receiver}" did not use the message of node "{sender}": its own estimate stood in for it'
        yield Happening("substitution", step, receiver, text, False, times.of(estimate(receiver), step + 1))


def _refusals(log: Log, times: Times) -> Iterator[Happening]:
    """Messages that did not fit, as the coordinator has told of them last."""
    for event in sorted(log.said.refusals.values(), key=lambda event: event.step):
        step = min(event.step, max(log.steps - 1, 0))
        yield Happening("refusal", step, "", event.detail, False, int(times.steps[step]))


def _missing(log: Log, times: Times) -> Iterator[Happening]:
    """Messages that are not in the file; of a topic that is not there at all, once."""
    found: list[tuple[int, str, str]] = []
    for topic in data_topics(log.gains.problem):
        steps = times.missing(topic)
        if len(steps) < log.steps or not log.steps:
            found += [(int(step), topic, f"the message of {topic} is not in the file") for step in steps]
        elif not (topic == PLANT_STATE and all(log.external)):
            found.append((0, topic, f"no message of {topic} is in the file"))
    for step, topic, text in sorted(found):
        parts = topic.split("/")
        who = parts[1] if parts[0] == "node" else ""
        yield Happening("missing", step, who, text, True, int(times.steps[step]))


def _divergences(divergences: list[Divergence], times: Times) -> Iterator[Happening]:
    for found in sorted(divergences, key=lambda divergence: divergence.step):
        topic = PLANT_STATE if found.node is None else estimate(found.node)
        text = f"proof {found.proof}: {found.text()} (gap {found.gap:.1e})"
        yield Happening("divergence", found.step, found.node or "", text, True, times.of(topic, found.step))
