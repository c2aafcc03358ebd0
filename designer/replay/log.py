"""A recording as arrays: one row for each step, NaN or -1 where a message is missing.

Messages are matched by (topic, step), never by their place in the file.
"""

from __future__ import annotations

import math
from array import array
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from agent.contract.arrays import Array
from agent.contract.errors import InputError, counted
from agent.contract.gains import Gains
from agent.contract.keys import ACCOUNT, COORDINATOR, EVENT, EVIDENCE, PLANT, PLANT_STATE, measurement
from agent.contract.messages import Account, Event
from agent.contract.recording import Logged
from agent.contract.recording.evidence.examiner import Examiner, Findings
from agent.contract.recording.ranges import ranges_of
from agent.contract.recording.reader import Progress, RecordingReader
from designer.replay.absences import Absences, Void
from designer.replay.census import Census, Facts, take_census
from designer.replay.central import Flags
from designer.replay.growing import largest_followed
from designer.replay.part import Part
from designer.replay.said import Said
from designer.replay.topics import Columns, Numbers, Senders, Sentences, Topic, Words, topics_of

_MEMORY = 2.0  # seconds, and two steps, after which a node has said why it substituted something
_NAMED = 3  # so many damages and topics are named
_LARGEST = 1 << 33  # bytes of the arrays that hardly any message fills


@dataclass(frozen=True, eq=False)
class Log:
    """What a recording says. Vectors of the nodes stand side by side, nodes in file order."""

    path: Path
    label: str  # what to call it: its path, or those of its parts
    run: dict[str, str]  # the metadata of its beginning
    end: dict[str, str] | None  # and of its end; None where the file was cut
    damage: str  # what is wrong with the file, "" where nothing is
    is_doubtful: bool  # its checksum fails, so that any number in it may be a wrong one
    notes: tuple[str, ...]  # what is odd about the file, and harms nothing
    finished: bool  # the run came to its planned end, and the file is sound
    gains: Gains
    seed: int
    planned: int  # steps that the run was to have
    steps: int  # rows of the arrays
    messages: int
    census: Census
    evidence: Findings  # whether the messages are those that were sent
    external: tuple[bool, ...]  # per node: a real sensor gives its measurements
    modes: Words  # what the numbers in `mode` and `used` mean; those of the problem come first
    senders: Senders  # what the numbers in `heard` mean
    mode: Numbers  # (steps,)
    x: Array  # (steps, nx)
    z: Array  # (steps, nz)
    w: Array  # (steps, nw)
    theta: Array  # (steps, n)
    y: Array  # (steps, sum ny); NaN also where nothing arrived
    measured: Array  # (steps, n): 1 where y has numbers, 0 where it is empty, NaN where the message is missing
    innovation: Array  # (steps, sum ny)
    x_hat: Array  # (steps, n nx)
    z_hat: Array  # (steps, n nz)
    used: Numbers  # (steps, n): Estimate.mode
    heard: Numbers  # (steps, n): Estimate.heard
    told: Numbers  # (steps, n): Estimate.measured
    origin: Numbers  # (steps, n): Estimate.origin, by `Senders.origin`; -1 where a node goes on
    absences: Absences  # why messages are not there, in a paced run
    said: Said  # what its events say of messages that were not there in time
    period: float  # seconds, of a paced run; 0 in lock-step
    grown: int | None  # the last step that is compared, because later ones may have numbers beyond the ceiling

    @property
    def is_paced(self) -> bool:
        return self.period > 0.0

    @property
    def is_simulated(self) -> bool:
        """A simulated plant was recorded."""
        return bool(np.isfinite(self.x).any())

    @property
    def has_plant(self) -> bool:
        """A simulated plant gave every measurement and was recorded, so that errors can be computed."""
        return not any(self.external) and self.is_simulated

    @property
    def is_whole(self) -> bool:
        """The run is finished, and every message of it is there."""
        return self.finished and not (
            self.census.missing.total or self.census.lacking.total or self.absences.lost.any()
        )

    @property
    def is_part(self) -> bool:
        """Something was left out of the file of a paced run, or it does not come to the end."""
        return self.is_paced and (not self.finished or self.census.lacking.total > 0)

    def error_norms(self) -> Array:
        """|z_tilde(k)| over all nodes, as logged, (steps,); NaN where a message is missing."""
        weights, nz = self.gains.problem.weights, self.gains.problem.nz
        squares = ((weight * (self.z - self.z_hat[:, i * nz : (i + 1) * nz])) ** 2 for i, weight in enumerate(weights))
        return np.asarray(np.sqrt(sum(of_node.sum(axis=1) for of_node in squares)))


def load(
    path: Path | Sequence[Path],
    *,
    run: str | None = None,
    gains: Path | None = None,
    part: Part | None = None,
    report: Progress | None = None,
) -> Log:
    """Read a recording, whole or cut, or the files that hold parts of one. Raises InputError for what is none.

    `run` chooses among several runs, `gains` is the gains file where the recording lost its own, `part` is what alone
    will be judged, `report` is told the bytes read so far, and of how many.
    """
    paths = [path] if isinstance(path, Path) else list(path)
    with RecordingReader(*paths, run=run, gains=gains) as reader:
        seed, planned = _integer(reader.run, "seed", path=paths[0]), _integer(reader.run, "steps", path=paths[0])
        external, period = _external(reader), _period(reader)
        if part is not None and part.node is not None:
            reader.gains.problem.node_index(part.node)  # refuses a name that does not exist
        content = _Content(reader.gains, external, planned, period)
        content.read(reader.messages(report))
        return _log(reader, content, external, part or Part(), seed=seed, planned=planned)


def _log(
    reader: RecordingReader, content: _Content, external: tuple[bool, ...], part: Part, *, seed: int, planned: int
) -> Log:
    """The arrays, and what is wrong with what is in them."""
    end, damages = reader.end or {}, reader.damages
    problem, topics, columns = reader.gains.problem, content.topics, content.columns
    unreadable = content.unreadable()
    grown = content.grown()
    strange = [*content.faults(), *content.beyond(grown), *reader.faults]
    if unreadable.total and (damages or reader.is_unchecked):
        first = unreadable.first[0]
        damages.append(f"{counted(unreadable.total, 'message')} cannot be read, the first of them on {first}")
    else:
        strange += unreadable.all()
    finished = end.get("status") == "finished" and not damages
    last = content.last()
    expected = _steps(end, planned, content.void(end), path=reader.path) if finished else last + 1
    if damages and end.get("status") == "finished" and end.get("steps") == str(planned):
        expected = max(last + 1, planned)
    if finished and expected != planned:
        strange.append(f"the end, it says that the run finished after {expected} of {planned} steps")
    steps = min(last + 1, expected)
    _refuse_hollow(columns, steps, content.messages, path=reader.path)
    evidence = content.examiner.finish(end)
    absences = content.absences(end, expected, finished=finished)
    census = take_census(
        topics.values(),
        columns,
        content.facts(
            end,
            steps=expected,
            finished=finished,
            checked=not reader.is_unchecked,
            external=external,
            excused=absences.excused | absences.lost,
        ),
        strange=strange,
        part=part,
    )
    if census.duplicates.total and not reader.is_alone:
        raise InputError(f"{reader.label} holds runs that went on at the same time; their messages cannot be parted")
    columns.release("number", "time")
    return Log(
        path=reader.path,
        label=reader.label,
        run=reader.run,
        end=reader.end,
        damage=_joined(damages),
        is_doubtful=reader.is_doubtful,
        notes=(
            *reader.notes,
            *_strangers(reader, content.others),
            *census.notes,
            *evidence.unchecked,
            *content.refusals(),
        ),
        finished=finished,
        gains=reader.gains,
        seed=seed,
        planned=planned,
        steps=steps,
        messages=content.messages - census.copies,
        census=census,
        evidence=part.of(evidence),
        external=external,
        modes=content.modes,
        senders=content.senders,
        said=content.said,
        absences=absences,
        period=content.period,
        grown=grown,
        **_arrays(columns, topics, problem.node_names, steps),
    )


def _arrays(columns: Columns, topics: dict[str, Topic], names: tuple[str, ...], steps: int) -> dict[str, Any]:
    """The arrays of a Log: the columns as far as the run goes, with NaN or -1 for what is not there."""
    columns.reach(steps)
    has = columns["has"][:steps]
    measured = np.empty((steps, len(names)))
    for i, name in enumerate(names):
        topic = topics[measurement(name)]
        there, first = has[:, topic.place], columns["y"][:steps, topic.places["y"].start]
        measured[:, i] = np.where(there, np.isfinite(first), np.nan)
    for topic in topics.values():
        absent = ~has[:, topic.place]
        if absent.any():
            for name, at in topic.places.items():
                columns[name][:steps][absent, at] = np.nan
            for name, column in topic.words.items():
                columns[name][:steps][absent, column] = -1
    fields = {name: columns[name][:steps] for name in ("x", "z", "w", "y", "innovation", "x_hat", "z_hat")}
    words = {name: columns[name][:steps] for name in ("used", "heard")}
    goes_on = np.broadcast_to(-1, words["used"].shape)
    told, origin = -goes_on, goes_on
    if any("told" in topic.words for topic in topics.values()):
        told, origin = columns["told"][:steps], columns["origin"][:steps]
    return {
        **fields,
        "told": told,
        "origin": origin,
        **words,
        "mode": columns["mode"][:steps, 0],
        "theta": columns["arrived"][:steps],
        "measured": measured,
    }


class _Content:
    """What is gathered while the messages stream by."""

    def __init__(self, gains: Gains, external: tuple[bool, ...], planned: int, period: float) -> None:
        self.modes, self.senders = Words(gains.problem.mode_names), Senders(gains.problem.node_names)
        self.period, self.is_paced, self._external = period, period > 0.0, external
        self.topics, self.columns = topics_of(gains.problem, external, planned=planned, paced=self.is_paced)
        memory = 2 + math.ceil(_MEMORY / period) if period else 0
        self.said = Said(gains.problem.node_names, memory=memory)
        self._followed = largest_followed(gains)
        self.messages = 0
        names = gains.problem.node_names
        self.examiner = Examiner(external=[name for name, real in zip(names, external, strict=True) if real])
        self._planned = planned
        self._unreadable = Sentences()
        self.others: Counter[str] = Counter()  # topics that this problem does not have
        self._events, self._keys = array("q"), array("q")  # numbers of events, and what tells one from another
        self._beside: defaultdict[str, list[int]] = defaultdict(list)  # the same numbers, of each node
        self._kinds: set[str] = set()  # of the coordinator's events

    def read(self, messages: Iterable[Logged]) -> None:
        topics, columns, planned, modes, senders = self.topics, self.columns, self._planned, self.modes, self.senders
        for logged in messages:
            topic = topics.get(logged.topic)
            if topic is not None:
                self.messages += 1
                step = topic.add(logged, columns, planned=planned, modes=modes, senders=senders)
                self.examiner.take(logged, step)
            elif logged.topic == EVENT:
                self.messages += 1
                self.examiner.take(logged, *self._event(logged))
            elif logged.topic == ACCOUNT and self.is_paced:
                self.messages += 1
                self.examiner.take(logged, *self._account(logged))
            elif logged.topic == EVIDENCE:
                self.examiner.take(logged, -1)
            else:
                self.others[logged.topic] += 1
        for topic in topics.values():
            topic.settle(columns)

    def _event(self, logged: Logged) -> tuple[int, str]:
        """The step of an event, -1 where it is none, and who sent it."""
        try:
            event = Event.decode(logged.payload)
        except ValidationError as error:
            words = error.errors(include_url=False)[0]["msg"].lower()
            self._unreadable.add(f"{EVENT}, number {logged.number}: {words}")
            return -1, ""
        if event.who == COORDINATOR:
            self._kinds.add(event.kind)
        self.said.add(event)
        who = event.who if self.said.is_node(event.who) else COORDINATOR
        self._count(logged, who)
        return event.step, who

    def _account(self, logged: Logged) -> tuple[int, str]:
        try:
            account = Account.decode(logged.payload)
        except ValidationError as error:
            words = error.errors(include_url=False)[0]["msg"].lower()
            self._unreadable.add(f"{ACCOUNT}, number {logged.number}: {words}")
            return -1, ""
        self.said.account(account)
        self._count(logged, account.who)
        return account.step, account.who

    def _count(self, logged: Logged, who: str) -> None:
        """A message that has a number and no row of its own."""
        self._events.append(logged.number)
        self._beside[who].append(logged.number)
        self._keys.append(hash((logged.publish_time, logged.payload)))

    def refusals(self) -> list[str]:
        """What did not fit while the run went on, in the words of its coordinator."""
        return [event.detail for event in self.said.refusals.values()]

    def last(self) -> int:
        """The last step of which there is anything, -1 where there is nothing."""
        return max(topic.last for topic in self.topics.values())

    def grown(self) -> int | None:
        """The first step whose states or estimates have grown so far that later ones may be beyond the ceiling."""
        large = np.zeros(len(self.columns["has"]), dtype=bool)
        for topic in self.topics.values():
            for name, place in topic.places.items():
                if name in ("x", "w", "x_hat"):
                    has = self.columns["has"][:, topic.place]
                    large[has] |= (np.abs(self.columns[name][has, place]) > self._followed).any(axis=1)
        return int(np.argmax(large)) if large.any() else None

    def beyond(self, grown: int | None) -> list[str]:
        """Numbers beyond the ceiling that no growth up to the step before explains; their messages are none."""
        found = []
        for topic in self.topics.values():
            for step, what in topic.beyond:
                if grown is None or step <= grown:
                    self.columns["has"][step, topic.place] = False
                    found.append((step, what))
        return [what for _, what in sorted(found)]

    def faults(self) -> list[str]:
        """Messages that can be read, and cannot be of this run."""
        return [fault for topic in self.topics.values() for fault in topic.faults.all()]

    def unreadable(self) -> Sentences:
        """Messages that are none."""
        found = Sentences()
        for some in (self._unreadable, *(topic.unreadable for topic in self.topics.values())):
            found.total += some.total
            found.first += some.first
        return found

    def facts(
        self,
        end: dict[str, str],
        *,
        steps: int,
        finished: bool,
        checked: bool,
        external: tuple[bool, ...],
        excused: Flags,
    ) -> Facts:
        """What the census must know beside the messages."""
        _, first = np.unique(np.array(self._keys, dtype=np.int64), return_index=True)
        recorded = {
            key.removeprefix("received."): int(count)
            for key, count in end.items()
            if key.startswith("received.") and count.isdigit()
        }
        without_plant = all(external) and self.topics[PLANT_STATE].last < 0 and not recorded.get(PLANT)
        return Facts(
            steps=steps,
            is_finished=finished,
            is_checked=checked,
            has_start="start" in self._kinds,
            has_end="end" in self._kinds,
            events=np.array(self._events, dtype=np.int64)[first],
            event_copies=len(self._events) - len(first),
            recorded=recorded,
            void=self.void(end),
            unplanned=frozenset({PLANT_STATE} if without_plant else ()),
            excused=excused,
        )

    def void(self, end: dict[str, str]) -> dict[str, list[range]]:
        """Of each sender, numbers that nobody looks for: they went with whoever held them; none in lock-step."""
        found = {key.removeprefix("void."): ranges_of(text) for key, text in end.items() if key.startswith("void.")}
        return found if self.is_paced else {}

    def absences(self, end: dict[str, str], steps: int, *, finished: bool) -> Absences:
        """Why messages are not there."""
        steps = len(self.columns["has"][:steps])
        if not self.is_paced:
            return Absences.none(steps, len(self.topics), len(self._external))
        void = self.void(end)
        accounted = self.examiner.whole.get(PLANT, 0) + sum(map(len, void.get(PLANT, ())))
        return Absences.of(
            self.topics,
            self.columns,
            self.said,
            void,
            {} if finished else self._gaps(),
            external=self._external,
            steps=steps,
            plant_is_whole=str(accounted) == end.get(f"received.{PLANT}", "0"),
            resumed="resumed" in self._kinds,
        )

    def _gaps(self) -> dict[str, list[range]]:
        """Of each node, the numbers before its last that are not there; what a cut file lacks, nothing else tells."""
        found = {}
        for who, i in self.said.nodes.items():
            place = 2 + 2 * i
            numbers = self.columns["number"][self.columns["has"][:, place], place].tolist()
            there = sorted({-1, *numbers, *self._beside[who]})
            found[who] = [range(a + 1, b) for a, b in pairwise(there) if b - a > 1]
        return found


def _strangers(reader: RecordingReader, others: Counter[str]) -> list[str]:
    """Lines for what is in the file and not of the run."""
    lines = []
    topics = reader.foreign + others
    if topics:
        names = _some(sorted(topics))
        of = counted(len(topics), "topic")
        be = "is" if topics.total() == 1 else "are"
        lines.append(f"{counted(topics.total(), 'message')} on {of} {be} not of this run, and {be} left alone: {names}")
    if reader.others:
        lines.append(f"{counted(reader.others, 'message')} of other runs are left alone")
    if reader.strangers:
        lines.append(f"metadata and attachments of others are left alone: {_some(reader.strangers)}")
    return lines


def _some(names: list[str]) -> str:
    """The first of them, and whether there are more."""
    return ", ".join([*names[: 2 * _NAMED], *(["..."] if len(names) > 2 * _NAMED else [])])


def _refuse_hollow(columns: Columns, steps: int, messages: int, *, path: Path) -> None:
    """InputError where the arrays would take all memory for hardly any message."""
    size = steps * columns.width
    if size > _LARGEST and steps > 100 * messages:
        raise InputError(f"{path} has step {steps - 1} among only {counted(messages, 'message')}: too far to compare")


def _joined(sentences: list[str]) -> str:
    """As one text; of many the first, and how many more."""
    more = len(sentences) - _NAMED
    return "; ".join([*sentences[:_NAMED], *([f"{more} more damages"] if more > 0 else [])])


def _period(reader: RecordingReader) -> float:
    """Of a paced run, in seconds; 0 in lock-step."""
    text = reader.run.get("period", "0")
    try:
        period = float(text)
    except ValueError:
        period = -1.0
    if not 0.0 <= period < 1e9:
        raise InputError(f'{reader.path}: its metadata gives "{text}" for period; it must be a number of seconds')
    return period


def _external(reader: RecordingReader) -> tuple[bool, ...]:
    problem = reader.gains.problem
    names = [name for name in reader.run.get("external", "").split(",") if name]
    for name in names:
        problem.node_index(name)  # refuses a name that does not exist
    return tuple(name in names for name in problem.node_names)


def _steps(end: dict[str, str], planned: int, void: Void, *, path: Path) -> int:
    """Of a run that finished; the recorder says up to which nothing lacks, of what has gone with a process either."""
    complete = _integer(end, "steps", path=path)
    return planned if void else complete


def _integer(metadata: dict[str, str], key: str, *, path: Path) -> int:
    text = metadata.get(key, "")
    if not (text.isascii() and text.isdigit() and len(text) < 20):
        raise InputError(f'{path}: its metadata gives "{text}" for {key}; it must be a number 0, 1, 2, ...')
    return int(text)
