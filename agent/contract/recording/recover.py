"""Writes what can be read of a recording anew: whole, indexed, in the order of the steps, and with what was lost said.

Nothing is made better than it is: messages keep payload, number and times, two that contradict each other both stay,
and what was damaged is told in metadata `run`, so that a replay says of the new file what it says of the old one.
"""

from __future__ import annotations

import heapq
import pickle
import re
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import IO, NamedTuple, Self

from agent.contract.keys import BESIDE, EVENT, EVIDENCE, MODE, PLANT_STATE, model_of
from agent.contract.recording import Logged
from agent.contract.recording.parts import refuse_recording, unfinished
from agent.contract.recording.reader import Progress, RecordingReader
from agent.contract.recording.writer import RecordingWriter

_STEP = re.compile(rb'"step"\s*:\s*(\d{1,18})\b')
_ORDER = {EVENT: 0, MODE: 1, PLANT_STATE: 2, EVIDENCE: 4}  # of the topics within a step
_BETWEEN = 3  # all others, by name
_HELD = 50_000  # messages sorted in memory at once
_BATCH = 500  # of them read back at once

Key = tuple[int, int, str, int, int, bytes]  # step, order and name of the topic, number, publish time, payload


class Recovered(NamedTuple):
    """What was written, and what was not."""

    messages: int
    copies: int  # left out, since an equal one is there
    foreign: int  # messages of others, left out
    status: str  # of the end that was written
    steps: int  # complete from the first on
    damage: str  # what was lost
    notes: tuple[str, ...]


def recover(
    paths: Sequence[Path],
    output: Path,
    *,
    run: str | None = None,
    gains: Path | None = None,
    force: bool = False,
    report: Progress | None = None,
) -> Recovered:
    """Write the run that is in `paths`. Raises InputError where there is none, or `output` may not be written."""
    refuse_recording(output, force=force)
    with RecordingReader(*paths, run=run, gains=gains) as reader, _Sorter() as sorter:
        for logged in reader.messages(report):
            if model_of(logged.topic) is not None:
                sorter.add(logged)
        written = 0
        steps = _Steps(2 + 2 * reader.gains.problem.n)
        try:
            with RecordingWriter(output, run=_facts(reader), gains=reader.gains, force=force) as writer:
                for logged, step in sorter.messages():
                    writer.add(logged)
                    written += logged.topic != EVIDENCE  # which the recorder itself has added
                    steps.count(logged.topic, step)
                end = reader.end or _end(reader, steps.complete)
                writer.finish(end)
        except BaseException:
            unfinished(output).unlink(missing_ok=True)
            raise
        return Recovered(
            messages=written,
            copies=sorter.copies,
            foreign=reader.foreign.total() + reader.others,
            status=end["status"],
            steps=steps.complete,
            damage=reader.damage,
            notes=tuple(reader.notes),
        )


def _facts(reader: RecordingReader) -> dict[str, str]:
    """Metadata of the run, with what a reader of the new file must know of the old one."""
    kept = {key: text for key, text in reader.run.items() if key not in ("format", "version", "part")}
    told = {
        "recovered.from": ", ".join(path.name for path in reader.paths),
        "recovered.damage": reader.damage,
        "recovered.faults": "; ".join(reader.faults),
        "recovered.checksum": "failed" if reader.is_doubtful else "none" if reader.is_unchecked else "",
    }
    return kept | {key: text for key, text in told.items() if text}


def _end(reader: RecordingReader, complete: int) -> dict[str, str]:
    return {"status": "recovered", "reason": reader.damage or "its end was not in the file", "steps": str(complete)}


class _Steps:
    """Counts the steps of which every topic is there, as messages come step by step."""

    def __init__(self, topics: int) -> None:
        self._topics, self._step = topics, 0
        self._there: set[str] = set()
        self.complete = 0

    def count(self, topic: str, step: int) -> None:
        if step != self._step:
            self._step = step
            self._there.clear()
        if topic not in BESIDE:
            self._there.add(topic)
        if step == self.complete and len(self._there) == self._topics:
            self.complete += 1


class _Sorter:
    """Messages by step and topic, through temporary files where there are many; of equal ones the first alone."""

    def __init__(self) -> None:
        self._held: list[tuple[Key, Logged]] = []
        self._files: list[IO[bytes]] = []
        self._step = 0
        self.copies = 0

    def add(self, logged: Logged) -> None:
        found = _STEP.search(logged.payload)
        if found is not None:  # what does not say its step stays where it is
            self._step = int(found[1])
        order = _ORDER.get(logged.topic, _BETWEEN)
        key = (self._step, order, logged.topic, logged.number, logged.publish_time, logged.payload)
        self._held.append((key, logged))
        if len(self._held) == _HELD:
            self._spill()

    def _spill(self) -> None:
        self._held.sort()
        file = tempfile.TemporaryFile()  # noqa: SIM115 - closed with the sorter
        self._files.append(file)
        for first in range(0, len(self._held), _BATCH):
            pickle.dump(self._held[first : first + _BATCH], file, pickle.HIGHEST_PROTOCOL)
        file.seek(0)
        self._held = []

    def messages(self) -> Iterator[tuple[Logged, int]]:
        """Every message and its step, in order."""
        self._held.sort()
        place: tuple[int, str] = (-1, "")
        seen: set[tuple[int, bytes]] = set()
        for (step, _, topic, _, _, _), logged in heapq.merge(self._held, *map(_read, self._files)):
            if (step, topic) != place:
                place = step, topic
                seen.clear()
            content = (logged.publish_time if topic == EVENT else 0, logged.payload)  # an event may happen twice
            if content in seen:
                self.copies += 1
                continue
            seen.add(content)
            yield logged, step

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for file in self._files:
            file.close()


def _read(file: IO[bytes]) -> Iterator[tuple[Key, Logged]]:
    """What was spilled to a file of our own."""
    while True:
        try:
            yield from pickle.load(file)
        except EOFError:
            return
