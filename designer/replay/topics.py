"""The topics of one run, column by column, as their messages come out of a recording."""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from agent.contract.arrays import Array
from agent.contract.keys import COORDINATOR, MODE, PLANT, PLANT_STATE, estimate, measurement, node_who
from agent.contract.messages import Estimate, Measurement, Message, Mode, PlantState
from agent.contract.problem import Problem
from agent.contract.recording import Logged

Numbers = NDArray[np.int64]

CEILING = 1e140  # squares of larger numbers overflow in the proofs


class Words:
    """Texts as numbers, so that arrays can hold them: `texts[number]` is the text again."""

    def __init__(self, known: Iterable[str] = ()) -> None:
        self.texts = list(known)
        self._numbers = {text: number for number, text in enumerate(self.texts)}

    def number(self, text: str) -> int:
        if text not in self._numbers:
            self._numbers[text] = len(self.texts)
            self.texts.append(text)
        return self._numbers[text]


class Senders:
    """Sets of nodes as numbers; the text of one is its names in file order, "1, 4"."""

    def __init__(self, node_names: tuple[str, ...]) -> None:
        self.texts: list[str] = []
        self._node_names = node_names
        self._order = {name: place for place, name in enumerate(node_names)}
        self._numbers: dict[tuple[str, ...], int] = {}  # of names in file order
        self._known: dict[tuple[str, ...], int] = {}  # of names in any order

    def number(self, names: Iterable[str]) -> int:
        key = tuple(names)
        if key not in self._known:
            in_order = tuple(sorted(key, key=lambda name: (self._order.get(name, len(self._order)), name)))
            if in_order not in self._numbers:
                self._numbers[in_order] = len(self.texts)
                self.texts.append(", ".join(in_order))
            self._known[key] = self._numbers[in_order]
        return self._known[key]

    def members(self) -> NDArray[np.bool_]:
        """(numbers, n): which nodes are in each set."""
        rows = [[name in names for name in self._node_names] for names in self._numbers]
        return np.array(rows, dtype=bool).reshape(len(rows), len(self._node_names))


class Topic:
    """The messages of one topic in the order of the file.

    Where two of them claim the same step the one with the lowest number counts: the order of the file decides
    nothing. `who` numbers the messages; None for a sensor driver, which need not number them. Vectors may be empty
    where the problem allows it, `may_be_empty`.
    """

    def __init__(
        self, topic: str, model: type[Message], widths: dict[str, int], *, who: str | None, may_be_empty: bool = False
    ) -> None:
        self.topic, self.who = topic, who
        self._model, self._widths, self._may_be_empty = model, widths, may_be_empty
        self._steps, self._numbers = array("q"), array("q")
        self._values = {name: array("d") for name in widths}
        self._words: dict[str, array[int]] = {"mode": array("q"), "heard": array("q")}

    def add(self, logged: Logged, *, planned: int, modes: Words, senders: Senders) -> str:
        """Take in a message; returns what keeps it from being one of this run, "" where nothing does."""
        try:
            message = self._model.decode(logged.payload)
        except ValidationError as error:
            return f"number {logged.number}: {error.errors(include_url=False)[0]['msg'].lower()}"
        fault = self._fault(message)
        if not fault and message.step >= planned:
            fault = f"the run has only {planned} steps"
        if fault:
            return f"step {message.step}: {fault}"
        self._steps.append(message.step)
        self._numbers.append(logged.number)
        for name, values in self._values.items():
            values.extend(getattr(message, name) or [math.nan] * self._widths[name])
        if isinstance(message, Mode | Estimate):
            self._words["mode"].append(modes.number(message.mode))
        if isinstance(message, Estimate):
            self._words["heard"].append(senders.number(message.heard))
        return ""

    def _fault(self, message: Message) -> str:
        for name, width in self._widths.items():
            values = getattr(message, name)
            if len(values) != width and (values or not self._may_be_empty):
                return f"{name} has {len(values)} numbers where the problem has {width}"
            if values and max(map(abs, values)) > CEILING:
                return f"{name} holds {max(values, key=abs)}, beyond {CEILING:g}"
        return ""

    @property
    def steps(self) -> Numbers:
        """The step of every message, in the order of the file."""
        return np.array(self._steps, dtype=np.int64)

    @property
    def numbers(self) -> Numbers:
        """The sender's number of every message, in the order of the file."""
        return np.array(self._numbers, dtype=np.int64)

    def rows(self, steps: int) -> tuple[Numbers, Numbers]:
        """The steps below `steps` that are there, ascending, and the message that counts for each."""
        at = self.steps
        order = np.lexsort((self.numbers, at))
        order = order[at[order] < steps]
        present, first = np.unique(at[order], return_index=True)
        return present, order[first]

    def column(self, name: str, steps: int) -> Array:
        """(steps, width), NaN where the message is missing, or the vector is empty."""
        present, rows = self.rows(steps)
        column = np.full((steps, self._widths[name]), np.nan)
        column[present] = np.array(self._values[name]).reshape(-1, self._widths[name])[rows]
        return column

    def filled(self, name: str, steps: int) -> Array:
        """(steps,): 1 where the vector has numbers, 0 where it is empty, NaN where the message is missing."""
        filled = np.full(steps, np.nan)
        present, _ = self.rows(steps)
        filled[present] = np.isfinite(self.column(name, steps)[present, 0])
        return filled

    def words(self, name: str, steps: int) -> Numbers:
        """(steps,), -1 where the message is missing."""
        present, rows = self.rows(steps)
        column = np.full(steps, -1, dtype=np.int64)
        column[present] = np.array(self._words[name], dtype=np.int64)[rows]
        return column


def topics_of(problem: Problem, external: tuple[bool, ...]) -> dict[str, Topic]:
    """Every topic that a run of this problem has, but events. `external`: per node, is its sensor a real one."""
    state = {"x": problem.nx, "z": problem.nz, "w": problem.nw, "arrived": problem.n}
    topics = [Topic(MODE, Mode, {}, who=COORDINATOR), Topic(PLANT_STATE, PlantState, state, who=PLANT)]
    for node, is_real in zip(problem.nodes, external, strict=True):
        ny = node.C.shape[0]
        widths = {"x_hat": problem.nx, "innovation": ny, "z_hat": problem.nz}
        topics.append(Topic(estimate(node.name), Estimate, widths, who=node_who(node.name)))
        who = None if is_real else PLANT
        topics.append(Topic(measurement(node.name), Measurement, {"y": ny}, who=who, may_be_empty=node.seen))
    return {topic.topic: topic for topic in topics}
