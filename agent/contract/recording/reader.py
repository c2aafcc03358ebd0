"""Reads a run back, whole or cut: as far as the file is sound, and never anything that was not written."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import IO, Self

import zstandard
from mcap.exceptions import EndOfFile, InvalidMagic, McapError
from mcap.records import Attachment, Channel, Chunk, McapRecord, Metadata
from mcap.records import Message as McapMessage
from mcap.stream_reader import StreamReader, breakup_chunk

from agent.contract.errors import InputError
from agent.contract.gains import Gains
from agent.contract.recording import FORMAT, VERSION, Logged

# A damaged length asks for more memory than there is, or than a machine can count.
_DAMAGE = (McapError, struct.error, ValueError, zstandard.ZstdError, KeyError, EOFError, MemoryError, OverflowError)


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


def _why(error: Exception) -> str:
    text = str(error).rstrip(".")
    if isinstance(error, EndOfFile | struct.error):
        return "the file ends in the middle of a record"
    if isinstance(error, MemoryError | OverflowError):
        return "a record claims to be larger than memory"
    return f"{type(error).__name__}: {text}"
