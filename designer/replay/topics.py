"""The topics of one run, column by column, as their messages come out of a recording.

A run may have millions of messages: their numbers go into columns with a row for each step, and nothing else is kept.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterable, Iterator
from operator import attrgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from agent.contract.arrays import Array
from agent.contract.keys import COORDINATOR, MODE, PLANT, PLANT_STATE, estimate, measurement, node_who
from agent.contract.messages import CEILING, ZERO_STATE, Estimate, Measurement, Message, Mode, PlantState
from agent.contract.problem import Problem
from agent.contract.recording import Logged

Numbers = NDArray[np.int64]

NAMED = 20  # so many faults of a kind are named, the others counted
_ROWS = 1 << 20  # of the columns at first, where the run has so many steps
_AT_ONCE = 512  # messages of a topic that wait to be entered together


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

    def origin(self, text: str) -> int:
        """The node whose estimate another one begins again with; n for the zero state, -1 for none, -2 for no node."""
        if text in ("", ZERO_STATE):
            return len(self._node_names) if text else -1
        return self._order.get(text, -2)

    def members(self) -> NDArray[np.bool_]:
        """(numbers, n): which nodes are in each set."""
        rows = [[name in names for name in self._node_names] for names in self._numbers]
        return np.array(rows, dtype=bool).reshape(len(rows), len(self._node_names))


class Sentences:
    """The first of many sentences, and how many there were."""

    def __init__(self) -> None:
        self.total, self.first = 0, list[str]()

    def add(self, sentence: str) -> None:
        self.total += 1
        if self.total <= NAMED:
            self.first.append(sentence)

    def all(self) -> list[str]:
        more = self.total - len(self.first)
        return [*self.first, *([f"... {more} more like the last"] if more else [])]


class Columns:
    """Arrays with a row for each step; rows that nothing was written to take no memory."""

    def __init__(self, widths: dict[str, tuple[int, type]], *, planned: int) -> None:
        self._widths, self._planned, self.rows = widths, planned, min(planned, _ROWS)
        self._arrays = {name: self._made(name, self.rows) for name in widths}

    def _made(self, name: str, rows: int) -> NDArray[Any]:
        width, kind = self._widths[name]
        return (np.zeros if kind is np.bool_ else np.empty)((rows, width), dtype=kind)

    def reach(self, rows: int) -> None:
        """Make room for so many rows, of those that are planned."""
        if rows <= self.rows:
            return
        self.rows = min(self._planned, max(2 * self.rows, rows))
        for name, old in list(self._arrays.items()):
            self._arrays[name] = self._made(name, self.rows)
            self._arrays[name][: len(old)] = old

    def __getitem__(self, name: str) -> NDArray[Any]:
        return self._arrays[name]

    @property
    def width(self) -> int:
        """Bytes of a row."""
        return sum(array.itemsize * array.shape[1] for array in self._arrays.values())

    def release(self, *names: str) -> None:
        """Forget columns."""
        for name in names:
            del self._arrays[name]


class Topic:
    """The messages of one topic: their step, their number and time, and where their numbers stand in the columns.

    Equal messages of a step are one. Where different ones claim the same step the one with the lowest number counts:
    the order of the file decides nothing. `who` numbers the messages; None for a sensor driver, which need not number
    them. Vectors may be empty where the problem allows it, `may_be_empty`.
    """

    def __init__(
        self,
        topic: str,
        model: type[Message],
        places: dict[str, slice],
        words: dict[str, int],
        *,
        place: int,
        who: str | None,
        may_be_empty: bool = False,
    ) -> None:
        """`places` are the columns of its vectors, `words` those of its texts, `place` that of the topic itself."""
        self.topic, self.who, self.place = topic, who, place
        self.last = -1  # step
        self.copies = 0  # messages that stand there again, equal in content
        self.double: set[int] = set()  # steps of which there is another message, of other content
        self.faults = Sentences()  # messages that cannot be of this run
        self.beyond: list[tuple[int, str]] = []  # steps and numbers beyond the ceiling
        self.unreadable = Sentences()  # messages that are none at all
        self.places, self.words, self._may_be_empty = places, words, may_be_empty
        self._model, self._decode = model, model.__pydantic_validator__.validate_json  # what Message.decode calls
        self._get = attrgetter(*places) if len(places) > 1 else None
        self._tells_nothing = model is Estimate and "told" not in words
        self._widths = tuple(at.stop - at.start for at in places.values())
        self._clear()

    def _clear(self) -> None:
        self._steps, self._numbers, self._times = array("q"), array("q"), array("q")
        self._values = array("d")  # the vectors of each message one after the other
        self._texts = {name: array("q") for name in self.words}

    def add(self, logged: Logged, columns: Columns, *, planned: int, modes: Words, senders: Senders) -> int:
        """Take in a message; returns its step, -1 where it cannot be read."""
        try:
            message = self._read(logged.payload)
        except ValidationError as error:
            words = error.errors(include_url=False)[0]["msg"].lower()
            self.unreadable.add(f"{self.topic}, number {logged.number}: {words}")
            return -1
        step: int = message.step
        vectors = self._vectors(message)
        if step >= planned or tuple(map(len, vectors)) != self._widths:
            vectors, fault = self._fitted(vectors) if step < planned else ((), f"the run has only {planned} steps")
            if fault:
                self.faults.add(f"{self.topic}, step {step}: {fault}")
                return step
        if self._tells_nothing and (message.origin or not message.measured):
            self.faults.add(f"{self.topic}, step {step}: it says what only paced runs have to say")
            return step
        self._steps.append(step)
        self._numbers.append(logged.number)
        self._times.append(logged.log_time)
        for values in vectors:
            self._values.extend(values)
        if self.words:
            self._add_words(message, modes, senders)
        if len(self._steps) == _AT_ONCE:
            self.settle(columns)
        return step

    def _read(self, payload: bytes) -> Any:
        try:
            return self._decode(payload)
        except ValidationError:
            return self._model.decode(payload)  # one of a later version, perhaps

    def _vectors(self, message: Any) -> tuple[list[float], ...]:
        if self._get is not None:
            return self._get(message)
        return tuple(getattr(message, name) for name in self.places)

    def _fitted(self, vectors: tuple[list[float], ...]) -> tuple[tuple[list[float], ...], str]:
        """The vectors, NaN in place of those that are empty and may be; and what is wrong with their lengths."""
        fitted = []
        for name, width, values in zip(self.places, self._widths, vectors, strict=True):
            if len(values) != width and (values or not self._may_be_empty):
                return (), f"{name} has {len(values)} numbers where the problem has {width}"
            fitted.append(values or [math.nan] * width)
        return tuple(fitted), ""

    def _add_words(self, message: Message, modes: Words, senders: Senders) -> None:
        if isinstance(message, Estimate):
            self._texts["used"].append(modes.number(message.mode))
            self._texts["heard"].append(senders.number(message.heard))
            if "told" in self._texts:
                self._texts["told"].append(message.measured)
                self._texts["origin"].append(senders.origin(message.origin))
        elif isinstance(message, Mode):
            number = modes.number(message.mode)
            self._texts["mode"].append(number)
            if message.index not in (-1, number):
                place = f"{self.topic}, step {message.step}"
                self.faults.add(f'{place}: index {message.index} is not that of "{message.mode}"')

    def settle(self, columns: Columns) -> None:
        """Enter the messages that wait."""
        if not self._steps:
            return
        values = np.array(self._values).reshape(len(self._steps), -1)
        self._blank(values)
        steps = np.array(self._steps)
        self.last = max(self.last, int(steps.max(initial=-1)))
        columns.reach(self.last + 1)
        has = columns["has"][:, self.place]
        fresh = ~has[steps]
        if not (np.diff(steps) > 0).all():
            first = np.zeros(len(steps), dtype=bool)
            first[np.unique(steps, return_index=True)[1]] = True
            fresh &= first
        rows = {name: (column, batch) for name, (column, batch) in self._rows(columns, values)}
        for column, batch in rows.values():
            column[steps[fresh]] = batch[fresh]
        has[steps[fresh]] = True
        for at in np.flatnonzero(~fresh):
            self._again(int(at), int(steps[at]), rows)
        self._clear()

    def _blank(self, values: Array) -> None:
        """Forget the numbers of the messages that wait and hold one beyond the ceiling; and note them."""
        beyond = np.abs(values) > CEILING
        names = np.repeat(list(self.places), self._widths)
        for row in np.flatnonzero(beyond.any(axis=1)):
            column = int(np.argmax(beyond[row]))
            what = f"{names[column]} holds {values[row, column]}, beyond {CEILING:g}"
            self.beyond.append((self._steps[row], f"{self.topic}, step {self._steps[row]}: {what}"))
            values[row] = np.nan

    def _rows(self, columns: Columns, values: Array) -> Iterator[tuple[str, tuple[NDArray[Any], NDArray[Any]]]]:
        """The columns of this topic, and what waits to be written there."""
        yield "number", (columns["number"][:, self.place], np.array(self._numbers))
        yield "time", (columns["time"][:, self.place], np.array(self._times))
        first = 0
        for (name, at), width in zip(self.places.items(), self._widths, strict=True):
            yield name, (columns[name][:, at], values[:, first : first + width])
            first += width
        for name, texts in self._texts.items():
            yield name, (columns[name][:, self.words[name]], np.array(texts))

    def _again(self, at: int, step: int, rows: dict[str, tuple[NDArray[Any], NDArray[Any]]]) -> None:
        """Another message of a step that is there."""
        contents = [
            (column[step], batch[at]) for name, (column, batch) in rows.items() if name not in ("number", "time")
        ]
        before, now = (b"".join(pair[which].tobytes() for pair in contents) for which in (0, 1))
        if before == now:
            self.copies += 1
        else:
            self.double.add(step)
        number, batch = rows["number"]
        if (batch[at], now) < (number[step], before):
            for column, values in rows.values():
                column[step] = values[at]


def topics_of(
    problem: Problem, external: tuple[bool, ...], *, planned: int, paced: bool = False
) -> tuple[dict[str, Topic], Columns]:
    """Every topic that a run of this problem has, but events, and the columns that they fill.

    `external`: per node, is its sensor a real one. `planned`: steps of the run.
    """
    n, nx, nz = problem.n, problem.nx, problem.nz
    state = {"x": slice(0, nx), "z": slice(0, nz), "w": slice(0, problem.nw), "arrived": slice(0, n)}
    topics = [Topic(MODE, Mode, {}, {"mode": 0}, place=0, who=COORDINATOR)]
    topics.append(Topic(PLANT_STATE, PlantState, state, {}, place=1, who=PLANT))
    ends = np.cumsum([len(node.C) for node in problem.nodes])
    for i, (node, is_real, end) in enumerate(zip(problem.nodes, external, ends.tolist(), strict=True)):
        y = slice(end - len(node.C), end)
        vectors = {"x_hat": slice(i * nx, (i + 1) * nx), "innovation": y, "z_hat": slice(i * nz, (i + 1) * nz)}
        words, who = dict.fromkeys(("used", "heard", *(("told", "origin") if paced else ())), i), node_who(node.name)
        topics.append(Topic(estimate(node.name), Estimate, vectors, words, place=2 + 2 * i, who=who))
        sensor = None if is_real else PLANT
        topics.append(
            Topic(
                measurement(node.name), Measurement, {"y": y}, {}, place=3 + 2 * i, who=sensor, may_be_empty=node.seen
            )
        )
    ny, each = int(ends[-1]), len(topics)
    widths: dict[str, tuple[int, type]] = {
        "has": (each, np.bool_),
        "number": (each, np.uint32),
        "time": (each, np.int64),
        "mode": (1, np.int64),
        "used": (n, np.int64),
        "heard": (n, np.int64),
        **(dict.fromkeys(("told", "origin"), (n, np.int64)) if paced else {}),
        "x": (nx, np.float64),
        "z": (nz, np.float64),
        "w": (problem.nw, np.float64),
        "arrived": (n, np.float64),
        "y": (ny, np.float64),
        "innovation": (ny, np.float64),
        "x_hat": (n * nx, np.float64),
        "z_hat": (n * nz, np.float64),
    }
    return {topic.topic: topic for topic in topics}, Columns(widths, planned=planned)
