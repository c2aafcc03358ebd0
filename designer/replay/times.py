"""When the messages of a recording were recorded."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from agent.contract.errors import RunBroken
from agent.contract.keys import BESIDE, decode
from agent.contract.recording import Logged
from designer.replay.topics import Numbers


class Times:
    """The log time of each message and of each of so many steps, in ns since the epoch; not of what is beside steps."""

    def __init__(self, messages: Iterable[Logged], steps: int) -> None:
        self._of: dict[str, Numbers] = {}
        for logged in messages:
            if logged.topic in BESIDE:
                continue
            try:
                step = decode(logged.topic, logged.payload).step
            except RunBroken:  # what is no message of a run has no step
                continue
            if step < steps:
                self._of.setdefault(logged.topic, np.full(steps, -1, dtype=np.int64))[step] = logged.log_time
        latest = np.vstack([np.zeros(steps, dtype=np.int64), *self._of.values()]).max(axis=0)
        self.steps: Numbers = np.maximum.accumulate(latest)  # of its last message; without any, as the step before

    @property
    def last(self) -> int:
        """Of the last step; 0 where there is none."""
        return int(self.steps[-1]) if len(self.steps) else 0

    def of(self, topic: str, step: int) -> int:
        """Of a message; where it is missing, of its step."""
        times = self._of.get(topic)
        return int(times[step] if times is not None and times[step] >= 0 else self.steps[step])

    def missing(self, topic: str) -> Numbers:
        """The steps of which this topic has no message, ascending."""
        return np.flatnonzero(self._of.get(topic, np.full(len(self.steps), -1)) < 0)
