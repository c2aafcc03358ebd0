"""Writes a run as it happens: what a killed recorder or a power cut may lose is bounded, the rest is sound."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Self

from mcap.writer import CompressionType, Writer

from agent.contract.errors import InputError, RunBroken
from agent.contract.files import refuse_overwrite
from agent.contract.gains import Gains
from agent.contract.keys import model_of
from agent.contract.layout import foxglove_layout
from agent.contract.recording import FORMAT, VERSION, Logged

CHUNK_SIZE = 256 * 1024
FLUSH_SECONDS = 0.25  # a killed recorder loses what came after the last flush
SYNC_SECONDS = 1.0  # a power cut, what came after the last sync


def refuse_recording(path: Path, *, force: bool) -> Path:
    """The `.part` file that a recording would be written to; InputError where it or `path` may not be replaced."""
    part = path.with_name(path.name + ".part")
    refuse_overwrite(path, force=force)
    refuse_overwrite(part, force=force)
    return part


class RecordingWriter:
    """Writes `<path>.part`, and renames it to `path` when the run has ended. Not thread-safe."""

    def __init__(self, path: Path, *, run: dict[str, str], gains: Gains, force: bool = False) -> None:
        self._path, self._part = path, refuse_recording(path, force=force)
        try:
            self._file = self._part.open("wb")
        except OSError as error:
            raise InputError(f"{path} could not be written: {error.strerror}") from error
        self._writer = Writer(
            self._file, chunk_size=CHUNK_SIZE, compression=CompressionType.ZSTD, enable_data_crcs=True
        )
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._flushed = self._synced = time.monotonic()
        self._writer.start(profile="", library="peakmesh")
        self._writer.add_metadata("run", {"format": FORMAT, "version": VERSION, **run})
        now = time.time_ns()
        for name, data in (
            ("problem.json", gains.problem.canonical()),
            ("gains.json", gains.canonical()),
            ("layout.json", json.dumps(foxglove_layout(gains.problem)).encode()),
        ):
            self._writer.add_attachment(now, now, name, "application/json", data)
        with self._writing():
            self._writer.flush()

    def add(self, message: Logged) -> None:
        """Append one message. Raises RunBroken for what MCAP or the format cannot hold, before writing it.

        Every method raises RunBroken where the disk is full or fails.
        """
        channel = self._channels.get(message.topic)
        if channel is None:
            channel = self._register(message.topic)
        if not (
            isinstance(message.payload, bytes)
            and _counts(message.number, 2**32)
            and _counts(message.log_time, 2**63)
            and _counts(message.publish_time, 2**63)
        ):  # a wrong argument would corrupt the open chunk under a valid checksum
            raise RunBroken(f"{self._path.name}: a message on {message.topic} cannot be recorded: {message}")
        with self._writing():
            self._writer.add_message(channel, message.log_time, message.payload, message.publish_time, message.number)

    def flush_when_due(self) -> None:
        """Flush and sync as often as promised."""
        now = time.monotonic()
        if now - self._flushed >= FLUSH_SECONDS:
            with self._writing():
                self._writer.flush()
                self._flushed = now
                if now - self._synced >= SYNC_SECONDS:
                    os.fsync(self._file.fileno())
                    self._synced = now

    def finish(self, end: dict[str, str]) -> None:
        """Write `end`, the index, and give the file its name."""
        with self._writing():
            self._writer.flush()  # the messages first: where `end` can be read, nothing was cut before it
            self._writer.add_metadata("end", end)
            self._writer.finish()
            self._file.flush()
            os.fsync(self._file.fileno())
            self._file.close()
            self._part.replace(self._path)

    def close(self) -> None:
        """Let go of the file; without `finish` it stays `.part`, cut but readable."""
        if not self._file.closed:
            with self._writing(), self._file:
                self._writer.flush()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise RunBroken(f"{self._path} could not be written: {error.strerror}") from error

    def _register(self, topic: str) -> int:
        model = model_of(topic)
        if model is None:
            raise RunBroken(f"{self._path.name}: there is no topic {topic}")
        schema = self._schemas.get(model.__name__)
        if schema is None:
            text = json.dumps(model.model_json_schema()).encode()
            schema = self._schemas[model.__name__] = self._writer.register_schema(
                f"peakmesh.{model.__name__}", "jsonschema", text
            )
        self._channels[topic] = self._writer.register_channel(topic, "json", schema)
        return self._channels[topic]


def _counts(value: object, limit: int) -> bool:
    return isinstance(value, int) and 0 <= value < limit
