"""Why messages were substituted, as far as their receiver can know; told in events, many to one. Pure."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

from agent.contract.messages import GONE, LATE, REFUSED, SILENT, Event, Way

TELL_SECONDS = 0.5  # a reason waits for others to go with it for so long
AT_MOST = 64  # reasons in one event


class _Missed(NamedTuple):
    step: int
    topic: str


class _Told(NamedTuple):
    """Reasons that wait to go out together."""

    since: float
    steps: list[int]
    seconds: list[float]
    ways: list[Way | None]


class Reasons:
    """What receiver `who` says of messages that were not there in time.

    One that comes within `patience` seconds was late; of one that does not, the receiver knows no more than that its
    sender was silent, or gone.
    """

    def __init__(self, who: str, *, patience: float) -> None:
        self._who, self._patience = who, patience
        self._open: dict[_Missed, float] = {}  # its deadline; in the order of the steps
        self._told: dict[tuple[str, str], _Told] = {}

    def missed(self, step: int, topic: str, *, deadline: float, gone: bool, refused: bool = False) -> None:
        """A message was substituted; `gone`: nobody is there who could have sent it; `refused`: one came, unfit."""
        if gone or refused:
            self._tell(REFUSED if refused else GONE, topic, step, 0.0, deadline)
        else:
            self._open[_Missed(step, topic)] = deadline

    def came(self, step: int, topic: str, at: float, way: Callable[[], Way | None] = lambda: None) -> bool:
        """A message came after its step: whether it had been waited for. `way` says where it spent its time."""
        deadline = self._open.pop(_Missed(step, topic), None)
        if deadline is None:
            return False
        self._tell(LATE, topic, step, at - deadline, at, way())
        return True

    def refused(self, topic: str, at: float) -> None:
        """A message came that did not fit: the first that is waited for of its topic, as far as anybody can tell."""
        missed = next((missed for missed in self._open if missed.topic == topic), None)
        if missed is not None:
            del self._open[missed]
            self._tell(REFUSED, topic, missed.step, 0.0, at)

    @property
    def due(self) -> float:
        """When there will be something to say; infinity where there is not."""
        silent = next(iter(self._open.values()), math.inf) + self._patience
        return min([silent, *(told.since + TELL_SECONDS for told in self._told.values())])

    def events(self, now: float, *, step: int, hurry: bool = False) -> Iterator[Event]:
        """What is to be said by now, in step `step`; `hurry`: without waiting for more to say."""
        while self._open and (deadline := next(iter(self._open.values()))) + self._patience <= now:
            missed = next(iter(self._open))
            del self._open[missed]
            self._tell(SILENT, missed.topic, missed.step, 0.0, deadline)
        for (kind, topic), told in list(self._told.items()):
            if hurry or now >= told.since + TELL_SECONDS or len(told.steps) >= AT_MOST:
                del self._told[kind, topic]
                yield self._event(kind, topic, told, step)

    def _tell(self, kind: str, topic: str, step: int, seconds: float, now: float, way: Way | None = None) -> None:
        told = self._told.setdefault((kind, topic), _Told(now, [], [], []))
        told.steps.append(step)
        told.seconds.append(seconds)
        told.ways.append(way)

    def _event(self, kind: str, topic: str, told: _Told, step: int) -> Event:
        steps = f"step {told.steps[0]}" if len(told.steps) == 1 else f"{len(told.steps)} steps from {told.steps[0]}"
        by = f" by up to {1e3 * max(told.seconds):.3g} ms" if kind == LATE else ""
        way = told.ways[told.seconds.index(max(told.seconds))]
        if way is not None:
            by += f" ({1e3 * sum(way):.3g} ms on its way)"
        return Event(
            step=step,
            kind=kind,
            who=self._who,
            detail=f"{topic} was {kind}{by} and was substituted: {steps}",
            about=topic,
            steps=told.steps,
            seconds=told.seconds if kind == LATE else [],
            way=list(way) if way is not None else [],
        )
