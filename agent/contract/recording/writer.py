"""Writes a run as it happens: what a killed recorder or a power cut may lose is bounded, the rest is sound.

A long run may be split into parts (`parts` has their names). Each is a whole recording, with the same `run` metadata
but for its number, `part`; the `end` of each but the last has the status "continues", names the `next`, and counts what
was received since the beginning of the run.
"""

from __future__ import annotations

import errno
import json
import os
import struct
import time
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from mcap.writer import CompressionType, Writer

from agent.contract.closing import Closing
from agent.contract.errors import RecordingFailed, RunBroken
from agent.contract.gains import Gains
from agent.contract.keys import model_of
from agent.contract.layout import foxglove_layout
from agent.contract.recording import FORMAT, VERSION, Logged
from agent.contract.recording.parts import files_of, part_path, refuse_recording, unfinished

CHUNK_SIZE = 256 * 1024  # bytes of messages after which they are flushed
FLUSH_SECONDS = 0.25  # or so long; a killed recorder loses what came after the last flush
SYNC_SECONDS = 1.0  # a power cut, what came after the last sync
MESSAGE_SIZE = 31  # bytes that a message takes beside its payload
_NEVER = 2**62
_CHUNK_HEAD = struct.Struct("<BQ")  # opcode, length of what follows


class Split(NamedTuple):
    """When a part is long enough: after so many bytes of messages in the file, or so many seconds; None is never."""

    size: int | None = None
    seconds: float | None = None


class RecordingWriter(Closing):
    """Writes a recording, part by part. Not thread-safe.

    Every method raises RecordingFailed where the disk is full or fails, or the file is gone; what was written stays,
    and there is nothing else to do then but to `close`.
    """

    def __init__(
        self,
        path: Path,
        *,
        run: dict[str, str],
        gains: Gains,
        force: bool = False,
        split: Split | None = None,
        first: int | None = None,
    ) -> None:
        """`first` is the part to begin with where those before it are there already."""
        if first is None:
            refuse_recording(path, force=force)
        self._path, self._run, self._force, self._split = path, run, force, split or Split()
        old = [] if first is not None else files_of(path)
        self._old = [there for there in old if there not in (path, unfinished(path))]
        self._attachments = {
            "problem.json": gains.problem.canonical(),
            "gains.json": gains.canonical(),
            "layout.json": json.dumps(foxglove_layout(gains.problem)).encode(),
        }
        self._number = first or 1
        self._part = self._begin()

    def _begin(self) -> _Part:
        run = {"format": FORMAT, "version": VERSION, **self._run, "part": str(self._number)}
        path = part_path(self._path, self._number)
        return _Part(path, run=run, attachments=self._attachments, force=self._force)

    def add(self, message: Logged) -> None:
        """Append one message. Raises RunBroken for what MCAP or the format cannot hold, before writing it."""
        self._part.add(message)

    def flush_when_due(self) -> None:
        """Flush and sync as often as promised."""
        self._part.flush_when_due()

    def flush(self) -> None:
        """Have the file hold everything that was added."""
        self._part.flush_when_due(at_once=True)

    @property
    def is_flushed(self) -> bool:
        """Whether the file has everything that was added."""
        return self._part.pending == 0

    @property
    def part_is_full(self) -> bool:
        """Whether it is time for the next part."""
        size, seconds = self._split
        return self._part.messages > 0 and (
            (size is not None and self._part.size >= size)
            or (seconds is not None and time.monotonic() - self._part.began >= seconds)
        )

    def next_part(self, end: dict[str, str]) -> None:
        """Finish this part and begin the next; `end` counts since the beginning of the run."""
        following = part_path(self._path, self._number + 1).name
        self._finish({**end, "status": "continues", "reason": "", "next": following})
        self._number += 1
        self._part = self._begin()

    def finish(self, end: dict[str, str]) -> None:
        """Write `end`, the index, and give the file its name."""
        self._finish(end)

    def _finish(self, end: dict[str, str]) -> None:
        self._part.finish(end)
        for old in self._old:  # with this part's name the old recording is gone; its other parts are of no use
            with suppress(OSError):
                old.unlink()
        self._old = []

    def close(self) -> None:
        """Let go of the file; without `finish` it stays `.part`, cut but readable."""
        self._part.close()


class _Part:
    """One file of a recording."""

    def __init__(self, path: Path, *, run: dict[str, str], attachments: dict[str, bytes], force: bool) -> None:
        self._path, self._unfinished, self._force = path, unfinished(path), force
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self.messages = 0
        self.pending = 0  # bytes of messages that are not in the file yet
        self._head = self._end = 0  # of the file, as far as it was flushed: before the messages, and after them
        self.began = self._flushed = self._synced = time.monotonic()
        try:
            self._file = self._unfinished.open("wb" if force else "xb")
        except OSError as error:
            raise self._said(error) from error
        self._writer = Writer(
            self._file, chunk_size=_NEVER, compression=CompressionType.ZSTD, enable_data_crcs=True
        )  # a chunk ends when we flush, so that we know what is in the file
        now = time.time_ns()
        try:
            self._writer.start(profile="", library="peakmesh")
            self._writer.add_metadata("run", run)
            for name, data in attachments.items():
                self._writer.add_attachment(now, now, name, "application/json", data)
            self._writer.flush()
            self._head = self._end = self._file.tell()
        except OSError as error:
            raise self._failure(error) from error

    @property
    def size(self) -> int:
        """Bytes of messages in the file."""
        return self._end - self._head

    def add(self, message: Logged) -> None:
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
        try:
            self._writer.add_message(channel, message.log_time, message.payload, message.publish_time, message.number)
            self.messages += 1
            self.pending += MESSAGE_SIZE + len(message.payload)
            if self.pending >= CHUNK_SIZE:
                self._flush()
        except OSError as error:
            raise self._failure(error) from error

    def _flush(self) -> None:
        self._writer.flush()
        self.pending, self._end = 0, self._file.tell()

    def flush_when_due(self, *, at_once: bool = False) -> None:
        now = time.monotonic()
        if now - self._flushed < FLUSH_SECONDS and not at_once:
            return
        try:
            self._flush()
            self._flushed = now
            if now - self._synced >= SYNC_SECONDS:
                self._synced = now
                self._check_that_it_is_there()
                os.fsync(self._file.fileno())
        except OSError as error:
            raise self._failure(error) from error

    def finish(self, end: dict[str, str]) -> None:
        try:
            self._flush()  # the messages first: where `end` can be read, nothing was cut before it
            self._writer.add_metadata("end", end)
            self._writer.finish()
            self._file.flush()
            self._check_that_it_is_there()
            os.fsync(self._file.fileno())
            self._file.close()
            if os.path.lexists(self._path) and not self._force:
                raise FileExistsError(errno.EEXIST, f"something else has this name by now; see {self._unfinished.name}")
            self._unfinished.replace(self._path)
        except OSError as error:
            raise self._failure(error) from error

    def close(self) -> None:
        if self._file.closed:
            return
        try:
            with self._file:
                self._writer.flush()
        except OSError as error:
            raise self._failure(error) from error

    def _check_that_it_is_there(self) -> None:
        """Raise OSError where somebody has removed the file or put another in its place: nobody would ever read it."""
        ours = os.fstat(self._file.fileno())
        there = os.stat(self._unfinished)
        if (there.st_dev, there.st_ino) != (ours.st_dev, ours.st_ino):
            raise OSError(errno.ESTALE, f"another file was put in the place of {self._unfinished.name}")

    def _failure(self, error: OSError) -> RecordingFailed:
        """Let go of the file, and see what is in it."""
        with suppress(OSError):  # what is left in memory cannot be written
            self._file.close()
        with suppress(OSError), self._unfinished.open("rb") as file:
            file.seek(self._end)
            chunk = file.read(_CHUNK_HEAD.size)
            if len(chunk) == _CHUNK_HEAD.size:
                _, length = _CHUNK_HEAD.unpack(chunk)
                if file.seek(0, os.SEEK_END) >= self._end + _CHUNK_HEAD.size + length:
                    self.pending = 0  # the chunk is whole, though its index is not
        return self._said(error)

    def _said(self, error: OSError) -> RecordingFailed:
        why = error.strerror
        if error.errno == errno.ENOENT:
            why = f"{self._unfinished.name if self._path.parent.is_dir() else 'its folder'} was removed"
        gone = error.errno in (errno.ENOENT, errno.ESTALE)
        return RecordingFailed(f"{self._path} could not be written: {why}", gone=gone)

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
