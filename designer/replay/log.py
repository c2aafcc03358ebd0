"""A recording as arrays: one row for each step, NaN or -1 where a message is missing.

Messages are matched by (topic, step), never by their place in the file.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from agent.contract.arrays import Array
from agent.contract.errors import InputError
from agent.contract.gains import Gains
from agent.contract.keys import EVENT, MODE, PLANT_STATE, estimate, measurement
from agent.contract.messages import Event
from agent.contract.recording import Logged
from agent.contract.recording.reader import RecordingReader
from designer.replay.census import Census, take_census
from designer.replay.topics import Numbers, Senders, Topic, Words, topics_of


@dataclass(frozen=True, eq=False)
class Log:
    """What a recording says. Vectors of the nodes stand side by side, nodes in file order."""

    path: Path
    run: dict[str, str]  # the metadata of its beginning
    end: dict[str, str] | None  # and of its end; None where the file was cut
    damage: str  # what is wrong with the file, "" where nothing is
    finished: bool  # the run came to its planned end, and the file is sound
    gains: Gains
    seed: int
    planned: int  # steps that the run was to have
    steps: int  # rows of the arrays
    messages: int
    census: Census
    external: tuple[bool, ...]  # per node: a real sensor gives its measurements
    modes: Words  # what the numbers in `mode` and `used` mean; those of the problem come first
    senders: Senders  # what the numbers in `heard` mean
    mode: Numbers  # (steps,)
    x: Array  # (steps, nx)
    z: Array  # (steps, nz)
    w: Array  # (steps, nw)
    theta: Array  # (steps, n)
    y: Array  # (steps, sum ny); NaN also where nothing arrived
    measured: Array  # (steps, n): 1 where y has numbers, 0 where it is empty, NaN where the message is missing
    innovation: Array  # (steps, sum ny)
    x_hat: Array  # (steps, n nx)
    z_hat: Array  # (steps, n nz)
    used: Numbers  # (steps, n): Estimate.mode
    heard: Numbers  # (steps, n): Estimate.heard

    @property
    def is_simulated(self) -> bool:
        """A simulated plant was recorded."""
        return bool(np.isfinite(self.x).any())

    @property
    def has_plant(self) -> bool:
        """A simulated plant gave every measurement and was recorded, so that errors can be computed."""
        return not any(self.external) and self.is_simulated

    def error_norms(self) -> Array:
        """|z_tilde(k)| over all nodes, as logged, (steps,); NaN where a message is missing."""
        return np.asarray(np.linalg.norm(np.tile(self.z, self.gains.problem.n) - self.z_hat, axis=1))


def load(path: Path) -> Log:
    """Read a recording, whole or cut. Raises InputError for a file that is none."""
    with RecordingReader(path) as reader:
        problem = reader.gains.problem
        seed, planned = _integer(reader.run, "seed", path=path), _integer(reader.run, "steps", path=path)
        external = _external(reader)
        topics, content = topics_of(problem, external), _Content(reader.gains, planned)
        content.read(reader.messages(), topics)
        end, damage = reader.end or {}, reader.damage
    if reader.run.get("gains", reader.gains.digest()) != reader.gains.digest():
        content.strange.append("the attached gains are not those that the run was made with: their digests differ")
    finished = end.get("status") == "finished" and not damage
    last = max(int(topic.steps.max(initial=-1)) for topic in topics.values())
    expected = _integer(end, "steps", path=path) if finished else last + 1
    steps = min(last + 1, expected)
    if finished and expected != planned:
        content.strange.append(f"the end, it says that the run finished after {expected} of {planned} steps")
    nothing_simulated = all(external) and not len(topics[PLANT_STATE].steps)
    census = take_census(
        [topic for topic in topics.values() if not (nothing_simulated and topic.topic == PLANT_STATE)],
        steps=expected,
        whole=finished,
        strange=content.strange,
        events=content.events,
    )
    return Log(
        path=path,
        run=reader.run,
        end=reader.end,
        damage=damage,
        finished=finished,
        gains=reader.gains,
        seed=seed,
        planned=planned,
        steps=steps,
        messages=content.messages,
        census=census,
        external=external,
        modes=content.modes,
        senders=content.senders,
        **_columns(topics, problem.node_names, steps),
    )


def _columns(topics: dict[str, Topic], names: tuple[str, ...], steps: int) -> dict[str, Any]:
    """The arrays of a Log."""
    state, estimates = topics[PLANT_STATE], [topics[estimate(name)] for name in names]
    return {
        "mode": topics[MODE].words("mode", steps),
        "x": state.column("x", steps),
        "z": state.column("z", steps),
        "w": state.column("w", steps),
        "theta": state.column("arrived", steps),
        "y": np.hstack([topics[measurement(name)].column("y", steps) for name in names]),
        "measured": np.column_stack([topics[measurement(name)].filled("y", steps) for name in names]),
        "innovation": np.hstack([topic.column("innovation", steps) for topic in estimates]),
        "x_hat": np.hstack([topic.column("x_hat", steps) for topic in estimates]),
        "z_hat": np.hstack([topic.column("z_hat", steps) for topic in estimates]),
        "used": np.column_stack([topic.words("mode", steps) for topic in estimates]),
        "heard": np.column_stack([topic.words("heard", steps) for topic in estimates]),
    }


class _Content:
    """What is gathered while the messages stream by."""

    def __init__(self, gains: Gains, planned: int) -> None:
        self.modes, self.senders = Words(gains.problem.mode_names), Senders(gains.problem.node_names)
        self.messages = 0
        self.strange: list[str] = []
        self.events: Counter[int] = Counter()
        self._planned = planned

    def read(self, messages: Iterator[Logged], topics: dict[str, Topic]) -> None:
        for logged in messages:
            self.messages += 1
            topic = topics.get(logged.topic)
            if topic is not None:
                fault = topic.add(logged, planned=self._planned, modes=self.modes, senders=self.senders)
            else:
                fault = self._event(logged)
            if fault:
                self.strange.append(f"{logged.topic}, {fault}")

    def _event(self, logged: Logged) -> str:
        if logged.topic != EVENT:
            return f"number {logged.number}: this problem has no such topic"
        try:
            Event.decode(logged.payload)
        except ValidationError as error:
            return f"number {logged.number}: {error.errors(include_url=False)[0]['msg'].lower()}"
        self.events[logged.number] += 1
        return ""


def _external(reader: RecordingReader) -> tuple[bool, ...]:
    problem = reader.gains.problem
    names = [name for name in reader.run.get("external", "").split(",") if name]
    for name in names:
        problem.node_index(name)  # refuses a name that does not exist
    return tuple(name in names for name in problem.node_names)


def _integer(metadata: dict[str, str], key: str, *, path: Path) -> int:
    text = metadata.get(key, "")
    if not (text.isascii() and text.isdigit()):
        raise InputError(f'{path}: its metadata gives "{text}" for {key}; it must be a number 0, 1, 2, ...')
    return int(text)
