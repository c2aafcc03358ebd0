"""The bytes of a recording, wherever they come from: a file, a pipe, or a compressor that was put around it.

What cannot be read twice goes through a temporary file, never through memory.
"""

from __future__ import annotations

import bz2
import gzip
import lzma
import shutil
import tempfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

import lz4.frame
import zstandard

from agent.contract.errors import InputError

BLOCK = 1 << 20  # bytes read at once

_COMPRESSORS: dict[bytes, tuple[str, Callable[[Any], Any]]] = {  # what a compressed file begins with
    b"\x1f\x8b": ("gzip", lambda file: gzip.GzipFile(fileobj=file)),
    b"\x28\xb5\x2f\xfd": (
        "zstd",
        lambda file: zstandard.ZstdDecompressor().stream_reader(file, read_across_frames=True),
    ),
    b"\x04\x22\x4d\x18": ("lz4", lz4.frame.LZ4FrameFile),
    b"\xfd7zXZ\x00": ("xz", lzma.LZMAFile),
    b"BZh": ("bzip2", bz2.BZ2File),
}
_BROKEN = (OSError, EOFError, zlib.error, zstandard.ZstdError, lzma.LZMAError, RuntimeError, ValueError)


class Source:
    """Random access to the bytes of one recording, read a block at a time.

    `notes` says what was taken off them, and `damage` what was wrong with that. `size` is that of the beginning: what
    a recorder appends meanwhile is not seen.
    """

    def __init__(self, path: Path, *, kind: str = "recording") -> None:
        """`kind` names what was expected there, for errors. Raises InputError where nothing can be read."""
        self.path = path
        self.notes: list[str] = []
        self.damage: list[str] = []
        self._file: IO[bytes]
        try:
            self._file = path.open("rb")
        except FileNotFoundError:
            raise InputError(f"{path} does not exist; a {kind} was expected there") from None
        except OSError as error:
            raise InputError(f"{path} could not be read as a {kind}: {error.strerror}") from error
        try:
            if not self._file.seekable():
                self._spool(self._file)
            self._unpack()
            self.size = self._file.seek(0, 2)
        except BaseException:
            self._file.close()
            raise
        self._at, self._buffer = 0, b""

    def read(self, start: int, count: int) -> bytes:
        """The bytes [start, start + count), fewer at the end of the file only."""
        first = start - self._at
        if first >= 0 and first + count <= len(self._buffer):
            return self._buffer[first : first + count]
        data = self._load(start, max(count, BLOCK))
        if count < BLOCK:
            self._at, self._buffer = start, data
        return data[:count]

    def _load(self, start: int, count: int) -> bytes:
        count = max(0, min(count, self.size - start))
        try:
            self._file.seek(start)
            data = self._file.read(count)
        except OSError as error:
            raise InputError(f"{self.path} could not be read on at byte {start}: {error.strerror}") from error
        if len(data) < count:
            raise InputError(f"{self.path} became shorter while it was read: it ends at byte {start + len(data)} now")
        return data

    def checksum(self, start: int, end: int) -> int:
        """CRC-32 of the bytes [start, end)."""
        crc = 0
        for at in range(start, end, BLOCK):
            crc = zlib.crc32(self._load(at, min(BLOCK, end - at)), crc)
        return crc

    def close(self) -> None:
        self._file.close()

    def _spool(self, stream: Any) -> None:
        """Go on with a temporary file that holds what `stream` gives."""
        spooled = tempfile.TemporaryFile()  # noqa: SIM115 - it is ours until `close`
        try:
            shutil.copyfileobj(stream, spooled, BLOCK)
        except BaseException:
            spooled.close()
            raise
        self._file.close()
        self._file = spooled

    def _unpack(self) -> None:
        """Take off compressors, one around the other."""
        while True:
            self._file.seek(0)
            beginning = self._file.read(8)
            self._file.seek(0)
            known = [kind for magic, kind in _COMPRESSORS.items() if beginning.startswith(magic)]
            if not known:
                return
            name, opened = known[0]
            packed = self._file
            unpacked = tempfile.TemporaryFile()  # noqa: SIM115
            try:
                with opened(packed) as stream:
                    while block := stream.read(BLOCK):
                        unpacked.write(block)
            except _BROKEN as error:
                if isinstance(error, OSError) and error.errno is not None:
                    unpacked.close()
                    raise InputError(f"{self.path} could not be unpacked from its {name}: {error.strerror}") from error
                self.damage.append(f"the {name} around it is cut or damaged")
            packed.close()
            self._file = unpacked
            self.notes.append(f"it is packed by {name}, and was read through that")
