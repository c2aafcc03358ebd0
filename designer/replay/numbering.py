"""The senders' own numbering, as far as it is still in the file, and what it says of messages that are not there."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from agent.contract.keys import COORDINATOR
from designer.replay.topics import Columns, Numbers, Topic

SHARE = 20  # faults in more than one number of so many are no faults: a tool has rewritten the numbers
_SHOWN = 5


class Numbering(NamedTuple):
    """What the numbers say."""

    notes: tuple[str, ...] = ()  # that they are not the senders'
    faults: tuple[str, ...] = ()  # numbers that contradict each other
    unseen: tuple[str, ...] = ()  # numbers that nobody has, between those that are there
    events: int = 0  # messages that have no step of their own, and are not there
    is_part: bool = False  # these lack as they do where a part was taken


class _Sender(NamedTuple):
    """One sender's numbers."""

    who: str
    topics: list[tuple[str, Numbers]]  # in the order of the steps
    lacking: int  # steps of which there is nothing, over all topics
    recorded: int  # by the word of the recorder; 0 where that is not known

    @property
    def numbers(self) -> Numbers:
        return np.concatenate([numbers for _, numbers in self.topics])

    def is_rewritten(self, events: int) -> bool:
        """These cannot be the sender's own numbers, or hardly."""
        numbers = self.numbers
        if len(numbers) < 2:
            return False
        distinct, most = len(np.unique(numbers)), max(1, len(numbers) // SHARE)
        if self.wrong > most:
            return True
        if self.recorded:
            return int((numbers >= self.recorded).sum()) > most
        return int(numbers.max()) + 1 - distinct - self.lacking - events > max(most, len(numbers) // 2)

    @property
    def wrong(self) -> int:
        """How many numbers go against the order of the steps, or stand on more than one message."""
        falls = sum(int((np.diff(of_topic) <= 0).sum()) for _, of_topic in self.topics)
        return max(falls, len(self.numbers) - len(np.unique(self.numbers)))

    def faults(self) -> Iterator[str]:
        for topic, numbers in self.topics:
            falls = np.flatnonzero(np.diff(numbers) <= 0)
            if len(falls):
                before, after = numbers[falls[0]], numbers[falls[0] + 1]
                yield f"{topic} has number {after} after {before}, against the order of its steps"
        distinct, counts = np.unique(self.numbers, return_counts=True)
        if (counts > 1).any():
            yield f"{self.who} has number {distinct[counts > 1][0]} on more than one message"

    def unseen(self, events: Counter[int]) -> tuple[int, list[int], bool]:
        """How many messages neither topics nor events explain, the numbers nobody has, and whether all are outermost.

        The events that fill a gap are used up.
        """
        there = np.unique(self.numbers)
        total = self.recorded or int(there.max(initial=-1)) + 1
        there = there[there < total]
        is_there = np.zeros(total, dtype=bool)
        is_there[there] = True
        gaps = np.flatnonzero(~is_there)
        filled = [number for number in gaps.tolist() if events[number] > 0]
        events.subtract(filled)
        gaps = np.setdiff1d(gaps, filled)
        known = np.union1d(there, filled)
        outermost = bool(len(known)) and bool(((gaps < known[0]) | (gaps > known[-1])).all())
        return max(0, len(gaps) - self.lacking), gaps[:_SHOWN].tolist(), outermost


def read_numbering(
    topics: list[Topic],
    columns: Columns,
    lacking: Counter[str],
    *,
    steps: int,
    events: Numbers,
    recorded: dict[str, int],
) -> Numbering:
    """`lacking` counts the steps below `steps` that each topic lacks, `events` are the numbers of the events."""
    senders = _senders(topics, columns, lacking, steps, recorded)
    everything = np.concatenate([sender.numbers for sender in senders] or [np.zeros(0, dtype=np.int64)])
    if len(everything) > 1 and not everything.any():
        note = "the senders' numbering is not in the file: every number is 0"
    elif sum(sender.wrong for sender in senders) > len(everything) // SHARE or any(
        sender.is_rewritten(len(events) if sender.who == COORDINATOR else 0) for sender in senders
    ):
        note = "the senders' numbering is not in the file: a tool has rewritten it"
    else:
        return _own(senders, events, _absent(senders, steps, events))
    absent = _absent(senders, steps, events) or 0
    return Numbering(notes=(note,), events=absent, is_part=absent > 0)


def _absent(senders: list[_Sender], steps: int, events: Numbers) -> int | None:
    """How many events are not there, by the recorder's word: what was recorded beside the steps. None: not known."""
    if not all(sender.recorded for sender in senders):
        return None
    beside = sum(sender.recorded - steps * len(sender.topics) for sender in senders)
    return max(0, beside - len(events))


def _senders(
    topics: list[Topic], columns: Columns, lacking: Counter[str], steps: int, recorded: dict[str, int]
) -> list[_Sender]:
    found: defaultdict[str, list[Topic]] = defaultdict(list)
    for topic in topics:
        if topic.who is not None:
            found[topic.who].append(topic)
    has, number = columns["has"][:steps], columns["number"]
    return [
        _Sender(
            who,
            [
                (topic.topic, number[np.flatnonzero(has[:, topic.place]), topic.place].astype(np.int64))
                for topic in of_sender
            ],
            sum(lacking[topic.topic] for topic in of_sender),
            recorded.get(who, 0),
        )
        for who, of_sender in sorted(found.items())
    ]


def _own(senders: list[_Sender], events: Numbers, absent: int | None) -> Numbering:
    waiting = Counter(events.tolist())
    unseen, total, is_part = [], 0, False
    for sender in senders:
        count, numbers, outermost = sender.unseen(waiting)
        count = count if absent is None else min(count, absent - total)
        total += count
        if count and (outermost or not len(events)):
            is_part = True
        elif count:
            first = ", ".join(map(str, numbers)) + (", ..." if count > _SHOWN else "")
            unseen.append(f"{count} more messages of {sender.who} are missing, by its numbers {first}")
    return Numbering(
        faults=tuple(fault for sender in senders for fault in sender.faults()),
        unseen=tuple(unseen),
        events=total,
        is_part=is_part,
    )
