"""One node of a paced run: what it makes of what came, and when. Pure: arrivals and the time come in as numbers.

At the tick of step k, the arrival of its mode, the node has until `measure_by` for its measurement, publishes, has
until `hear_by` for its neighbours' pairs, and steps. No deadline reaches beyond the next tick. A message counts where
it arrived by the deadline; one that did not is substituted as on a lossy link, for good, and the reason is told.

A node that has no estimate, because it was started while the run went on or has missed a tick, begins again: with
x_hat_j(k) of a neighbour j that it hears in step k, or with 0. It tells that too late to be heard in step k.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Container, Iterator
from typing import NamedTuple

import numpy as np

from agent.contract.arrays import Array
from agent.contract.gains import NodeGains
from agent.contract.keys import estimate, measurement, node_who
from agent.contract.messages import ZERO_STATE, Account, Estimate, Event, Measurement, Message, Mode, Way
from agent.estimates import told
from agent.filter import Pair, Step, innovation, step
from agent.inbox import Inbox
from agent.pacing.reasons import Reasons
from agent.pacing.spread import Spread
from agent.plan import LARGEST_WINDOW, Pace

TELL_STEPS, TELL_SECONDS = 30, 1.0  # after both, a node tells how it goes, again and again
EARLY_PART = 0.25  # of a period: by so much the messages of a step may come before its tick
PATIENCE = 1.0  # seconds, after which a message that is waited for no more counts as silent


class _Arrived(NamedTuple):
    sender: str
    message: Message
    at: float
    way: Callable[[], Way | None]


class PacedNode:
    """Takes in what arrives, and gives out what is to be published.

    `lost` gives the neighbours whose messages of a step the model loses, `is_there` whether the one who publishes a
    topic takes part just now. `begins`: with x_hat = 0 at step 0, with everybody else.
    """

    def __init__(
        self,
        own: NodeGains,
        pace: Pace,
        *,
        steps: int,
        lost: Callable[[int], Container[str]],
        is_there: Callable[[str], bool] = lambda topic: True,
        begins: bool = True,
        filter_step: Step = step,
    ) -> None:
        self._own, self._pace, self._steps, self._filter_step = own, pace, steps, filter_step
        self._lost, self._is_there = lost, is_there
        self._inbox, self._who = Inbox(own), node_who(own.node)
        self._measurement = measurement(own.node)
        self._ticks: dict[int, _Arrived] = {}
        self._there: defaultdict[int, dict[str, _Arrived]] = defaultdict(dict)  # by topic
        self._k = 0
        self._x_hat: Array | None = np.zeros(own.M.shape[1]) if begins else None
        self._made_by: tuple[str, list[str]] = "", []  # mode and nodes that x_hat is made of
        self._sent: Estimate | None = None  # what was told of the present step
        self._reasons = Reasons(self._who, patience=max(PATIENCE, 2.0 * pace.period))
        self._to_estimate, self._to_step = Spread(), Spread()
        self._made = self._pairs = self._pairs_missed = self._measurements_missed = self._late = 0
        self._told_at: tuple[int, float] | None = None  # steps made, and when: of its last account, or the beginning
        self._refused: dict[str, float] = {}  # of a topic, when something of it was refused
        self.done = False

    def take(self, sender: str, message: Message, at: float, way: Callable[[], Way | None] = lambda: None) -> None:
        """Take in what arrived at `at`; `sender` is the node that an estimate is from, `way` asked where it is late."""
        arrived = _Arrived(sender, message, at, way)
        if isinstance(message, Mode):
            self._told_at = self._told_at or (0, at)
            if self._k <= message.step < self._steps and len(self._ticks) < LARGEST_WINDOW:
                self._ticks.setdefault(message.step, arrived)
            return
        topic = self._measurement if isinstance(message, Measurement) else estimate(sender)
        told_already = message.step == self._k and topic == self._measurement and self._sent is not None
        if message.step < self._k or told_already:
            self._late += self._reasons.came(message.step, topic, at, way)
        elif message.step < self._k + LARGEST_WINDOW:
            self._there[message.step].setdefault(topic, arrived)

    def refused(self, topic: str, at: float) -> None:
        """A message that its sender has sent did not fit. What is not there of this topic is not there for that."""
        self._refused[topic] = at
        self._reasons.refused(topic, at)

    @property
    def wake(self) -> float:
        """When `advance` is to be called though nothing arrives; infinity where it need not."""
        if self._k in self._ticks:
            by = self._pace.hear_by if self._sent is not None or self._x_hat is None else self._pace.measure_by
            return min(self._deadline(by), self._reasons.due)
        return self._reasons.due

    def advance(self, now: float) -> Iterator[Message]:
        """Do what can be done by now, and give out what is to be published, in this order."""
        while self._k < self._steps and self._has_tick():
            if self._x_hat is not None and self._sent is None:
                if not self._settled([self._measurement], self._deadline(self._pace.measure_by), now):
                    break
                yield self._measure(self._x_hat)
            wanted = self._wanted()
            if not self._settled(map(estimate, wanted), self._deadline(self._pace.hear_by), now):
                break
            yield from self._hear(wanted, now)
        is_over = self._k == self._steps
        yield from self._reasons.events(now, step=min(self._k, self._steps - 1), hurry=is_over)
        if not is_over and self._is_to_tell(now):
            self._told_at = self._made, now
            yield self._account(self._k - 1)
        if is_over and self._reasons.due == math.inf and not self.done:
            self.done = True
            yield self._account(self._steps - 1)

    def _is_to_tell(self, now: float) -> bool:
        if self._told_at is None:
            return False
        made, at = self._told_at
        return self._made >= made + TELL_STEPS and now >= at + TELL_SECONDS

    def published(self, message: Message, at: float) -> None:
        """`message` of `advance` went out at `at`."""
        if isinstance(message, Estimate) and message.measured and not message.origin:
            arrived = self._there[message.step][self._measurement]
            self._to_estimate.add(max(0.0, at - max(arrived.at, self._ticks[message.step].at)))

    def _has_tick(self) -> bool:
        """Whether the tick of the present step is there; where a later one is, this one was missed."""
        if self._k in self._ticks:
            return True
        if self._ticks:  # modes come in order, over one link
            self._x_hat = None
            self._go_to(min(self._ticks))
            return True
        return False

    def _go_to(self, step: int) -> None:
        for k in [k for k in self._there if k < step]:
            del self._there[k]
        for k in [k for k in self._ticks if k < step]:
            del self._ticks[k]
        self._k, self._sent = step, None
        self._inbox.skip_to(step)

    def _deadline(self, part: float) -> float:
        after = self._ticks[self._k].at + part * self._pace.period
        following = self._ticks.get(self._k + 1)
        return after if following is None else min(after, following.at)

    def _settled(self, topics: Iterator[str] | list[str], deadline: float, now: float) -> bool:
        return now >= deadline or all(topic in self._there[self._k] for topic in topics)

    def _in_time(self, topic: str, deadline: float) -> bool:
        """Put a message into the inbox where it is there in time; else it is late, or missed."""
        arrived = self._there[self._k].get(topic)
        if arrived is not None and arrived.at <= deadline:
            self._inbox.put(arrived.sender, arrived.message)
            return True
        is_gone = arrived is None and not self._is_there(topic)
        since = self._ticks[self._k].at - EARLY_PART * self._pace.period
        is_refused = arrived is None and since <= self._refused.get(topic, -math.inf)
        self._reasons.missed(self._k, topic, deadline=deadline, gone=is_gone, refused=is_refused)
        if arrived is not None:
            self._late += self._reasons.came(self._k, topic, arrived.at, arrived.way)
        return False

    def _measure(self, x_hat: Array) -> Estimate:
        """x_hat(k) and the innovation, which is 0 without a measurement."""
        measured = self._in_time(self._measurement, self._deadline(self._pace.measure_by))
        self._measurements_missed += not measured
        nothing = np.zeros(len(self._own.C))
        y = self._inbox.y
        nu = innovation(self._own, y, x_hat) if measured and y is not None else nothing
        mode, heard = self._made_by
        self._sent = told(self._own, self._k, Pair(x_hat, nu), mode=mode, heard=heard, measured=measured)
        return self._sent

    def _wanted(self) -> list[str]:
        """The neighbours whose pairs this step is to have."""
        tick = self._ticks[self._k].message
        assert isinstance(tick, Mode)
        self._inbox.put("", tick)
        lost = self._lost(self._k)
        return [j for j in self._inbox.neighbours if j != self._own.node and j not in lost]

    def _hear(self, wanted: list[str], now: float) -> Iterator[Message]:
        """The step, from the pairs that are there in time."""
        k, own, deadline = self._k, self._own, self._deadline(self._pace.hear_by)
        there = [j for j in wanted if self._in_time(estimate(j), deadline)]
        self._pairs += len(wanted)
        self._pairs_missed += len(wanted) - len(there)
        if self._sent is None:
            yield from self._begin_again(there)
        assert self._sent is not None
        self._inbox.put(own.node, self._sent)
        heard = self._inbox.heard(lost=set(self._inbox.neighbours) - {own.node, *there})
        assert self._inbox.mode is not None
        self._x_hat = self._filter_step(own, self._inbox.mode, heard)
        self._made_by = self._inbox.mode, list(heard)
        self._made += 1
        self._to_step.add(now - self._ticks[k].at)
        self._go_to(k + 1)

    def _begin_again(self, there: list[str]) -> Iterator[Message]:
        """x_hat(k) from the first neighbour that is heard, or 0; and say so."""
        own, k = self._own, self._k
        pairs = self._there[k]
        x_hat, origin = np.zeros(own.M.shape[1]), ZERO_STATE
        if there:
            message = pairs[estimate(there[0])].message
            assert isinstance(message, Estimate)
            x_hat, origin = np.array(message.x_hat), there[0]
        self._sent = told(own, k, Pair(x_hat, np.zeros(len(own.C))), measured=False, origin=origin)
        yield self._sent
        whose = f"that of node {origin}" if there else "0"
        yield Event(
            step=k, kind="began", who=self._who, detail=f"begins again at step {k}: its estimate is {whose}", steps=[k]
        )

    def _account(self, k: int) -> Account:
        return Account(
            step=k,
            who=self._who,
            steps=self._made,
            pairs=self._pairs,
            pairs_substituted=self._pairs_missed,
            measurements_substituted=self._measurements_missed,
            late=self._late,
            to_estimate_median=self._to_estimate.quantile(0.5),
            to_estimate_p99=self._to_estimate.quantile(0.99),
            to_estimate_max=self._to_estimate.longest,
            to_step_median=self._to_step.quantile(0.5),
            to_step_p99=self._to_step.quantile(0.99),
            to_step_max=self._to_step.longest,
        )
