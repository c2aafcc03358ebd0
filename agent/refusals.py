"""What participants have refused, gathered by the coordinator, and when it is told. Pure."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import NamedTuple

from agent.contract.errors import counted
from agent.contract.keys import in_words as name_of
from agent.guard import Counts, in_words

FIRST, LONGEST = 1.0, 64.0  # seconds from one event about a topic to the next, doubled each time


class _Told(NamedTuple):
    total: int = 0
    again: float = -math.inf  # not before
    pause: float = FIRST


class Refused(NamedTuple):
    """What is to be told: `who` has refused what came on `topic`."""

    who: str
    topic: str
    text: str


class Register:
    """The latest counts of everybody, and what has been told of them: seldom, however much there is."""

    def __init__(self) -> None:
        self._counts: dict[str, Counts] = {}
        self._told: dict[tuple[str, str], _Told] = {}

    def enter(self, who: str, counts: Mapping[str, Mapping[str, int]]) -> None:
        """`counts` are all that `who` has refused since it began."""
        self._counts[who] = {topic: dict(kinds) for topic, kinds in counts.items()}

    def due(self, now: float, *, hurry: bool = False) -> Iterator[Refused]:
        """What is to be told by `now`; `hurry`: whatever has not been told yet."""
        for who, counts in self._counts.items():
            for topic, kinds in counts.items():
                told, total = self._told.get((who, topic), _Told()), sum(kinds.values())
                if total == told.total or (now < told.again and not hurry):
                    continue
                self._told[who, topic] = _Told(total, now + told.pause, min(2.0 * told.pause, LONGEST))
                text = f"{name_of(who)} has refused {counted(total, 'message')} on {topic}: {in_words(kinds)}"
                yield Refused(who, topic, text)

    def document(self) -> dict[str, Counts]:
        """Who has refused how much, by topic and kind."""
        return {who: counts for who, counts in sorted(self._counts.items()) if counts}
