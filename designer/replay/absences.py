"""Messages of a paced run that are not in the file for a good reason: nobody was there to send them, or they were lost.

What was lost went with the process that held it: the recorder had not got it yet, or was gone itself. Of that the
recorder has given account, by numbers that are void, or nobody knows.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple, Self

import numpy as np

from agent.contract.keys import PLANT, PLANT_STATE
from designer.replay.central import Flags
from designer.replay.said import Said
from designer.replay.topics import Columns, Numbers, Topic

_NEAR = 2  # steps between somebody's last message and the event that says they are gone, beside the silence itself

Void = Mapping[str, Sequence[range]]  # of each sender, numbers that nobody looks for


class Absences(NamedTuple):
    """Why messages are not there, as far as anybody has said."""

    excused: Flags  # (steps, topics): nobody was there to send them
    lost: Flags  # (steps, topics): by the recorder's own account
    untold: Flags  # (steps, n): about when a node may have given reasons that were lost
    perhaps_sent: Flags  # (steps, n): estimates that others may have had

    @classmethod
    def of(
        cls,
        topics: Mapping[str, Topic],
        columns: Columns,
        said: Said,
        void: Void,
        gaps: Void,
        *,
        external: tuple[bool, ...],
        steps: int,
        plant_is_whole: bool,
        resumed: bool,
    ) -> Self:
        """`gaps` are numbers that are not there, of a file in which the recorder does not say what became of them.

        `resumed`: a coordinator has come back. For `plant_is_whole` see `excused`.
        """
        lost = went_with(topics, columns, void, steps)
        return cls(
            excused(topics, columns, said, external, steps, plant_is_whole=plant_is_whole),
            lost,
            untold(topics, columns, void, steps, memory=said.memory)
            | untold(topics, columns, gaps, steps, memory=said.memory),
            perhaps_sent(columns, said, lost, resumed=resumed),
        )

    @classmethod
    def none(cls, steps: int, topics: int, n: int) -> Self:
        """Of a run in lock-step."""
        nothing, of_nodes = np.zeros((steps, topics), dtype=bool), np.zeros((steps, n), dtype=bool)
        return cls(nothing, nothing, of_nodes, of_nodes)


def excused(
    topics: Mapping[str, Topic],
    columns: Columns,
    said: Said,
    external: tuple[bool, ...],
    steps: int,
    *,
    plant_is_whole: bool,
) -> Flags:
    """(steps, topics): which messages are not there because nobody was there to send them.

    A node that begins again says so; for the plant, and for a node that never came back, the coordinator has said
    that it was gone, or, where it was gone itself, the nodes that they heard nothing of it. A node to which the last
    modes did not come has not given its last account. The plant that was asked to go, or stood still as the run ended,
    has not come to the last steps where all that it is known to have sent is there, `plant_is_whole`. A sensor's
    measurement may be missing wherever its node says that it had none.
    """
    has = columns["has"][:steps]
    found = np.zeros_like(has)
    for who, i in said.nodes.items():
        place, told, origin = 2 + 2 * i, columns["told"][:steps, i], columns["origin"][:steps, i]
        for first, end in _gaps(has[:, place]):
            comes_back = end < len(has) and origin[end] != -1
            waited = end == len(has) and said.accounted(i) < first  # for modes that did not come, to the end
            found[first:end, place] = comes_back or waited or _went(said.gone.get(who, []), first, end)
        if external[i]:
            found[:, place + 1] = ~has[:, place] | (told == 0)
    simulated = [topic for topic in topics.values() if topic.who == PLANT or topic.topic == PLANT_STATE]
    for topic in simulated:
        for first, end in _gaps(has[:, topic.place]):
            found[first:end, topic.place] = _went(said.gone.get(PLANT, []), first, end)
            found[first:end, topic.place] |= plant_is_whole and end == len(has)
            found[_broken_off(has, said), topic.place] = True
    return found


def went_with(topics: Mapping[str, Topic], columns: Columns, void: Void, steps: int) -> Flags:
    """(steps, topics): which messages went with the process that held them, by the recorder's account.

    Their numbers are void, and the sender's messages before and after them are there.
    """
    has = columns["has"][:steps]
    found = np.zeros_like(has)
    for topic in topics.values():
        numbers = np.array(sorted({number for some in void.get(topic.who or "", ()) for number in some}))
        column = columns["number"][:steps, topic.place].astype(np.int64)
        for first, end in _gaps(has[:, topic.place]) if len(numbers) else ():
            after, before = column[first - 1] if first else -1, column[end] if end < len(has) else np.inf
            count = int(((numbers > after) & (numbers < before)).sum())
            found[first : min(end, first + count), topic.place] = True
    return found


def untold(topics: Mapping[str, Topic], columns: Columns, void: Void, steps: int, *, memory: int) -> Flags:
    """(steps, n): about when a node may have given reasons that are not there: under one of the `void` numbers."""
    estimates = [topic for topic in topics.values() if topic.topic.endswith("/estimate")]
    found: Flags = np.zeros((steps, len(estimates)), dtype=bool)
    for i, topic in enumerate(estimates):
        there = np.flatnonzero(columns["has"][:steps, topic.place])
        numbers = columns["number"][there, topic.place]
        for lost in void.get(topic.who or "", ()):
            after, before = np.searchsorted(numbers, [lost.start, lost.stop])
            first = there[after - 1] - memory if after else 0
            found[max(0, first) : there[before] + 1 if before < len(there) else steps, i] = True
    return found


def perhaps_sent(columns: Columns, said: Said, lost: Flags, *, resumed: bool) -> Flags:
    """(steps, n): estimates that are not there, and that others may have had.

    They are `lost`, or of a node that was killed: what it sent last, no recorder may have got. By when it was gone the
    coordinator has said, unless it was gone itself, and has `resumed`, or the run ended.
    """
    steps, n = len(lost), len(said.nodes)
    has, origin = columns["has"][:steps], columns["origin"][:steps]
    found = np.asarray(lost[:, 2 + 2 * np.arange(n)])
    for who, i in said.nodes.items():
        place = 2 + 2 * i
        for first, end in _gaps(has[:, place]):
            comes_back = end < steps and origin[end, i] != -1
            gone = [step for step in said.gone.get(who, []) if first - _NEAR <= step < end + _NEAR]
            if gone:
                found[first : min(end, max(gone) + _NEAR + 1), i] = True
            elif end == steps or (comes_back and resumed):
                found[first:end, i] = True
    return np.asarray(found & ~has[:, 2 + 2 * np.arange(n)])


def _broken_off(has: Flags, said: Said) -> Flags:
    """(steps,): at which the plant's state is not there, nor some measurements, and their nodes say they never came.

    A node that is not there in such a step either says nothing.
    """
    unheard = np.zeros((len(has), len(said.nodes)), dtype=bool)
    for step, i in said.unheard:
        if step < len(has):
            unheard[step, i] = True
    estimates = 2 + 2 * np.arange(len(said.nodes))
    unheard &= ~has[:, estimates + 1]
    missed = ~has[:, estimates + 1] & ~has[:, estimates]
    explained = unheard | has[:, estimates + 1] | ~has[:, estimates]
    return np.asarray((unheard | missed).any(axis=1) & explained.all(axis=1) & ~has[:, 1])


def _went(steps: list[int], first: int, end: int) -> bool:
    return any(first - _NEAR <= step < end + _NEAR for step in steps)


def _gaps(there: Flags) -> list[tuple[int, int]]:
    """The first step of each stretch that is not there, and the step after its last."""
    edges = np.diff(np.concatenate([[True], there, [True]]).astype(np.int8))
    first: Numbers = np.flatnonzero(edges == -1)
    return list(zip(first.tolist(), np.flatnonzero(edges == 1).tolist(), strict=True))
