"""What a participant sees to while nothing comes: queues that fill, and what the coordinator is told of refusals."""

from __future__ import annotations

import time
from collections.abc import Callable

from agent.contract.keys import COORDINATOR
from agent.contract.messages import Refusals
from agent.guard import Guard
from agent.network.gate import Gate
from agent.network.session import CAPACITY

HOUSE_SECONDS = 0.5  # between two looks after the queues
BUSY_SECONDS = 0.01  # where one of them was filling
TELL_SECONDS = 1.0  # between two words on what was refused


class Housekeeping:
    """Of participant `who`; everything belongs to the main thread."""

    def __init__(self, who: str, guard: Guard, *, tell: Callable[[Refusals], None]) -> None:
        self._who, self._guard, self._tell = who, guard, tell
        self.gates: list[Gate] = []
        self._due = self._told = 0.0  # when to look after the house; when we last told what was refused
        self._reported = 0  # messages that we have told of

    def keep(self) -> float:
        """See that no queue of zenoh's is full, and tell the coordinator what was refused; when to do so again."""
        now = time.monotonic()
        if now < self._due:
            return self._due
        fullest = max((gate.relieve() for gate in self.gates), default=0)
        self._due = now + (HOUSE_SECONDS if fullest < CAPACITY // 8 else BUSY_SECONDS)
        if now >= self._told + TELL_SECONDS:
            self._told = now
            self.tell_refused()
        return self._due

    def tell_refused(self) -> None:
        """Tell the coordinator what we have refused, where there is something new."""
        total = self._guard.total
        if total > self._reported and self._who != COORDINATOR:
            self._reported = total
            self._tell(Refusals(who=self._who, counts=self._guard.refused()))
