"""The ledger of a run that is looked on at: told of messages as they come, it settles one step after the other.

A step is settled once every node that is there has told of the next one. Where a message was not heard here, and where
the looking on begins, nothing is known of what was there before: the ledger begins anew, with a term for that, which
counts per length of [x; e] and fades as any other.

What a replay knows, and this cannot yet: whether a pair that nobody asks for just now will fail when it is next asked
for. It is taken to be as when it was asked for last. Pure.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection
from typing import Any, NamedTuple

import numpy as np

from agent.contract.gains import Gains
from agent.contract.messages import ZERO_STATE, Control, Estimate
from agent.contract.problem import Problem
from agent.contract.schedule import Deliveries
from designer.ledger.account import beginning
from designer.ledger.deviation import AS_DESIGNED, Deviation
from designer.ledger.exact import Ledger
from designer.ledger.promise import Promise

LAG = 2  # steps by which a mode must be ahead: what is on its way of somebody who is gone has come by then
PATIENCE = 2.0  # seconds after which a node that says nothing counts as absent, though it has not gone
BACKLOG = 500  # steps that wait to be settled, at most: of a large network one with a fault may take seconds
MOST = 2048  # steps of which anything is kept: more than a run may be ahead of its slowest node
LOOKS = 4  # promises that are worked out each time, at most, where faults begin and end


class Turn(NamedTuple):
    """The promise became another one."""

    step: int
    promise: Promise


class Asked:
    """Whom each node was to use in a step: its neighbours in the mode, whose messages the model did not lose."""

    def __init__(self, problem: Problem, *, seed: int) -> None:
        self._problem, self._deliveries = problem, Deliveries(problem, seed=seed)

    def of(self, i: int, told: Estimate) -> list[int]:
        """Of node i, which tells the estimate that it made of that step."""
        problem, k = self._problem, told.step - 1
        if k < 0 or told.origin or told.mode not in problem.mode_names:
            return []
        delivered = self._deliveries.at(k)[i]
        return [j for j in problem.neighbours(problem.mode_index(told.mode), i) if j != i and delivered[j]]


class Book:
    """`start` is the order that the run started by. Nodes are counted from 0, in file order."""

    def __init__(self, gains: Gains, start: Control, asked: Asked) -> None:
        self.promise: Promise | None = None  # None: not known yet
        self.at = self.since = 0  # the step that it is of, and the first that was seen without a gap before it
        self.turns: list[Turn] = []  # what it became since this was emptied last
        self._problem, self._names = gains.problem, {name: i for i, name in enumerate(gains.problem.node_names)}
        self._new = Ledger.of(gains).anew
        self._asked = asked
        self._starts_anywhere = bool(start.external)
        self._patience = math.ceil(PATIENCE / start.period) if start.period else math.inf
        self._modes: dict[int, str] = {}
        self._told: list[dict[int, Estimate]] = [{} for _ in self._names]  # of each node, from the next step on
        self._newest = [-1] * len(self._names)  # of each node, the last step that it has told of
        self._first, self._tick, self._next = -1, -1, -1  # modes that were heard first and last; what is next to settle
        self._ledger: Ledger | None = None
        self._before = ""  # the mode of the step that the ledger stands at
        self._failed: set[tuple[int, int]] = set()  # pairs that failed when they were asked for last
        self._last = AS_DESIGNED

    def mode(self, step: int, mode: str) -> None:
        self._first = step if self._first < 0 else self._first
        self._tick = max(self._tick, step)
        if step >= self._next:
            self._modes[step] = mode

    def estimate(self, node: str, message: Estimate) -> None:
        i = self._names.get(node)
        if i is None:
            return
        if message.step < self._next:
            self._lose()  # it was taken to be absent, and was not
        self._newest[i] = max(self._newest[i], message.step)
        if message.step >= self._next:
            self._told[i][message.step] = message

    def settle(self, there: Collection[str], enough: Callable[[], bool] = lambda: False) -> None:
        """Settle what can be, until `enough`; `there` are the names of the nodes that take part just now."""
        waited_for = [i for name, i in self._names.items() if name in there]
        self._catch_up(waited_for)
        if self._next < 0 and not self._may_begin(waited_for):
            return
        looks, settled = LOOKS, False
        while self._is_settled(self._next, waited_for) and not enough():
            before = self._last
            self._settle(self._next)
            self._next += 1
            settled = True
            if looks and self._last != before:
                looks -= 1
                self._look()
        if settled:
            self._look()

    def _catch_up(self, waited_for: list[int]) -> None:
        """Where too many steps wait, leave them out, and begin anew after them.

        They wait where settling them takes too long, or where somebody who is there cannot be heard here.
        """
        has_begun = self._next >= 0
        last = min([self._tick - LAG, *(self._newest[i] - 1 for i in waited_for)])
        if has_begun and last - self._next > BACKLOG:
            self._skip_to(last)
        elif self._tick - (self._next if has_begun else self._first) > MOST:
            self._first = self._tick
            self._skip_to(self._tick if has_begun else -1)

    def _skip_to(self, k: int) -> None:
        self._lose()
        self._next = k
        self._drop(max(k, self._first))

    # when
    def _may_begin(self, waited_for: list[int]) -> bool:
        """Whether everybody who is there has been heard; then it begins at the first step that all have told of."""
        if self._first < 0 or any(self._newest[i] < 0 for i in waited_for):
            return False
        self._next = max([self._first, *(min(told) for told in self._told if told)])
        self._drop(self._next)
        return True

    def _is_settled(self, k: int, waited_for: list[int]) -> bool:
        if self._tick < k + LAG:
            return False
        return self._tick >= k + self._patience or all(self._newest[i] > k for i in waited_for)

    def _drop(self, k: int) -> None:
        """What is older than step k."""
        kept: list[dict[int, Any]] = [self._modes, *self._told]
        for of_step in kept:
            for step in [step for step in of_step if step < k]:
                del of_step[step]

    # what
    @property
    def _is_void(self) -> bool:
        """For good."""
        return self._ledger is not None and self._ledger.is_void

    def _lose(self) -> None:
        """What happened in a step was not heard here; a bound that is void stays so."""
        if not self._is_void:
            self._ledger, self.promise = None, None

    def _settle(self, k: int) -> None:
        mode, deviation = self._modes.get(k), self._deviation(k)
        self._drop(k + 1)
        if self._is_void:
            return
        if mode is None or deviation is None:
            self._lose()
            return
        if self._ledger is None:
            self._ledger = self._begun(k, mode)
        else:
            self._ledger.step()
            self._void_outside_the_chain(mode)
        self._ledger.tell(deviation)
        self._last, self._before = deviation, mode

    def _deviation(self, k: int) -> Deviation | None:
        """What was not as designed in step k; None where that was not heard here."""
        absent, begun, unmeasured = set(), set(), set()
        for i, told in enumerate(self._told):
            now, later = told.get(k), min((step for step in told if step > k), default=None)
            if now is None and later is not None and not told[later].origin:
                return None  # the node went on: it was there
            if now is None:
                absent.add(i)
                continue
            if now.origin:
                begun.add((i, None if now.origin == ZERO_STATE else self._names.get(now.origin)))
            if not now.measured:
                unmeasured.add(i)
            if (following := told.get(k + 1)) is not None:
                self._compare(i, following)
        return Deviation(frozenset(self._failed), frozenset(unmeasured), frozenset(absent), frozenset(begun))

    def _compare(self, i: int, following: Estimate) -> None:
        """Whose pairs node i has used in a step, as it tells in the next, with those that it was to use."""
        for j in self._asked.of(i, following):
            used = self._problem.node_names[j] in following.heard
            (self._failed.discard if used else self._failed.add)((i, j))

    def _begun(self, k: int, mode: str) -> Ledger:
        """A ledger that stands at step k."""
        ledger, names = self._new(k), self._problem.mode_names
        self.since = k
        if mode not in names:
            ledger.void(f'mode "{mode}" is none of the chain')
        elif k:
            size = ledger.models.designed.size
            start = np.zeros((len(names), size, size))
            start[names.index(mode)] = np.eye(size)
            ledger.jump(start, f"what was there at step {k}", is_unit=True)
        elif (begun := beginning(self._problem, unknown=self._starts_anywhere)) is not None:
            begun.told(ledger)
        return ledger

    def _void_outside_the_chain(self, mode: str) -> None:
        assert self._ledger is not None
        names, chain = self._problem.mode_names, self._problem.markov.transition
        if mode not in names:
            self._ledger.void(f'mode "{mode}" is none of the chain')
        elif not chain[names.index(self._before), names.index(mode)]:
            self._ledger.void(f'the chain never goes from mode "{self._before}" to "{mode}"')

    def _look(self) -> None:
        if self._ledger is None:
            return
        before, self.promise, self.at = self.promise, self._ledger.promise(), self._ledger.k
        if before is None or (before.status, before.reason) != (self.promise.status, self.promise.reason):
            self.turns.append(Turn(self.at, self.promise))
