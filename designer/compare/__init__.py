"""Two recordings beside each other: the same run bit for bit, or how far apart, and where first.

Messages are matched by topic and step, never by their place in the file, and compared number by number. Times,
numbering and the run's name differ between any two runs, and are left alone; so is
what stands beside the steps: events, accounts and the recorder's evidence.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from itertools import zip_longest
from pathlib import Path
from typing import Any

from agent.contract.arrays import ulps
from agent.contract.errors import RunBroken
from agent.contract.keys import BESIDE, MODE, PLANT_STATE, decode, model_of
from agent.contract.recording import Logged
from agent.contract.recording.contents import number
from agent.contract.recording.reader import RecordingReader
from designer.compare.comparison import Comparison, Difference, Gap

At = tuple[str, int]  # topic and step


def compare(a: Path, b: Path) -> Comparison:
    """Read two recordings side by side. Raises InputError for a file that is none."""
    with RecordingReader(a) as first, RecordingReader(b) as second:
        found = Comparison((str(a), str(b)), {})
        _Pairs(found).read(first.messages(), second.messages())
        facts = [_facts(reader) for reader in (first, second)]
        found.facts = {name: (facts[0][name], facts[1][name]) for name in facts[0]}
        found.damage = first.damage, second.damage
    found.gaps = {at: found.gaps[at] for at in sorted(found.gaps, key=lambda at: (*_order(at[0]), at[1]))}
    return found


def _facts(reader: RecordingReader) -> dict[str, Any]:
    run, gains = reader.run, reader.gains
    end = reader.end or {"status": "cut: it has no end"}
    return {
        "problem": f"{gains.problem.name} ({gains.problem_digest[:12]}...)",
        "gains": f"{gains.method} ({gains.digest()[:12]}...)",
        "seed": number(run.get("seed", "")),
        "steps": number(run.get("steps", "")),
        "external": run.get("external", "") or "no node",
        "end": f"{end.get('status', '')} {end.get('steps', '')}".strip(),
    }


def _order(topic: str) -> tuple[int, str]:
    """The messages of a step in the order in which they come about."""
    kinds = [topic == PLANT_STATE, topic.endswith("/measurement"), topic.endswith("/estimate"), topic == MODE]
    return kinds.index(True), topic


class _Pairs:
    """Matches the messages of both recordings while they stream by; what waits for its partner is kept, and no more."""

    def __init__(self, found: Comparison) -> None:
        self._found = found
        self._waiting: tuple[dict[At, Logged], dict[At, Logged]] = {}, {}
        self._seen: tuple[dict[str, _Seen], dict[str, _Seen]] = {}, {}
        self._over = [False, False]
        self._equal: Counter[str] = Counter()  # messages of each topic whose bytes are equal

    def read(self, a: Iterator[Logged], b: Iterator[Logged]) -> None:
        for pair in zip_longest(a, b):
            for side, logged in enumerate(pair):
                if logged is None:
                    self._over[side] = True
                elif logged.topic not in BESIDE:
                    self._take(side, logged)
        for side in (0, 1):
            for at in self._waiting[side]:
                self._alone(side, at)
        for topic, count in self._equal.items():
            model = model_of(topic)
            assert model is not None  # it was decoded
            for name in model.model_fields.keys() - {"step"}:
                self._found.gaps.setdefault((topic, name), Gap()).compared += count

    def _take(self, side: int, logged: Logged) -> None:
        try:
            at = logged.topic, decode(logged.topic, logged.payload).step
        except RunBroken as error:
            self._found.unreadable.append(f"{self._found.paths[side]}: {error}")
            return
        partner = self._waiting[1 - side].pop(at, None)
        if self._seen[side].setdefault(logged.topic, _Seen()).again(at[1]):
            self._found.double[side][logged.topic] += 1
        elif partner is not None:
            self._compare(at, *((partner, logged) if side else (logged, partner)))
        elif self._over[1 - side]:
            self._alone(side, at)
        else:
            self._waiting[side][at] = logged

    def _alone(self, side: int, at: At) -> None:
        self._found.only[side][at[0]] += 1
        there = [None, "there"] if side else ["there", None]
        self._differ(Difference(at[1], at[0], "", a=there[0], b=there[1], ulp=None))

    def _compare(self, at: At, a: Logged, b: Logged) -> None:
        topic, step = at
        self._found.messages += 1
        if a.payload == b.payload:
            self._equal[topic] += 1
            return
        message_a, message_b = decode(topic, a.payload), decode(topic, b.payload)
        differ = False
        for name in type(message_a).model_fields:
            if (name in message_a.model_fields_set) != (name in message_b.model_fields_set):
                self._found.unsaid.add(f"{name} of {topic}")
            elif name != "step":
                differ |= self._field(topic, step, name, getattr(message_a, name), getattr(message_b, name))
        self._found.rewritten += not differ

    def _field(self, topic: str, step: int, name: str, a: Any, b: Any) -> bool:
        """Whether the values of one field differ."""
        gap = self._found.gaps.setdefault((topic, name), Gap())
        gap.compared += 1
        place, apart = _first_apart(a, b, gap)
        if place is None:
            return False
        gap.differ += 1
        if isinstance(a, list) and len(a) == len(b):
            a, b, name = a[place], b[place], f"{name}[{place}]"
        self._differ(Difference(step, topic, name, a, b, apart))
        return True

    def _differ(self, difference: Difference) -> None:
        first = self._found.first
        if first is None or (difference.step, *_order(difference.topic)) < (first.step, *_order(first.topic)):
            self._found.first = difference


def _first_apart(a: Any, b: Any, gap: Gap) -> tuple[int | None, int | None]:
    """The first place where two values differ, and by how many ulp there; `gap` takes in all places."""
    if not isinstance(a, list):
        return (None if a == b else 0), None
    if len(a) != len(b):
        return 0, None
    first, ulp = None, None
    for place, (x, y) in enumerate(zip(a, b, strict=True)):
        if isinstance(x, float):
            apart = ulps(x, y)
            if not apart:
                continue
            gap.ulp = max(gap.ulp, apart)
            gap.absolute = max(gap.absolute, abs(x - y))
            gap.relative = max(gap.relative, abs(x - y) / max(abs(x), abs(y), 5e-324))
        elif x == y:
            continue
        if first is None:
            first, ulp = place, apart if isinstance(x, float) else None
    return first, ulp


class _Seen:
    """Which steps of a topic came by; in order they cost nothing to remember."""

    def __init__(self) -> None:
        self._below = 0  # all of these
        self._beyond: set[int] = set()

    def again(self, step: int) -> bool:
        """Take in a step; True where it came before."""
        if step < self._below or step in self._beyond:
            return True
        self._beyond.add(step)
        while self._below in self._beyond:
            self._beyond.remove(self._below)
            self._below += 1
        return False
