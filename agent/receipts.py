"""Receipts for the messages of a run: what the recorder has, and what it lacks. Pure."""

from __future__ import annotations

from collections import defaultdict

from agent.contract.keys import COORDINATOR, MODE, PLANT_STATE, estimate, measurement
from agent.contract.messages import Stamp
from agent.contract.problem import Problem


class Receipts:
    """Counts messages by sender, and the steps of which every message is there.

    In a `paced` run nothing but the mode has to be: whoever is not there does not hold the others up.
    """

    def __init__(self, problem: Problem, *, paced: bool = False) -> None:
        names = problem.node_names
        self._topics = (MODE,) if paced else (MODE, PLANT_STATE, *map(measurement, names), *map(estimate, names))
        self._there: defaultdict[int, set[str]] = defaultdict(set)  # topics of the incomplete steps
        self._early: defaultdict[str, set[int]] = defaultdict(set)  # numbers that came before their turn
        self.complete = 0  # every message of the steps below is there
        self.messages = 0  # taken
        self.received: dict[str, int] = {}  # of each sender, the messages without a gap
        self.lost: dict[str, int] = {}  # of each sender, messages that went with a process before this one
        self.void: defaultdict[str, set[int]] = defaultdict(set)  # of each sender, numbers of those, and of copies
        self._gone: dict[str, int] = {}  # of each sender that has lost some, the last step seen before
        self.reached: dict[str, int] = {}  # of each sender, the last step seen

    def take(self, topic: str, step: int, stamp: Stamp | None) -> bool:
        """Enter a message; False where it is there already and must not be recorded again."""
        if stamp is not None and not self._number(stamp.sender, stamp.number):
            return False
        self.messages += 1
        sender = stamp.sender if stamp is not None else f"sensor of {topic}"
        self.reached[sender] = max(step, self.reached.get(sender, 0))
        if topic == MODE and stamp is not None and step <= self._gone.get(sender, -1):
            self._given_again(stamp, step)
        if step >= self.complete and topic in self._topics:
            self._there[step].add(topic)
            self._complete()
        return True

    def _complete(self) -> None:
        while len(self._there.get(self.complete, ())) == len(self._topics):
            del self._there[self.complete]
            self.complete += 1

    def lacking(self) -> list[str]:
        """The topics that keep the first incomplete step incomplete, in the order in which they come about."""
        there = self._there.get(self.complete, set())
        return [topic for topic in self._topics if topic not in there]

    def missing(self, sender: str) -> int:
        """How many messages of a sender are missing before the last one of theirs that is there."""
        early, lost = self._early.get(sender), self.lost.get(sender, 0)
        return lost + (max(early) - self.received.get(sender, 0) - len(early) + 1 if early else 0)

    def close_gap(self, sender: str, *, below: int | None = None) -> None:
        """Expect the number after the last one that is there, or after those `below`: nobody keeps the others."""
        early, expected = self._early[sender], self.received.get(sender, 0)
        end = max(early) + 1 if below is None and early else below or 0
        if end > expected:
            gone = set(range(expected, end)) - early
            self.lost[sender] = self.lost.get(sender, 0) + len(gone)
            self.void[sender] |= gone
            if below is None:
                self._gone[sender] = self.reached[sender]
            self.received[sender] = end
            early -= set(range(expected, end))
            self._go_on(sender)
        if below is not None and sender == COORDINATOR and self._topics == (MODE,):
            self.complete = min(self._there, default=self.complete)  # the modes until there will not be given again
            self._complete()

    def _given_again(self, stamp: Stamp, step: int) -> None:
        """A mode under a new number: the one that was lost, or a copy of one that is there."""
        if step < self.complete or MODE in self._there.get(step, ()):
            self.void[stamp.sender].add(stamp.number)
        else:
            self.lost[stamp.sender] -= 1

    def _number(self, sender: str, number: int) -> bool:
        expected, early = self.received.get(sender, 0), self._early[sender]
        if number < expected or number in early:
            return False
        early.add(number)
        self._go_on(sender)
        return True

    def _go_on(self, sender: str) -> None:
        """Count the messages that follow those received, without a gap."""
        expected, early = self.received.get(sender, 0), self._early[sender]
        while expected in early:
            early.remove(expected)
            expected += 1
        self.received[sender] = expected
