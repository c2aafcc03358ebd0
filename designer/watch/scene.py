"""All that is seen of a run: told of every message and of who comes and goes, it says what there is to see. Pure.

Without the facts of the run, which its recorder tells, there is no ledger, and nobody knows whom nodes were to hear.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from agent.contract.gains import Gains
from agent.contract.keys import COORDINATOR, node_who
from agent.contract.messages import Account, Control, Estimate, Event, Message, Mode, PlantState
from designer.watch.book import Asked, Book

MEMORY = 2048  # steps of which modes and the plant's z are kept: more than a run may be ahead of its slowest node
EVENTS = 200  # that are kept
RATE_SECONDS = 5.0  # rates are over so long


@dataclass
class NodeSeen:
    """What a node has told last. Norms are Euclidean; times are in seconds, None where they are not known."""

    name: str
    there: bool = False
    step: int | None = None
    delay: float | None = None  # from the tick of its step to its estimate, as both arrived here; in paced runs
    longest_delay: float | None = None
    to_step_median: float | None = None  # from tick to step, as the node itself has told, of all its steps so far
    to_step_p99: float | None = None
    to_step_max: float | None = None
    heard: list[str] = field(default_factory=list)  # whose messages it has used for this estimate
    not_heard: list[str] | None = None  # whose it was to use, but did not; None: not known
    measured: bool | None = None
    innovation: float | None = None
    error: float | None = None  # |z - z_hat|
    error_step: int | None = None
    largest_error: float | None = None
    pairs_substituted: int = 0  # since it is looked on at
    measurements_substituted: int = 0
    origin: str = ""  # what it began with, where it has begun again


@dataclass
class Told:
    """An event, as it is told to people."""

    number: int  # counted since it is looked on at
    step: int
    kind: str
    text: str


@dataclass
class Seen:
    """What there is to see at one moment: plain values, as --json prints them."""

    run: str
    problem: str | None
    seed: int | None
    period: float | None  # seconds; 0 in lock-step; None: not known
    steps: int | None  # that the run is to have
    step: int | None  # the last that was given out
    mode: str | None
    watched_since: int | None  # the first step that was heard
    steps_per_second: float | None
    messages_per_second: float | None
    messages: int
    unreadable: int
    pairs_substituted: int
    measurements_substituted: int
    reasons: dict[str, int]  # how many substitutions events have named, by kind
    gone: list[str]  # participants that were there and are not
    ended: str | None  # why
    nodes: list[NodeSeen]
    ledger: dict[str, Any] | None
    events: list[Told]

    def document(self) -> dict[str, Any]:
        """For --json."""
        return asdict(self)


class Scene:
    """Of one run. Times are seconds of whatever clock the caller has."""

    def __init__(self, run: str) -> None:
        self.ended: str | None = None
        self.unreadable = 0  # messages that are none
        self.gains: Gains | None = None
        self._run = run
        self._start: Control | None = None
        self._book: Book | None = None
        self._asked: Asked | None = None
        self._no_book = ""  # why there is no ledger, though the facts are known
        self._nodes: dict[str, NodeSeen] = {}
        self._there: set[str] = set()
        self._gone: set[str] = set()
        self._modes: dict[int, tuple[str, float]] = {}  # and when each came
        self._z: dict[int, list[float]] = {}
        self._z_hat: dict[tuple[str, int], list[float]] = {}  # that wait for z
        self._since: int | None = None
        self._step: int | None = None
        self._messages = 0
        self._paces: deque[tuple[float, int, int]] = deque()  # time, steps, messages
        self._reasons: Counter[str] = Counter()
        self._events: deque[Told] = deque(maxlen=EVENTS)
        self._told = 0  # events so far

    # what it is told
    def learn(self, start: Control, gains: Gains, *, unproved: str | None = None) -> None:
        """The facts of the run; `unproved` says why its gamma is not."""
        self._start, self.gains = start, gains
        self._asked = Asked(gains.problem, seed=start.seed)
        self._no_book = unproved or ""
        if unproved is None:
            self._book = Book(gains, start, self._asked)
        self._nodes = {name: self._node(name) for name in gains.problem.node_names}

    def present(self, there: Iterable[str]) -> None:
        """Who takes part just now."""
        now = set(there)
        self._gone = (self._gone | self._there) - now
        self._there = now

    def hear(self, topic: str, message: Message, at: float) -> None:
        """A message that arrived at `at`."""
        if not self._is_of_the_run(topic, message):
            self.unreadable += 1
            return
        self._messages += 1
        match message:
            case Mode():
                self._hear_mode(message, at)
            case PlantState():
                self._z[message.step] = message.z
                for name in self._nodes:
                    if (z_hat := self._z_hat.pop((name, message.step), None)) is not None:
                        self._err(self._nodes[name], message.step, message.z, z_hat)
                _bound(self._z)
            case Estimate():
                self._hear_estimate(topic.split("/")[1], message, at)
            case Account(who=who):
                self._hear_account(who.partition("-")[2], message)
            case Event():
                self._hear_event(message)

    def _is_of_the_run(self, topic: str, message: Message) -> bool:
        """As far as its facts are known: of one of its nodes, and its steps."""
        if self.gains is None or self._start is None:
            return True
        names, (kind, _, rest) = self.gains.problem.node_names, topic.partition("/")
        node = rest.partition("/")[0] if kind == "node" else ""
        node = message.who.removeprefix(node_who("")) if isinstance(message, Account) else node
        return message.step < self._start.steps and (not node or node in names)

    def settle(self, now: float, enough: Callable[[], bool] = lambda: False) -> None:
        """To be called now and then: note how fast the run is, and bring the ledger up to date, until `enough`."""
        if self._step is not None:
            self._paces.append((now, self._step, self._messages))
        while len(self._paces) > 2 and self._paces[1][0] <= now - RATE_SECONDS:
            self._paces.popleft()
        if self._book is None:
            return
        self._book.settle({name for name in self._nodes if node_who(name) in self._there}, enough)
        for turn in self._book.turns:
            self._tell(turn.step, "ledger", turn.promise.text())
        self._book.turns.clear()

    # what there is to see
    def seen(self) -> Seen:
        """At this moment."""
        start, problem = self._start, self.gains.problem if self.gains else None
        steps, messages = self._rates()
        for name, node in self._nodes.items():
            node.there = node_who(name) in self._there
        mode = self._modes.get(self._step) if self._step is not None else None
        return Seen(
            run=self._run,
            problem=problem.name if problem else None,
            seed=start.seed if start else None,
            period=start.period if start else None,
            steps=start.steps if start else None,
            step=self._step,
            mode=mode[0] if mode else None,
            watched_since=self._since,
            steps_per_second=steps,
            messages_per_second=messages,
            messages=self._messages,
            unreadable=self.unreadable,
            pairs_substituted=sum(node.pairs_substituted for node in self._nodes.values()),
            measurements_substituted=sum(node.measurements_substituted for node in self._nodes.values()),
            reasons=dict(sorted(self._reasons.items())),
            gone=sorted(self._gone),
            ended=self.ended,
            nodes=list(self._nodes.values()) if self.gains else [self._nodes[name] for name in sorted(self._nodes)],
            ledger=self._ledger(),
            events=list(self._events),
        )

    @property
    def is_complete(self) -> bool:
        """Whether all that can be known of a moment is: the facts, and a step of every node that is there."""
        nodes = [node for name, node in self._nodes.items() if node_who(name) in self._there]
        known = self._step is not None and bool(self._no_book or (self._book and self._book.promise))
        return known and all(node.step is not None for node in nodes)

    def is_over(self) -> bool:
        """Whether the run has ended: its coordinator has said so and gone, or everybody has left."""
        if COORDINATOR in self._there or (self.ended is None and self._there):
            return False
        self.ended = self.ended or "everybody has left"
        return True

    # messages, one by one
    def _hear_mode(self, message: Mode, at: float) -> None:
        self._since = message.step if self._since is None else self._since
        if self._step is None or message.step > self._step:
            self._step = message.step
        self._modes[message.step] = message.mode, at
        _bound(self._modes)
        if self._book is not None:
            self._book.mode(message.step, message.mode)

    def _hear_estimate(self, name: str, message: Estimate, at: float) -> None:
        node, k = self._node(name), message.step
        if self._book is not None:
            self._book.estimate(name, message)
        if node.step is None or k > node.step:
            node.step, node.measured, node.heard = k, message.measured, message.heard
            node.innovation = float(np.linalg.norm(message.innovation))
            node.not_heard = self._not_heard(name, message)
        if message.origin:
            node.origin = message.origin
        else:
            node.measurements_substituted += not message.measured
            node.pairs_substituted += len(node.not_heard or ()) if k == node.step else 0
        tick = self._modes.get(k)
        if tick is not None and self._start is not None and self._start.period and not message.origin:
            node.delay = max(0.0, at - tick[1])
            node.longest_delay = max(node.delay, node.longest_delay or 0.0)
        if (z := self._z.get(k)) is not None:
            self._err(node, k, z, message.z_hat)
        else:
            self._z_hat[name, k] = message.z_hat
            if len(self._z_hat) > MEMORY * len(self._nodes):
                self._z_hat.pop(next(iter(self._z_hat)))

    def _not_heard(self, name: str, message: Estimate) -> list[str] | None:
        """Whose messages of the step before the model let through, and the node did not use."""
        if self.gains is None or self._asked is None:
            return None
        names = self.gains.problem.node_names
        asked = self._asked.of(names.index(name), message) if name in names else ()
        return [names[j] for j in asked if names[j] not in message.heard]

    def _err(self, node: NodeSeen, step: int, z: list[float], z_hat: list[float]) -> None:
        if len(z) == len(z_hat):
            error = float(np.linalg.norm(np.subtract(z, z_hat)))
            node.largest_error = max(error, node.largest_error or 0.0)
            if node.error_step is None or step > node.error_step:
                node.error, node.error_step = error, step

    def _hear_account(self, name: str, account: Account) -> None:
        node = self._node(name)
        node.to_step_median, node.to_step_p99 = account.to_step_median, account.to_step_p99
        node.to_step_max = account.to_step_max

    def _hear_event(self, event: Event) -> None:
        if event.kind in ("end", "stop") and event.who == COORDINATOR:
            self.ended = event.detail
        if event.who.startswith("node-") and event.kind in ("late", "silent", "gone"):
            self._reasons[event.kind] += len(event.steps)
        whose = "" if event.who == COORDINATOR else f"{event.who.replace('-', ' ', 1)}: "
        self._tell(event.step, event.kind, f"{whose}{event.detail}")

    def _tell(self, step: int, kind: str, text: str) -> None:
        self._events.append(Told(self._told, step, kind, text))
        self._told += 1

    def _node(self, name: str) -> NodeSeen:
        if name not in self._nodes:
            self._nodes[name] = NodeSeen(name)
        return self._nodes[name]

    # what follows from many
    def _rates(self) -> tuple[float | None, float | None]:
        """Steps and messages a second, over the last seconds."""
        if len(self._paces) < 2:
            return None, None
        (then, steps, messages), (now, step, heard) = self._paces[0], self._paces[-1]
        return (step - steps) / (now - then), (heard - messages) / (now - then)

    def _ledger(self) -> dict[str, Any] | None:
        book = self._book
        if self._no_book:
            return {"status": "none", "text": f"none: {self._no_book}"}
        if book is None or book.promise is None:
            return None
        promise = book.promise
        return {
            "status": promise.status,
            "text": promise.text(),
            "step": book.at,
            "since": book.since,
            "gamma": promise.gamma,
            "factor": promise.factor if math.isfinite(promise.factor) else None,
            "within": promise.within,
            "owed": [owed._asdict() for owed in promise.owed],
            "reason": promise.reason,
        }


def _bound(kept: dict[int, Any]) -> None:
    """Forget the oldest of too many."""
    while len(kept) > MEMORY:
        del kept[next(iter(kept))]
