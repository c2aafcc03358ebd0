"""Paced runs without processes: the production node under a virtual clock, with a network that does what it is told."""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Container, Iterable
from itertools import count

import numpy as np
from made_recordings import Sent, _Numbered

from agent.contract import keys, schedule
from agent.contract.gains import Gains
from agent.contract.messages import Account, Estimate, Message, Mode
from agent.pacing.node import PacedNode
from agent.plan import Pace
from agent.roles.plant import SimulatedPlant

PACE = Pace(0.1)
SOON = 0.002  # seconds that a message takes

# seconds that the message of (topic, step) takes to the receiver, a node; infinity where it is lost
Delay = Callable[[str, str, int], float]


class PacedRun:
    """Every message of a paced run in `messages`.

    `delay` is the network; `away` maps a node, "plant" to ranges of steps in which no process is there: a node begins
    anew afterwards, the plant goes on. `frozen` maps a node to ranges of steps in which nothing reaches it, until the
    step after them, when all of it does. What comes at (receiver, topic, step) of `unfit` is refused there.
    """

    def __init__(
        self,
        gains: Gains,
        *,
        steps: int,
        seed: int = 1,
        delay: Delay = lambda receiver, topic, step: SOON,
        away: dict[str, range] | None = None,
        frozen: dict[str, range] | None = None,
        unfit: Container[tuple[str, str, int]] = (),
        pace: Pace = PACE,
    ) -> None:
        self._gains, self._steps, self._pace, self._delay = gains, steps, pace, delay
        self._away, self._frozen, self._unfit = away or {}, frozen or {}, unfit
        self._deliveries = schedule.Deliveries(gains.problem, seed=seed)
        self._sent = _Numbered()
        self._events: list[tuple[float, int, Callable[[float], None]]] = []
        self._order = count()
        self._now = 0.0
        self.nodes = {name: self._node(name, begins=True) for name in gains.problem.node_names}
        self._chain = schedule.modes(gains.problem, seed=seed)
        self._plant = SimulatedPlant(gains.problem, seed=seed, worst_case=gains.worst_case)
        self._run()

    @property
    def messages(self) -> list[Sent]:
        return self._sent.messages

    def _node(self, name: str, *, begins: bool) -> PacedNode:
        problem = self._gains.problem
        i = problem.node_index(name)
        return PacedNode(
            self._gains.for_node(name),
            self._pace,
            steps=self._steps,
            lost=lambda k: {problem.node_names[j] for j in np.flatnonzero(~self._deliveries.at(k)[i])},
            is_there=lambda topic: not self._is_away("plant" if "measurement" in topic else topic.split("/")[1]),
            begins=begins,
        )

    def _run(self) -> None:
        self._send("event", "coordinator", step=0, kind="start", who="coordinator", detail="")
        for k in range(self._steps):
            self._at(k * self._pace.period, self._tick)
        while self._events:
            self._now, _, do = heapq.heappop(self._events)
            do(self._now)
        self._send("event", "coordinator", step=self._steps - 1, kind="end", who="coordinator", detail="")

    def _tick(self, now: float) -> None:
        k = round(now / self._pace.period)
        for who, steps in self._away.items():
            if k == steps.start:
                self._send("event", "coordinator", step=k, kind="gone", who="coordinator", detail="", about=_who(who))
            if k == steps.stop and who != "plant":
                self.nodes[who] = self._node(who, begins=False)
        problem = self._gains.problem
        mode = Mode(step=k, mode=problem.mode_names[next(self._chain)])
        self._send("mode", "coordinator", **mode.model_dump())
        for name in self.nodes:
            self._deliver(name, "mode", "", mode)
        state, measurements = self._plant.advance(k)
        if self._is_away("plant"):
            return
        for name, y in measurements.items():
            topic = keys.measurement(name)
            self._send(topic, "plant", **y.model_dump())
            self._deliver(name, topic, name, y)
        self._send("plant/state", "plant", **state.model_dump())

    def _is_away(self, who: str) -> bool:
        return int(self._now / self._pace.period + 1e-9) in self._away.get(who, ())

    def _deliver(self, receiver: str, topic: str, sender: str, message: Message) -> None:
        arrives = self._now + self._delay(receiver, topic, message.step)
        frozen = self._frozen.get(receiver)
        if frozen is not None and frozen.start <= arrives / self._pace.period < frozen.stop:
            arrives = frozen.stop * self._pace.period + SOON
        node = self.nodes[receiver]

        def arrive(now: float) -> None:
            if self.nodes[receiver] is node and not self._is_away(receiver):
                if (receiver, topic, message.step) in self._unfit:
                    node.refused(topic, now)
                else:
                    node.take(sender, message, now)
                self._advance(receiver)

        if arrives < math.inf:
            self._at(arrives, arrive)

    def _advance(self, name: str) -> None:
        node = self.nodes[name]
        for message in node.advance(self._now):
            topic = keys.EVENT
            if isinstance(message, Estimate):
                topic = keys.estimate(name)
                for other in self._hearers(name):
                    self._deliver(other, topic, name, message)
            elif isinstance(message, Account):
                topic = keys.ACCOUNT
            self._send(topic, keys.node_who(name), **message.model_dump(exclude_defaults=True))
            node.published(message, self._now)
        if not node.done and node.wake < math.inf:

            def wake(now: float) -> None:
                if self.nodes[name] is node and not self._is_away(name):
                    self._advance(name)

            self._at(max(node.wake, self._now), wake)

    def _hearers(self, name: str) -> list[str]:
        problem = self._gains.problem
        j = problem.node_index(name)
        return [other for i, other in enumerate(problem.node_names) if i != j and j in problem.ever_heard(i)]

    def _at(self, time: float, do: Callable[[float], None]) -> None:
        heapq.heappush(self._events, (time, next(self._order), do))

    def _send(self, topic: str, sender: str, /, **document: object) -> None:
        self._sent.add(topic, sender, **document)


def _who(name: str) -> str:
    return name if name == "plant" else keys.node_who(name)


def of(messages: Iterable[Sent], topic: str) -> dict[int, dict[str, object]]:
    """The documents of a topic by step."""
    return {sent.document["step"]: sent.document for sent in messages if sent.topic == topic}


def estimates(messages: Iterable[Sent]) -> dict[tuple[str, int], dict[str, object]]:
    return {
        (sent.topic.split("/")[1], sent.document["step"]): sent.document
        for sent in messages
        if sent.topic.endswith("/estimate")
    }
