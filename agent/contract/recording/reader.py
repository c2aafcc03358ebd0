"""One run in one MCAP file: everything that was on the wire, and everything needed to check it.

Metadata `run` comes first and `end` last; problem.json, gains.json and a Foxglove layout are attached. A file
without `end` was cut. Messages are the wire's own bytes; log_time is the recorder's clock, publish_time the
sender's, sequence the sender's own numbering. Order by step and sender, never by time.
"""

from __future__ import annotations

import json
import os
import struct
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import IO, NamedTuple, Self

import zstandard
from mcap.exceptions import EndOfFile, InvalidMagic, McapError
from mcap.records import Attachment, Channel, Chunk, McapRecord, Metadata
from mcap.records import Message as McapMessage
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import CompressionType, Writer

from agent.contract.errors import InputError, RunBroken
from agent.contract.files import refuse_overwrite
from agent.contract.gains import Gains
from agent.contract.layout import foxglove_layout
from agent.contract.messages import model_of

FORMAT = "peakmesh-recording"
VERSION = "1"

CHUNK_SIZE = 256 * 1024
FLUSH_SECONDS = 0.25  # a killed recorder loses what came after the last flush
SYNC_SECONDS = 1.0  # a power cut, what came after the last sync

# A damaged length asks for more memory than there is, or than a machine can count.
_DAMAGE = (McapError, struct.error, ValueError, zstandard.ZstdError, KeyError, EOFError, MemoryError, OverflowError)


class Logged(NamedTuple):
    """One recorded message. Times are in ns since the epoch."""

    topic: str
    payload: bytes
    number: int
    log_time: int
    publish_time: int


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


class RecordingReader:
    """Reads a recording from front to back, whole or cut.

    `run` and `gains` are there at once; `end` and `damage` after `messages()` has been read to its end. `end` is
    None where the run's last word is missing, and `damage` says what is wrong with the file, "" where nothing is.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.end: dict[str, str] | None = None
        self.damage = ""
        try:
            self._file = path.open("rb")
        except FileNotFoundError:
            raise InputError(f"{path} does not exist; a recording was expected there") from None
        except OSError as error:
            raise InputError(f"{path} could not be read as a recording: {error.strerror}") from error
        self._records = _records(self._file)
        self._channels: dict[int, str] = {}
        try:
            self.run, self.gains = self._read_head()
        except InputError:
            self._file.close()
            raise

    def _read_head(self) -> tuple[dict[str, str], Gains]:
        run: dict[str, str] | None = None
        try:
            for record in self._records:
                if isinstance(record, Metadata) and record.name == "run":
                    run = record.metadata
                    if run.get("format") != FORMAT or run.get("version") != VERSION:
                        raise InputError(
                            f"{self.path} has recording format {run.get('format')} {run.get('version')}; "
                            f"this peakmesh reads {FORMAT} {VERSION}"
                        )
                elif isinstance(record, Attachment) and record.name == "gains.json" and run is not None:
                    return run, Gains.from_bytes(record.data, source=f"{self.path}: gains.json")
                elif isinstance(record, McapMessage):
                    break
        except InvalidMagic:
            raise InputError(f"{self.path} is not a recording: it is not an MCAP file") from None
        except _DAMAGE as error:
            raise InputError(
                f"{self.path} is cut or damaged before its first message: {_why(error)}; nothing can be read"
            ) from None
        lack = "run metadata" if run is None else "gains"
        raise InputError(f"{self.path} is an MCAP file, but not a recording of peakmesh: it has no {lack}")

    def messages(self) -> Iterator[Logged]:
        """Every message in the order of the file, as far as the file is sound."""
        try:
            for record in self._records:
                if isinstance(record, McapMessage):
                    yield Logged(
                        self._channels[record.channel_id],
                        record.data,
                        record.sequence,
                        record.log_time,
                        record.publish_time,
                    )
                elif isinstance(record, Channel):
                    self._channels[record.id] = record.topic
                elif isinstance(record, Metadata) and record.name == "end":
                    self.end = record.metadata
                elif isinstance(record, Metadata) and record.name == "run":
                    self.damage = "it holds the beginning of a second run"
            if self._file.read(1):
                self.damage = "it goes on after its end, as if files had been joined"
        except _DAMAGE as error:
            self.damage = f"it is cut or damaged: {_why(error)}"

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()


def _records(file: IO[bytes]) -> Iterator[McapRecord]:
    """The records of a file; messages only out of chunks, where a checksum covers them."""
    for record in StreamReader(file, validate_crcs=True, emit_chunks=True).records:
        if isinstance(record, Chunk):
            yield from breakup_chunk(record, validate_crc=True)
        elif not isinstance(record, McapMessage):  # one outside a chunk is another record, damaged
            yield record


def _counts(value: object, limit: int) -> bool:
    return isinstance(value, int) and 0 <= value < limit


def _why(error: Exception) -> str:
    text = str(error).rstrip(".")
    if isinstance(error, EndOfFile | struct.error):
        return "the file ends in the middle of a record"
    if isinstance(error, MemoryError | OverflowError):
        return "a record claims to be larger than memory"
    return f"{type(error).__name__}: {text}"
