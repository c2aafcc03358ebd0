"""The senders' own numbering, as far as it is still in the file, and what it says of messages that are not there.

Numbers may be *void*: where a recorder was gone, and then whoever kept what it had not got, or could not keep all. A
coordinator that comes back gives out again, under new numbers, the modes that went so; the recorder says which numbers
stand for nothing.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agent.contract.errors import counted
from designer.replay.topics import Columns, Numbers, Topic

Stored = NDArray[np.uint32]

SHARE = 20  # faults in more than one number of so many are no faults: a tool has rewritten the numbers
_SHOWN = 5


class Numbering(NamedTuple):
    """What the numbers say."""

    notes: tuple[str, ...] = ()  # that they are not the senders', or stand for nothing
    faults: tuple[str, ...] = ()  # numbers that contradict each other
    is_exchanged: bool = True  # every number is there once: messages were exchanged, no number is a wrong one
    unseen: tuple[str, ...] = ()  # numbers that nobody has, between those that are there
    events: int = 0  # messages that have no step of their own, and are not there
    is_part: bool = False  # these lack as they do where a part was taken


class _Sender:
    """One sender's numbers."""

    def __init__(
        self, who: str, topics: list[tuple[str, Stored]], *, lacking: int, recorded: int, void: Sequence[range]
    ) -> None:
        """`topics` have their numbers in the order of the steps, of which `lacking` over all topics are not there;
        `recorded` messages were by the word of the recorder, 0 where that is not known."""
        self.who, self.topics, self.recorded = who, [topic for topic, _ in topics], recorded
        self._lacking, self._void = lacking, void
        lost = min((numbers.start for numbers in void), default=np.inf)  # what was given again comes before this
        falls = [
            (topic, numbers, np.flatnonzero((numbers[1:] <= numbers[:-1]) & (numbers[1:] < lost)))
            for topic, numbers in topics
        ]
        self._falls = [
            f"{topic} has number {numbers[at[0] + 1]} after {numbers[at[0]]}, against the order of its steps"
            for topic, numbers, at in falls
            if len(at)
        ]
        every = np.sort(np.concatenate([numbers for _, numbers in topics]))
        self._again = every[1:][every[1:] == every[:-1]]
        self.total = len(every)
        self.wrong = max(sum(len(at) for _, _, at in falls), len(self._again))  # faults in them
        self.numbers = every[np.concatenate([[True], every[1:] != every[:-1]])[: len(every)]]  # distinct, ascending

    def is_rewritten(self, events: int) -> bool:
        """These cannot be the sender's own numbers, or hardly."""
        if self.total < 2:
            return False
        most, last = max(1, self.total // SHARE), int(self.numbers[-1])
        if self.wrong > most:
            return True
        if self.recorded:
            return int((self.numbers >= self.recorded).sum()) > most
        return last + 1 - len(self.numbers) - self._lacking - events - self.void > max(most, self.total // 2)

    @property
    def void(self) -> int:
        """How many numbers stand for nothing."""
        return sum(len(numbers) for numbers in self._void)

    @property
    def repeats(self) -> bool:
        """A number stands on more than one message."""
        return len(self._again) > 0

    def faults(self) -> list[str]:
        again = [f"{self.who} has number {self._again[0]} on more than one message"] if self.repeats else []
        return [*self._falls, *again]

    def unseen(self, events: Counter[int]) -> tuple[int, list[int], bool]:
        """How many messages neither topics nor events explain, the numbers nobody has, and whether all are outermost.

        The events that fill a gap are used up.
        """
        total = self.recorded or (int(self.numbers[-1]) + 1 if self.total else 0)
        there = self.numbers[self.numbers < total]
        is_there = np.zeros(total, dtype=bool)
        is_there[there] = True
        for numbers in self._void:
            is_there[numbers.start : numbers.stop] = True
        gaps = np.flatnonzero(~is_there)
        filled = [number for number in gaps.tolist() if events[number] > 0]
        events.subtract(filled)
        gaps = np.setdiff1d(gaps, filled)
        ends = [*filled, *there[:1].tolist(), *there[-1:].tolist()]
        outermost = bool(ends) and bool(((gaps < min(ends)) | (gaps > max(ends))).all())
        return max(0, len(gaps) - self._lacking), gaps[:_SHOWN].tolist(), outermost


def read_numbering(
    topics: list[Topic],
    columns: Columns,
    lacking: Counter[str],
    *,
    steps: int,
    events: Numbers,
    recorded: dict[str, int],
    void: Mapping[str, Sequence[range]],
) -> Numbering:
    """`lacking` counts the steps below `steps` that each topic lacks, `events` are the numbers of the events."""
    senders = _senders(topics, columns, lacking, steps, recorded, void)
    total = sum(sender.total for sender in senders)
    if total > 1 and not any(sender.numbers.any() for sender in senders):
        note = "the senders' numbering is not in the file: every number is 0"
    elif sum(sender.wrong for sender in senders) > total // SHARE or any(
        sender.is_rewritten(len(events)) for sender in senders
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
    beside = sum(sender.recorded - sender.void - steps * len(sender.topics) for sender in senders)
    return max(0, beside - len(events))


def _senders(
    topics: list[Topic],
    columns: Columns,
    lacking: Counter[str],
    steps: int,
    recorded: dict[str, int],
    void: Mapping[str, Sequence[range]],
) -> list[_Sender]:
    found: defaultdict[str, list[Topic]] = defaultdict(list)
    for topic in topics:
        if topic.who is not None:
            found[topic.who].append(topic)
    has, number = columns["has"][:steps], columns["number"]
    return [
        _Sender(
            who,
            [(topic.topic, number[:steps, topic.place][has[:, topic.place]]) for topic in of_sender],
            lacking=sum(lacking[topic.topic] for topic in of_sender),
            recorded=recorded.get(who, 0),
            void=void.get(who, ()),
        )
        for who, of_sender in sorted(found.items())
    ]


def _own(senders: list[_Sender], events: Numbers, absent: int | None) -> Numbering:
    waiting = Counter(events.tolist())
    unseen, total, is_part, is_exchanged = [], 0, False, True
    for sender in senders:
        count, numbers, outermost = sender.unseen(waiting)
        is_exchanged &= not sender.wrong or (not count and sender.wrong > 0 and not sender.repeats)
        count = count if absent is None else min(count, absent - total)
        total += count
        if count and (outermost or not len(events)):
            is_part = True
        elif count:
            first = ", ".join(map(str, numbers)) + (", ..." if count > _SHOWN else "")
            unseen.append(f"{count} more messages of {sender.who} are missing, by its numbers {first}")
    return Numbering(
        notes=tuple(
            f"{counted(sender.void, 'number')} of {sender.who} went with a process that was gone, were not kept, "
            "or are of copies"
            for sender in senders
            if sender.void
        ),
        faults=tuple(fault for sender in senders for fault in sender.faults()),
        is_exchanged=is_exchanged,
        unseen=tuple(unseen),
        events=total,
        is_part=is_part,
    )
