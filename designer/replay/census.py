"""Proof 4 of a replay: every message is there exactly once, and every sender's numbering is whole.

A message that is not there may be *missing*: the run lost it, or somebody took it out. Or it is *lacking*: it was
left out of this file, as tools do with good reason. A file cannot prove which, so the rule is: nothing is missing from
a file that is a part of a recording by the looks of it, and honest tools make parts by topic or node and by time, by
splitting and joining, cutting, or reading on after damage. In a file that has its `end`, says that the run finished,
and is not damaged, these make it a part:

* a topic of which nothing is there: filtered; or a quarter is not there: thinned;
* a stretch of a topic of at least a tenth of the run: a part was joined in without it;
* a stretch at about the same time in most topics: a part was left out;
* events that are not there, by the numbers of the coordinator, before or after all that is.

In a file that is otherwise whole a message between others of its topic is missing. So is one at the beginning or at the
end of its topic where no filter by time can have taken it alone: the run's own last event comes after everything else,
and its first one before every measurement and estimate. Where these events are not there it is lacking.

Of a file that is cut, damaged or of a run that did not finish, everything is lacking: that is held against it no more
than it shows anything. Either is named.

Numbers that a tool has rewritten say nothing, and are told apart from numbers with a fault by how many there are. In a
part too few may be left to tell, so faults of theirs are noted there, and held against nobody; and so is a number that
cannot be right where no checksum covers it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agent.contract.errors import counted
from agent.contract.keys import EVENT, MODE, PLANT_STATE
from designer.replay.numbering import read_numbering
from designer.replay.part import Part
from designer.replay.topics import NAMED, Columns, Numbers, Topic

PART = 10  # a stretch of a tenth of the run may be a part
THINNED = 4  # a topic that lacks a quarter of its messages was thinned
INNER = 3  # so many stretches and topics are named

Flags = NDArray[np.bool_]


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

    missing: Faults  # nothing explains that they are not there
    lacking: Faults  # left out of this file
    gaps: tuple[str, ...]  # what is lacking, in words
    duplicates: Faults  # messages of different content for one step
    copies: int  # messages that are there again, equal in content
    strange: tuple[str, ...]  # what should not be in the file at all
    numbering: tuple[str, ...]  # faults in the senders' own numbering
    notes: tuple[str, ...]  # what is odd, and is held against nobody


@dataclass(frozen=True)
class Facts:
    """What a census must know beside the messages of the topics."""

    steps: int  # that are to be there
    is_finished: bool  # the run came to its end, and the file is sound
    is_checked: bool  # a checksum covers every message
    has_start: bool  # the coordinator's first event is there
    has_end: bool  # and its last
    events: Numbers  # their numbers
    event_copies: int
    recorded: dict[str, int]  # messages of each sender by the word of the recorder; empty where it is not known
    unplanned: frozenset[str]  # topics that the run need not have
    void: Mapping[str, Sequence[range]] = field(default_factory=dict)  # of each sender, numbers that nobody looks for
    excused: Flags | None = None  # (steps, topics): what was lost, or nobody was there to send, in a paced run


class Holes(NamedTuple):
    """Stretches of steps that are not there: of the topic at `topic`, steps `first` to `last`.

    `after` and `before` are the log times of the messages around each, the extremes of int64 where there is none.
    """

    topic: Numbers
    first: Numbers
    last: Numbers
    after: Numbers
    before: Numbers

    @property
    def length(self) -> Numbers:
        return self.last - self.first + 1

    def where(self, chosen: Flags) -> Holes:
        return Holes(*(column[chosen] for column in self))


def take_census(
    topics: Iterable[Topic], columns: Columns, facts: Facts, *, strange: Sequence[str], part: Part
) -> Census:
    """Compare what is there with one message of every topic for each step; of the holes only those in `part` count."""
    topics = [topic for topic in topics if topic.topic not in facts.unplanned]
    strange = [*strange, *_beyond(topics, facts.steps)]
    holes = _holes(topics, columns, facts.steps, facts.excused)
    lacking_of = Counter({topic.topic: int(holes.length[holes.topic == at].sum()) for at, topic in enumerate(topics)})
    numbering = read_numbering(
        topics,
        columns,
        lacking_of,
        steps=facts.steps,
        events=facts.events,
        recorded=facts.recorded,
        void=facts.void,
    )
    lacks, is_part = _explained(holes, topics, facts)
    is_part |= numbering.is_part
    lacks = np.ones_like(lacks) if is_part else lacks & ~_contradicted(holes, topics, facts)
    is_part |= bool(lacks.any())
    unseen = () if is_part else numbering.unseen
    lacking, missing = _within(holes.where(lacks), topics, part), _within(holes.where(~lacks), topics, part)
    counts = not is_part and (facts.is_checked or numbering.is_exchanged)
    events = numbering.events if is_part or not facts.is_finished else 0
    copies = sum(topic.copies for topic in topics) + facts.event_copies
    words = "stands in it again with the same content, and counts" if copies == 1 else "stand in it again, and count"
    again = [f"{counted(copies, 'message')} {words} once"] if copies else []
    double = [Place(topic.topic, step) for topic in topics for step in topic.double if part.has(topic.topic, step)]
    found = _faults(lacking, topics)
    return Census(
        missing=_faults(missing, topics),
        lacking=Faults(found.total + events, found.first),
        gaps=tuple(_in_words(lacking, topics, facts, events)),
        duplicates=Faults(len(double), tuple(sorted(double, key=_by_step)[:NAMED])),
        copies=copies,
        strange=tuple(strange),
        numbering=(*(numbering.faults if counts else ()), *unseen),
        notes=(*numbering.notes, *(() if counts else numbering.faults), *again),
    )


def _by_step(place: Place) -> tuple[int, str]:
    return place.step, place.topic


def _beyond(topics: list[Topic], steps: int) -> Iterator[str]:
    for topic in topics:
        if topic.last >= steps:
            yield f"{topic.topic}, step {topic.last}: the run ended after {steps} steps"


def _holes(topics: list[Topic], columns: Columns, steps: int, excused: Flags | None) -> Holes:
    """Every stretch of the steps 0 ... `steps` - 1 that is not there, and not `excused`."""
    found = []
    for at, topic in enumerate(topics):
        there = np.zeros(steps, dtype=bool)
        has = columns["has"][:steps, topic.place]
        there[: len(has)] = has if excused is None else has | excused[:, topic.place]
        edges = np.diff(np.concatenate([[True], there, [True]]).astype(np.int8))
        first, end = np.flatnonzero(edges == -1), np.flatnonzero(edges == 1)
        time = columns["time"][:, topic.place]
        after, before = np.full(len(first), _EVER.min), np.full(len(first), _EVER.max)
        after[first > 0] = time[first[first > 0] - 1]
        before[end < steps] = time[end[end < steps]]
        found.append((np.full(len(first), at), first, end - 1, np.minimum(after, before), np.maximum(after, before)))
    return Holes(*(np.concatenate(column) for column in zip(*found, strict=True)))


_EVER = np.iinfo(np.int64)


def _within(holes: Holes, topics: list[Topic], part: Part) -> Holes:
    """What of the holes lies in a part of the run."""
    first, last = np.maximum(holes.first, part.first), np.minimum(holes.last, part.last)
    of_part = np.array([part.has(topic.topic) for topic in topics], dtype=bool)[holes.topic]
    return holes._replace(first=first, last=last).where((first <= last) & of_part)


def _explained(holes: Holes, topics: list[Topic], facts: Facts) -> tuple[Flags, bool]:
    """What is lacking by the rule above, and whether that is more than beginnings and ends of topics."""
    if not facts.is_finished:
        return np.ones(len(holes.topic), dtype=bool), True
    begins, ends = holes.first == 0, holes.last == facts.steps - 1
    parts = (begins & ends) | (holes.length >= max(2, facts.steps // PART))
    present = len(topics) - int((begins & ends).sum())
    lacking = np.bincount(holes.topic, weights=holes.length, minlength=len(topics))
    parts |= (lacking >= max(2.0, facts.steps / THINNED))[holes.topic]
    parts |= _common(holes, present)
    return parts | begins | ends, bool(parts.any())


def _common(holes: Holes, present: int) -> Flags:
    """Whether most of the topics that are there say nothing at some time within each hole."""
    inner = (holes.after > _EVER.min) | (holes.before < _EVER.max)
    times = np.concatenate([holes.after[inner], holes.before[inner]])
    change = np.repeat([1, -1], int(inner.sum()))
    order = np.lexsort((change, times))
    silent = np.cumsum(change[order])  # topics, from each of these times on
    most = np.concatenate([[0], np.cumsum((silent >= 2) & (2 * silent > present))])
    times = times[order]
    first, last = np.searchsorted(times, holes.after, "left"), np.searchsorted(times, holes.before, "left")
    return np.asarray(inner & (most[last] > most[first]))


def _contradicted(holes: Holes, topics: list[Topic], facts: Facts) -> Flags:
    """Beginnings and ends that no filter by time can have taken: what came before or after them is there."""
    names = np.array([topic.topic for topic in topics])[holes.topic]
    early = (holes.first == 0) & ~np.isin(names, (MODE, PLANT_STATE))  # these may be logged before the first event
    late = holes.last == facts.steps - 1
    return np.asarray((early & facts.has_start) | (late & facts.has_end))


def _faults(holes: Holes, topics: list[Topic]) -> Faults:
    """Of each hole the first steps are named."""
    order = np.argsort(holes.first, kind="stable")[:NAMED]
    places = [
        Place(topics[holes.topic[hole]].topic, step)
        for hole in order
        for step in range(int(holes.first[hole]), int(min(holes.last[hole], holes.first[hole] + NAMED)) + 1)
    ]
    return Faults(int(holes.length.sum()), tuple(sorted(places, key=_by_step)[:NAMED]))


def _in_words(holes: Holes, topics: list[Topic], facts: Facts, events: int) -> Iterator[str]:
    """What is lacking, for people."""
    begins, ends = holes.first == 0, holes.last == facts.steps - 1
    absent = [topics[at].topic for at in holes.topic[begins & ends]]
    if events and not len(facts.events):
        absent.append(EVENT)
    elif events:
        yield counted(events, "event")
    if absent:
        yield f"{'topic' if len(absent) == 1 else 'topics'} {_some(absent)}"
    for chosen, words in (
        (begins & ~ends, "the beginning of {} up to step {last}"),
        (ends & ~begins, "the end of {} from step {first} on"),
    ):
        some = holes.where(chosen)
        if len(some.topic):
            yield words.format(_topics(some, topics), first=some.first.min(), last=some.last.max())
    inner = holes.where(~begins & ~ends)
    groups = _overlapping(inner)
    for group in groups[:INNER]:
        some = inner.where(group)
        first, last = some.first.min(), some.last.max()
        yield f"{f'step {first}' if first == last else f'steps {first} to {last}'} of {_topics(some, topics)}"
    if len(groups) > INNER:
        yield f"{len(groups) - INNER} more stretches"


def _overlapping(holes: Holes) -> list[Flags]:
    """The holes in groups that have steps in common, or follow each other."""
    groups: list[Flags] = []
    order, end = np.argsort(holes.first, kind="stable"), -2
    for hole in order:
        if holes.first[hole] > end + 1:
            groups.append(np.zeros(len(order), dtype=bool))
        groups[-1][hole] = True
        end = max(end, int(holes.last[hole]))
    return groups


def _topics(holes: Holes, topics: list[Topic]) -> str:
    names = [topics[at].topic for at in np.unique(holes.topic)]
    return _some(names) if len(names) <= INNER else f"{len(names)} topics"


def _some(names: list[str]) -> str:
    return ", ".join(names) if len(names) <= 2 * INNER else f"{', '.join(names[:INNER])} and {len(names) - INNER} more"
