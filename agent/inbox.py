"""What a node must have before it may go on: its measurement, the mode, the pairs of those it hears. Pure.

Messages may come in any order and some steps early; they are matched by (step, sender), never by time. What
belongs to a finished step is dropped. That a message fits the problem, `guard` has seen to.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Container

import numpy as np

from agent.contract.arrays import Array
from agent.contract.gains import NodeGains
from agent.contract.messages import Estimate, Measurement, Message, Mode
from agent.filter import Pair


class Inbox:
    """The messages of the present step and of those to come."""

    def __init__(self, gains: NodeGains) -> None:
        self._hears = {mode: [link.sender for link in links] for mode, links in gains.links.items()}
        self._step = 0
        self._measurements: dict[int, Array] = {}
        self._modes: dict[int, str] = {}
        self._pairs: defaultdict[int, dict[str, Pair]] = defaultdict(dict)

    def put(self, sender: str, message: Message) -> None:
        """Take in a message; `sender` is the node that an estimate is from. The first of a step counts, no other."""
        if message.step < self._step:
            return
        match message:
            case Mode(step=step, mode=mode):
                self._modes.setdefault(step, mode)
            case Measurement(step=step, y=y):
                self._measurements.setdefault(step, np.array(y))
            case Estimate(step=step, x_hat=x_hat, innovation=innovation):
                self._pairs[step].setdefault(sender, Pair(np.array(x_hat), np.array(innovation)))

    @property
    def y(self) -> Array | None:
        """The measurement of the present step, None while it is missing; empty where nothing arrived."""
        return self._measurements.get(self._step)

    @property
    def mode(self) -> str | None:
        """The mode of the present step, None while it is missing."""
        return self._modes.get(self._step)

    @property
    def neighbours(self) -> list[str]:
        """The nodes that the present step's mode has this one hear, itself among them."""
        return self._hears[self._modes[self._step]]

    @property
    def lacking(self) -> str | None:
        """A node whose pair the present step's mode asks for and that is missing; None where all are there."""
        pairs = self._pairs[self._step]
        return next((sender for sender in self.neighbours if sender not in pairs), None)

    def heard(self, *, lost: Container[str] = ()) -> dict[str, Pair]:
        """The pairs that the present step's mode asks for, without those of `lost`; all must be there."""
        pairs = self._pairs[self._step]
        return {sender: pairs[sender] for sender in self.neighbours if sender not in lost}

    def next_step(self) -> None:
        """Forget the present step."""
        for kept in (self._measurements, self._modes, self._pairs):
            kept.pop(self._step, None)
        self._step += 1

    def skip_to(self, step: int) -> None:
        """Forget every step before `step`."""
        while self._step < step:
            self.next_step()
