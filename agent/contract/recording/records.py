"""The records of an MCAP file, taken from its bytes one by one, so that what is damaged costs no more than itself.

Every record is an opcode, a length and that many bytes (https://mcap.dev/spec). A reader that trusts the lengths is
lost after the first wrong one; here a record must also look like one of its kind, and after a stretch that is none the
next one is searched for.
"""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Callable, Iterator
from typing import NamedTuple

import lz4.frame
import zstandard

MAGIC = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX = 1, 2, 3, 4, 5, 6, 7
CHUNK_INDEX, ATTACHMENT, ATTACHMENT_INDEX, STATISTICS, METADATA = 8, 9, 10, 11, 12
METADATA_INDEX, SUMMARY_OFFSET, DATA_END = 13, 14, 15
PRIVATE = 0x80  # opcodes from here on are other people's

FRAME = struct.Struct("<BQ")
_HEAD = struct.Struct("<BQHIQQ")  # of a message: the frame, channel, sequence, log and publish time
MESSAGE_HEAD = _HEAD.size - FRAME.size
_CHUNK_HEAD = struct.Struct(
    "<QQQII"
)  # start and end time, uncompressed size, checksum, length of the compression's name
LARGEST_CHUNK = 1 << 30  # bytes unpacked; no writer makes larger ones, and a wrong number may ask for anything
_AT_ONCE = 1 << 26  # bytes that are unpacked into one buffer

# Where a record may begin: a known opcode, and a length below 4 GiB.
CANDIDATE = re.compile(rb"[\x01-\x0f](?=.{4}\x00{4})|\x89(?=MCAP0\r\n)", re.DOTALL)


class Broken(ValueError):
    """Bytes that are not what they claim to be; says what, for people."""


class Schema(NamedTuple):
    """A schema of the file, by its name."""

    id: int
    name: str


class Channel(NamedTuple):
    """A channel of the file."""

    id: int
    schema: int
    topic: str
    encoding: str


class Attached(NamedTuple):
    """An attachment: its bytes are [start, start + size) of the file; the body of its record begins at `record`."""

    name: str
    media_type: str
    record: int
    start: int
    size: int


class Chunk(NamedTuple):
    """A chunk, its records still packed."""

    start_time: int
    end_time: int
    size: int  # of its records, unpacked
    crc: int  # of its records, unpacked; 0 where it has none
    compression: str
    packed: bytes


class Body:
    """Reads a record's fields one after the other; Broken where they do not fit into it."""

    def __init__(self, data: bytes, at: int = 0) -> None:
        self._data, self.at = data, at

    def number(self, size: int) -> int:
        return int.from_bytes(self.take(size), "little")

    def take(self, size: int) -> bytes:
        self.at += size
        if self.at > len(self._data):
            raise Broken("a record is shorter than its fields")
        return self._data[self.at - size : self.at]

    def text(self) -> str:
        try:
            return self.take(self.number(4)).decode()
        except UnicodeDecodeError:
            raise Broken("a text is not UTF-8") from None

    def texts(self) -> dict[str, str]:
        end = self.number(4) + self.at
        found = {}
        while self.at < end:
            key = self.text()
            found[key] = self.text()
        if self.at != end:
            raise Broken("a table of texts is shorter than its entries")
        return found


def channel_of(body: bytes) -> Channel:
    """Raises Broken."""
    fields = Body(body)
    channel = Channel(fields.number(2), fields.number(2), fields.text(), fields.text())
    fields.texts()
    return channel


def schema_of(body: bytes) -> Schema:
    """Raises Broken."""
    fields = Body(body)
    schema = Schema(fields.number(2), fields.text())
    fields.text()
    fields.take(fields.number(4))
    return schema


def metadata_of(body: bytes) -> tuple[str, dict[str, str]]:
    """Raises Broken."""
    fields = Body(body)
    return fields.text(), fields.texts()


def attached_of(body: bytes, start: int) -> Attached:
    """An attachment by the beginning of its record, whose body starts at `start`. Raises Broken."""
    fields = Body(body)
    fields.take(16)
    name, media_type, size = fields.text(), fields.text(), fields.number(8)
    return Attached(name, media_type, start, start + fields.at, size)


def chunk_of(body: bytes) -> Chunk:
    """Raises Broken."""
    fields = Body(body)
    start, end, size, crc, _ = _CHUNK_HEAD.unpack(fields.take(_CHUNK_HEAD.size))
    fields.at -= 4
    compression = fields.text()
    return Chunk(start, end, size, crc, compression, fields.take(fields.number(8)))


def unpacked(chunk: Chunk) -> bytes:
    """The records of a chunk. Raises Broken where it is damaged."""
    if chunk.size > LARGEST_CHUNK:
        raise Broken(f"claims to hold {chunk.size} bytes")
    unpack = _UNPACK.get(chunk.compression)
    if unpack is None:
        raise Broken(f'is packed by "{chunk.compression[:20]}", which is not known')
    try:
        records = unpack(chunk)
    except (zstandard.ZstdError, RuntimeError, MemoryError, ValueError):  # RuntimeError: lz4
        raise Broken("cannot be unpacked") from None
    if len(records) != chunk.size:
        raise Broken("cannot be unpacked")
    if chunk.crc and zlib.crc32(records) != chunk.crc:
        raise Broken("does not fit its checksum")
    return records


def _zstd(chunk: Chunk) -> bytes:
    stated = zstandard.frame_content_size(chunk.packed)  # -1 where the frame does not say
    if stated not in (-1, chunk.size):
        raise ValueError
    if chunk.size <= _AT_ONCE:
        return zstandard.ZstdDecompressor().decompress(chunk.packed, max_output_size=chunk.size)
    parts, total = [], 0  # in parts: what is claimed is not believed before it is there
    for part in zstandard.ZstdDecompressor().read_to_iter(chunk.packed):
        total += len(part)
        if total > chunk.size:
            raise ValueError
        parts.append(part)
    return b"".join(parts)


def _lz4(chunk: Chunk) -> bytes:
    return bytes(lz4.frame.LZ4FrameDecompressor().decompress(chunk.packed, max_length=chunk.size + 1))


_UNPACK: dict[str, Callable[[Chunk], bytes]] = {"": lambda chunk: chunk.packed, "zstd": _zstd, "lz4": _lz4}


# A message as it stands in the file: channel, sequence, log and publish time in ns, and payload. No class, for speed.
RawMessage = tuple[int, int, int, int, bytes]


def records_in(data: bytes) -> Iterator[RawMessage | Channel | Schema]:
    """Messages, channels and schemas of an unpacked chunk, the messages as plain tuples. Raises Broken."""
    at, end, unpack = 0, len(data), _HEAD.unpack_from
    while at < end:
        if end - at < FRAME.size:
            raise Broken("ends in the middle of a record")
        if data[at] == MESSAGE and end - at >= _HEAD.size:
            _, length, channel, sequence, log_time, publish_time = unpack(data, at)
            body = at + FRAME.size
            at = body + length
            if at > end or length < MESSAGE_HEAD:
                raise Broken("ends in the middle of a record")
            yield channel, sequence, log_time, publish_time, data[body + MESSAGE_HEAD : at]
            continue
        opcode, length = FRAME.unpack_from(data, at)
        body = at + FRAME.size
        at = body + length
        if at > end:
            raise Broken("ends in the middle of a record")
        if opcode == CHANNEL:
            yield channel_of(data[body:at])
        elif opcode == SCHEMA:
            yield schema_of(data[body:at])


def message_of(body: bytes) -> RawMessage:
    """A message outside chunks; its body is at least MESSAGE_HEAD long."""
    channel, sequence, log_time, publish_time = _BODY_HEAD.unpack_from(body)
    return channel, sequence, log_time, publish_time, body[MESSAGE_HEAD:]


_BODY_HEAD = struct.Struct("<HIQQ")


def looks_like(opcode: int, length: int, body: Callable[[int], bytes], known: set[int]) -> bool:
    """Whether a record has the structure of its kind. `body(n)` gives its first n bytes; `known`: ids of channels.

    Of records that may be of any content, such as messages, this is little.
    """
    fixed = _FIXED.get(opcode)
    if fixed is not None:
        return length == fixed
    if opcode == MESSAGE:
        return length >= MESSAGE_HEAD and (not known or int.from_bytes(body(2), "little") in known)
    if opcode == MESSAGE_INDEX:
        return length >= 6 and length == 6 + int.from_bytes(body(6)[2:], "little")
    if opcode in _LEAST:
        return length >= _LEAST[opcode]
    try:
        return _ends_with(opcode, length, body) == length
    except (Broken, struct.error):
        return False


_FIXED = {FOOTER: 20, DATA_END: 4, SUMMARY_OFFSET: 17}
_LEAST = {CHUNK_INDEX: 64, ATTACHMENT_INDEX: 48, STATISTICS: 46, METADATA_INDEX: 20}  # in the index alone
SHAPELESS = {MESSAGE, *_FIXED, *_LEAST}  # of these little more than the length is checked
_TEXTS = 1 << 16  # bytes in which names are expected
_LARGEST = 1 << 26  # bytes of metadata, a channel or a schema


def _ends_with(opcode: int, length: int, body: Callable[[int], bytes]) -> int:
    """Where the fields of a record end."""
    if opcode == ATTACHMENT:
        attached = attached_of(body(min(length, _TEXTS)), 0)
        return attached.start + attached.size + 4
    if opcode == CHUNK:
        fields = Body(body(min(length, _CHUNK_HEAD.size + 32)))
        fields.take(_CHUNK_HEAD.size - 4)
        if not fields.text().isprintable():
            return -1
        return fields.number(8) + fields.at
    if length > _LARGEST:
        return -1
    fields = Body(body(length))
    if opcode == HEADER:
        fields.text(), fields.text()
    elif opcode == METADATA:
        fields.text(), fields.texts()
    elif opcode == CHANNEL:
        fields.take(4), fields.text(), fields.text(), fields.texts()
    elif opcode == SCHEMA:
        fields.take(2), fields.text(), fields.text(), fields.take(fields.number(4))
    else:
        return -1
    return fields.at
