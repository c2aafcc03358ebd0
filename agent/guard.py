"""What may come in: every message is examined here before anything is made of it. Pure.

Whoever is on the network can send anything under any key. A message that does not fit is refused: dropped, and counted
by topic and by kind of fault. What a message says of its sender must fit the one who sends there, by name and by
session. That stops whoever does not know how a run goes, or what broke; who takes care to copy a session is kept out by
nothing that stands in a message. Only keys do that, and a replay finds what was forged.
"""

from __future__ import annotations

import threading
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping
from typing import NamedTuple, NoReturn

from pydantic import ValidationError

from agent.contract.keys import (
    ACCOUNT,
    ACKNOWLEDGED,
    BESIDE,
    CONTROL,
    COORDINATOR,
    EVENT,
    PLANT,
    measurement,
    model_of,
    node_who,
    participants,
    sender_of,
    sensor_who,
)
from agent.contract.messages import (
    ZERO_STATE,
    Account,
    Estimate,
    Event,
    Measurement,
    Message,
    Mode,
    PlantState,
    Stamp,
    Word,
    beyond_ceiling,
    tag_of,
)
from agent.contract.problem import Problem
from agent.contract.sizes import longest, vectors
from agent.plan import LARGEST_WINDOW

FORGED = "forged"  # not from who sends there, by name or session
UNREADABLE = "unreadable"  # no message of this topic at all, or with a stamp that is none
OVERSIZED = "oversized"  # longer than any message of this topic
MISSHAPEN = "misshapen"  # so many numbers, or such names, as the problem does not have
INFINITE = "infinite"  # with numbers that are not finite, or beyond the ceiling
UNTIMELY = "untimely"  # of a step that the run does not have, or of one far ahead
MISNUMBERED = "misnumbered"  # with a number that no run comes to, or a time before or after all
REPEATED = "repeated"  # there already
FLOOD = "flood"  # more than are kept for who computes
UNASKED = "unasked"  # answers to questions that nobody put, words that nobody waits for
KINDS = (FORGED, UNREADABLE, OVERSIZED, MISSHAPEN, INFINITE, UNTIMELY, MISNUMBERED, REPEATED, FLOOD, UNASKED)

AHEAD = 2 * LARGEST_WINDOW  # steps: modes run a window ahead of the slowest, and what answers to them, too
WINDOW = 1024  # numbers: older ones than that are taken for repeated
_OTHER_TOPICS = "other"
READY, REFUSALS, REPLAY = "ready", "refusals", "replay"  # of everybody together

Counts = dict[str, dict[str, int]]  # by topic and kind


class _Form(NamedTuple):
    """What the messages of a topic look like."""

    senders: frozenset[str]  # empty: anybody
    sizes: tuple[tuple[str, int], ...]  # of the vectors
    may_be_empty: bool
    longest: int  # bytes


class Unfit(Exception):
    """Raised by what examines a message: `kind` is one of KINDS."""

    def __init__(self, kind: str) -> None:
        super().__init__(kind)
        self.kind = kind


class Guard:
    """Of one participant. `know` and `begin` tell it what to expect; before, it knows no more than what topics mean.

    One thread may examine while another refuses and a third tells of sessions.
    """

    def __init__(self) -> None:
        self.now = 0  # the step that its owner has come to; what is far ahead of it is refused
        self._problem: Problem | None = None
        self._forms: dict[str, _Form] = {}
        self._cast: frozenset[str] = frozenset()
        self._nodes: frozenset[str] = frozenset()
        self._modes: dict[str, int] = {}  # their places
        self._steps, self._is_paced = 2**63, False
        self._sensed: frozenset[str] = frozenset()  # topics of sensors: nobody keeps those from measuring ahead
        self._sessions: defaultdict[str, list[str]] = defaultdict(list)  # that are there, in the order of their coming
        self._trusted: dict[str, frozenset[str]] = {}  # those that were the first of their name
        self._tags: dict[str, frozenset[bytes]] = {}
        self._seen: dict[tuple[str, str, bytes], _Numbers] = {}
        self._last_words: dict[tuple[str, str], int] = {}  # by session and topic, the number of the last
        self._unheld: dict[str, int] = {}  # by topic, the first step for whose measurement there was no room
        self._lock = threading.Lock()
        self._counts: defaultdict[str, Counter[str]] = defaultdict(Counter)

    # What to expect.
    def know(self, problem: Problem) -> None:
        """Messages are those of a run of this problem."""
        names = problem.node_names
        self._problem = problem
        self._cast = frozenset([*participants(problem), *map(sensor_who, names)])
        self._nodes = frozenset(names)
        self._modes = {name: place for place, name in enumerate(problem.mode_names)}
        self._forms = _forms(problem)

    def begin(self, *, steps: int, external: tuple[str, ...], paced: bool) -> None:
        """The run begins; `external` are the nodes that a sensor measures, which need not stamp what it sends."""
        self._steps, self._is_paced = steps, paced
        self._sensed = frozenset(map(measurement, external))
        for node in self._problem.node_names if self._problem is not None else ():
            topic = measurement(node)
            sender = frozenset({sensor_who(node), ""} if node in external else {PLANT})
            self._forms[topic] = self._forms[topic]._replace(senders=sender)

    def takes_part(self, who: str) -> bool:
        """Whether there is anybody of this name in a run of the problem."""
        return self._problem is None or who in self._cast

    # Who is there.
    def came(self, who: str, session: str) -> bool:
        """A session of `who` has shown its token; whether `who` was not there before.

        Of several of one name the first one counts, as long as it is there: a stranger that takes a name which is
        taken is not believed.
        """
        with self._lock:
            there = self._sessions[who]
            is_first = not there
            if session not in there:
                there.append(session)
            self._trust(who)
        return is_first

    def went(self, who: str, session: str) -> bool | None:
        """Its token is gone, though what it has sent before still counts; whether nobody of the name is there now.

        None where it did not count.
        """
        with self._lock:
            there = self._sessions[who]
            counted = there[:1] == [session]
            if session in there:
                there.remove(session)
            self._trust(who)
            return not there if counted else None

    def prefer(self, cast: Mapping[str, str]) -> None:
        """Of several of one name that are there, the coordinator has begun with the session in `cast`."""
        with self._lock:
            for who, session in cast.items():
                there = self._sessions.get(who, [])
                if session in there:
                    there.sort(key=lambda other: other != session)
                    self._trust(who)

    def trusts(self, who: str, session: str) -> bool:
        """Whether what comes from this session is from `who`."""
        return session in self._trusted.get(who, ())

    def is_first(self, who: str, session: str) -> bool:
        """Whether, of the sessions of `who` that are there, this one counts; what others had sent has come by then."""
        return self._sessions.get(who, [])[:1] == [session]

    def cast(self, whos: Iterable[str]) -> dict[str, str]:
        """The sessions that count of those who are there, by name."""
        with self._lock:
            return {who: self._sessions[who][0] for who in whos if self._sessions.get(who)}

    def is_there(self, who: str, session: str) -> bool:
        """Whether a session of that name is there, be it believed or not."""
        return session in self._sessions.get(who, ())

    def are_several(self, who: str) -> bool:
        """Whether two of one name are there."""
        return len(self._sessions.get(who, ())) > 1

    def _trust(self, who: str) -> None:
        for session in filter(None, self._sessions[who][:1]):  # a sensor's has no name
            self._trusted[who] = self._trusted.get(who, frozenset()) | {session}
            self._tags[who] = self._tags.get(who, frozenset()) | {tag_of(session)}

    # What comes in.
    def admit(self, topic: str, payload: bytes, stamp: Stamp | None) -> Message:
        """A data message; raises Unfit for what is none of this run, or is not from who sends there."""
        form = self.vouch(topic, len(payload), stamp)
        model = model_of(topic)
        assert model is not None
        try:
            message = model.decode(payload)
        except ValidationError as error:
            kinds = {fault["type"] for fault in error.errors(include_url=False, include_input=False)}
            raise Unfit(INFINITE if kinds == {"finite_number"} else UNREADABLE) from None
        is_far = message.step > self.now + AHEAD and not self._is_paced and topic not in self._sensed
        if is_far or message.step >= self._steps:
            raise Unfit(UNTIMELY)
        self._fit(form, message, stamp)
        return message

    def vouch(self, topic: str, size: int, stamp: Stamp | None) -> _Form:
        """What can be said of a message before it is read; raises Unfit where that is nothing good."""
        form = self._forms.get(topic)
        if form is None:
            if self._problem is not None or model_of(topic) is None:
                raise Unfit(UNASKED)
            form = self._forms[topic] = _any_form(topic)
        sender = stamp.sender if stamp is not None else ""
        if form.senders and sender not in form.senders:
            raise Unfit(FORGED)
        if stamp is not None:
            tags = self._tags.get(sender)
            if tags is not None and stamp.session not in tags:
                raise Unfit(FORGED)
            if stamp.number >= 2**32 - 1 or stamp.time >= 2**63:
                raise Unfit(MISNUMBERED)
        if size > form.longest:
            raise Unfit(OVERSIZED)
        return form

    def turn_away(self, topic: str, payload: bytes, stamp: Stamp | None) -> NoReturn:
        """There is no room for a message. Raises Unfit, and notes what its sender might not give once more."""
        if model_of(topic) is Measurement:
            step = self.admit(topic, payload, stamp).step
            if step >= self.now:
                self._unheld[topic] = min(step, self._unheld.get(topic, step))
        raise Unfit(FLOOD)

    def lost(self) -> tuple[str, int] | None:
        """Topic and step of a measurement that was turned away and that nobody gives again: a sensor keeps nothing.

        Against the clock it is a message like others that are not there in time.
        """
        for topic, step in self._unheld.items():
            if topic in self._sensed and step < self._steps and not self._is_paced:
                return topic, step
        return None

    def first_time(self, topic: str, step: int, stamp: Stamp | None) -> bool:
        """Whether a message has not been there yet, by its number, or by its step where it has none."""
        sender, session, number = (stamp.sender, stamp.session, stamp.number) if stamp is not None else ("", b"", step)
        key = topic, sender, session if sender in self._tags else b""
        numbers = self._seen.get(key)
        if numbers is None:
            numbers = self._seen[key] = _Numbers()
        return numbers.add(number)

    def _fit(self, form: _Form, message: Message, stamp: Stamp | None) -> None:
        """Raises Unfit where a message that can be read is none of this problem."""
        for name, size in form.sizes:
            values: list[float] = getattr(message, name)
            if len(values) != size and (values or not form.may_be_empty):
                raise Unfit(MISSHAPEN)
            if beyond_ceiling(values):
                raise Unfit(INFINITE)
        if self._problem is not None:
            self._read(message, stamp.sender if stamp is not None else "")

    def _read(self, message: Message, sender: str) -> None:
        """Raises Unfit where modes and nodes that a message names are not there, or where it speaks for others."""
        match message:
            case Estimate(mode=mode, heard=heard, origin=origin):
                known = (mode in self._modes or not mode) and len(heard) <= len(self._nodes)
                if not (known and self._nodes.issuperset(heard) and origin in ("", ZERO_STATE, *self._nodes)):
                    raise Unfit(MISSHAPEN)
            case Mode(mode=mode, index=index):
                if index not in (-1, self._modes.get(mode)) or mode not in self._modes:
                    raise Unfit(MISSHAPEN)
            case PlantState(arrived=arrived):
                if not all(theta in (0, 1) for theta in arrived):
                    raise Unfit(MISSHAPEN)
            case Account(who=who):
                if who != sender:
                    raise Unfit(FORGED)
            case Event(who=who):
                if who != sender and (sender != COORDINATOR or who.startswith("node-")):
                    raise Unfit(FORGED)

    def admit_word(self, who: str, topic: str, word: Word, *, second: bool = False) -> None:
        """A word of `who`; raises Unfit where it is not from its session, or was said before.

        `second`: a second session of the name may say it, too; that two have come under one name is worth knowing.
        """
        is_known = self.trusts(who, word.session) or (second and word.session in self._sessions.get(who, ()))
        if not (self.takes_part(who) and is_known):
            raise Unfit(FORGED)
        if word.number <= self._last_words.get((word.session, topic), -1):
            raise Unfit(REPEATED)
        self._last_words[word.session, topic] = word.number

    # What was refused.
    def refuse(self, topic: str, kind: str) -> None:
        """Count a message that was dropped."""
        if self._problem is not None and topic not in self._forms and topic not in _WORDS:
            topic = _OTHER_TOPICS  # anybody can make up topics; there is one counter for all of them
        with self._lock:
            self._counts[topic][kind] += 1

    @property
    def total(self) -> int:
        """How many messages were refused."""
        with self._lock:
            return sum(kinds.total() for kinds in self._counts.values())

    def refused(self) -> Counts:
        """What was refused so far."""
        with self._lock:
            return {topic: dict(kinds) for topic, kinds in self._counts.items()}


_WORDS = (CONTROL, ACKNOWLEDGED, READY, REFUSALS, REPLAY)


class _Numbers:
    """Which of the last WINDOW numbers have been there; in 200 bytes, whatever comes."""

    def __init__(self) -> None:
        self._last, self._mask = -1, 0  # bit b: number last - b was there

    def add(self, number: int) -> bool:
        """False where it was there already, or may have been: it is too old to tell."""
        ahead = number - self._last
        if ahead > 0:
            self._mask = ((self._mask << ahead) | 1) & _ALL if ahead < WINDOW else 1
            self._last = number
            return True
        if -ahead >= WINDOW or self._mask >> -ahead & 1:
            return False
        self._mask |= 1 << -ahead
        return True


_ALL = (1 << WINDOW) - 1


def in_words(counts: Mapping[str, int]) -> str:
    """3 forged, 1 unreadable."""
    return ", ".join(f"{counts[kind]} {kind}" for kind in KINDS if counts.get(kind))


def _any_form(topic: str) -> _Form:
    """Of a problem that is not known."""
    senders = frozenset[str]() if topic in BESIDE else frozenset({sender_of(topic), ""})
    return _Form(senders, (), True, 1 << 24)


def _forms(problem: Problem) -> dict[str, _Form]:
    nodes = frozenset(map(node_who, problem.node_names))
    senders = {EVENT: nodes | {COORDINATOR}, ACCOUNT: nodes}
    senders |= {measurement(name): frozenset({PLANT, sensor_who(name), ""}) for name in problem.node_names}
    may_be_empty = {measurement(node.name) for node in problem.nodes if node.seen}
    return {
        topic: _Form(
            senders.get(topic, frozenset({sender_of(topic)})),
            tuple(vectors(problem, topic).items()),
            topic in may_be_empty,
            size,
        )
        for topic, size in longest(problem).items()
    }
