"""Proof 4 of a replay: every message is there exactly once, and every sender's numbering is whole."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np

from designer.replay.topics import Topic

NAMED = 20  # so many faults of a kind are named, the others counted


class Place(NamedTuple):
    """Where a message is missing, or stands more than once."""

    topic: str
    step: int


class Faults(NamedTuple):
    """Faults of one kind: how many, and the first of them by step."""

    total: int
    first: tuple[Place, ...]


class Census(NamedTuple):
    """What is wrong with the messages, apart from what is in them."""

    missing: Faults
    duplicates: Faults
    strange: tuple[str, ...]  # what should not be in the file at all
    numbering: tuple[str, ...]  # faults in the senders' own numbering


def take_census(
    topics: Iterable[Topic], *, steps: int, whole: bool, strange: Iterable[str], events: Counter[int]
) -> Census:
    """Compare what is there with one message of every topic for steps 0 ... `steps` - 1.

    `events` counts the numbers of the events, which do not say who sent them; `whole`: nothing may be missing.
    """
    topics, events, strange = list(topics), events.copy(), list(strange)
    missing: list[Place] = []
    double: list[Place] = []
    lacking: Counter[str | None] = Counter()
    for topic in topics:
        present, counts = np.unique(topic.steps, return_counts=True)
        absent = np.setdiff1d(np.arange(steps), present)
        lacking[topic.who] += len(absent)
        missing += [Place(topic.topic, int(step)) for step in absent]
        again = np.repeat(present, counts - 1)
        double += [Place(topic.topic, int(step)) for step in again]
        if (present >= steps).any():
            strange.append(f"{topic.topic}, step {present[-1]}: the run ended after {steps} steps")
    numbering = [
        fault
        for who in sorted({topic.who for topic in topics if topic.who is not None})
        for fault in _numbering(who, topics, steps, lacking[who], events, whole=whole)
    ]
    return Census(_faults(missing), _faults(double), tuple(strange), tuple(numbering))


def _faults(places: list[Place]) -> Faults:
    in_order = sorted(places, key=lambda place: (place.step, place.topic))
    return Faults(len(places), tuple(in_order[:NAMED]))


def _numbering(
    who: str, topics: list[Topic], steps: int, lacking: int, events: Counter[int], *, whole: bool
) -> Iterator[str]:
    """Faults in one sender's numbering, beyond the messages that are known to be missing or double."""
    numbers: list[int] = []
    for topic in topics:
        if topic.who != who:
            continue
        _, rows = topic.rows(steps)
        of_topic = topic.numbers[rows]
        falls = np.flatnonzero(np.diff(of_topic) <= 0)
        if len(falls):
            before, after = of_topic[falls[0]], of_topic[falls[0] + 1]
            yield f"{topic.topic} has number {after} after {before}, against the order of its steps"
        numbers += of_topic.tolist()
    repeated = sorted(number for number, count in Counter(numbers).items() if count > 1)
    if repeated:
        yield f"{who} has number {repeated[0]} on more than one message"
    if not whole:
        return  # what should come next in a cut file, nobody knows
    holes = sorted(set(range(max(numbers, default=-1) + 1)) - set(numbers))
    unexplained = [number for number in holes if events[number] == 0]
    events.subtract(number for number in holes if events[number] > 0)
    if len(unexplained) > lacking:
        first = ", ".join(map(str, unexplained[:5])) + (", ..." if len(unexplained) > 5 else "")
        yield f"{len(unexplained) - lacking} more messages of {who} are missing, by its numbers {first}"
