"""One walk over the frames of a recording, before any message is read: what it holds, where, and what is broken.

Chunks stay packed, so this takes little time. Metadata and attachments are found wherever a tool has put them, and a
stretch that is no record is named and passed over.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

from agent.contract.errors import InputError, counted
from agent.contract.recording import records
from agent.contract.recording.records import FRAME, MAGIC, Attached, Channel
from agent.contract.recording.source import BLOCK, Source

_LOOSE = {records.MESSAGE, records.CHANNEL, records.SCHEMA}  # what stands in chunks, or outside


class Stretch(NamedTuple):
    """The bytes [start, end) of a file."""

    start: int
    end: int


class Frame(NamedTuple):
    """A record whose body is [start, start + length); opcode 0 stands for the beginning or the end of a file."""

    opcode: int
    start: int
    length: int


@dataclass
class Survey:
    """What a file holds. Stretches are sound, and together hold every record that is."""

    source: Source
    library: str = ""  # what wrote it last, by its own word
    metadata: list[tuple[str, dict[str, str]]] = field(default_factory=list)
    attachments: list[Attached] = field(default_factory=list)
    described: list[Channel] = field(default_factory=list)  # channels outside chunks, those of the index too
    schemas: dict[int, str] = field(default_factory=dict)  # the same for schemas
    stretches: list[Stretch] = field(default_factory=list)
    chunks: int = 0
    loose: int = 0  # messages outside chunks
    damage: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)  # what is odd, and harms nothing
    is_cut: bool = False
    is_covered: bool = False  # a checksum over everything is there, and fits
    is_contradicted: bool = False  # it is there, and does not fit

    @property
    def has_loose(self) -> bool:
        """Messages outside chunks count: in a damaged file that has chunks they are other records, damaged."""
        return self.loose > 0 and not (self.chunks and self.is_contradicted)

    def frames(self) -> Iterator[Frame]:
        """Every record of the sound stretches, in the order of the file."""
        for stretch in self.stretches:
            at = stretch.start
            while at + FRAME.size <= stretch.end:
                head = self.source.read(at, FRAME.size)
                if head.startswith(MAGIC):
                    yield Frame(0, at, len(MAGIC))
                    at += len(MAGIC)
                else:
                    opcode, length = FRAME.unpack(head)
                    yield Frame(opcode, at + FRAME.size, length)
                    at += FRAME.size + length

    def body(self, frame: Frame) -> bytes:
        """The bytes of a record."""
        return self.source.read(frame.start, frame.length)


def survey(source: Source) -> Survey:
    """Raises InputError where the file is no MCAP file at all."""
    found = Survey(source, damage=list(source.damage), notes=list(source.notes))
    if not source.size:
        raise InputError(f"{source.path} is empty; a recording was expected there")
    magic = source.read(0, len(MAGIC))
    if magic != MAGIC and magic[:5] == MAGIC[:5] and magic[6:] == MAGIC[6:]:
        raise InputError(f"{source.path} is an MCAP file of version {chr(magic[5])}; this peakmesh reads version 0")
    if magic != MAGIC and source.read(len(MAGIC), FRAME.size)[:1] != bytes([records.HEADER]):
        raise InputError(f"{source.path} is not a recording: it is not an MCAP file")
    _Walk(found).run()
    return found


class _Walk:
    """The state of the walk: where it is, and in what part of the file."""

    def __init__(self, found: Survey) -> None:
        self._found, self._source, self._size = found, found.source, found.source.size
        self._at = 0
        self._sound = 0  # where the present sound stretch began
        self._begun = 0  # where the present MCAP file began; there are several where files were joined
        self._closed = False  # the footer was read
        self._in_data = True  # before its data end
        self._after_damage = self._chunked = False
        self._last = (0, 0)  # the last record: opcode and place
        self._known: set[int] = set()  # ids of channels
        self._checksums: list[tuple[int, int, int]] = []  # start and end of what they cover, and they

    def run(self) -> None:
        if self._source.read(0, len(MAGIC)) != MAGIC:
            self._found.damage.append("its first bytes are not those of an MCAP file")
            self._at = self._sound = len(MAGIC)
        while self._at < self._size:
            frame = self._source.read(self._at, FRAME.size)
            if frame.startswith(MAGIC):
                self._pass_magic()
            elif self._closed:
                if self._last[0] == records.FOOTER and MAGIC.startswith(frame):
                    break
                self._after_the_end()
            elif not self._record():
                self._search()
        if not self._closed or self._last[0] == records.FOOTER:
            self._cut()
        self._end_stretch(self._at)
        self._check()

    def _pass_magic(self) -> None:
        """The last word of a file, or the first of another one that was joined to it."""
        found, begins = self._found, self._frame(self._at + len(MAGIC))[0] == records.HEADER
        if self._at and begins:
            word = "after" if self._closed else "before"
            sentence = f"another MCAP file begins at byte {self._at}, {word} the end of the one before it"
            (found.notes if self._closed else found.damage).append(sentence)
            self._begun, self._closed, self._in_data = self._at, False, True
            self._known.clear()
        elif self._at:
            self._closed = True
        self._last = (0, self._at)
        self._at += len(MAGIC)

    def _after_the_end(self) -> None:
        """What stands behind the last word of a file: another one, or nothing of use."""
        rest = self._source.read(self._at, BLOCK)
        next_file = rest.find(MAGIC)
        end = self._size if next_file < 0 else self._at + next_file
        rest = rest[: end - self._at]
        kind = "zeros" if not rest.strip(b"\0") else "line ends" if not rest.strip() else "something else"
        self._found.notes.append(
            f"after its end it goes on for {counted(end - self._at, 'byte')} ({kind}), which are left alone"
        )
        self._end_stretch(self._at)
        self._last = (0, self._at)
        self._at = self._sound = end

    def _record(self) -> bool:
        """Take in the record at this place; False where there is none."""
        opcode, length = self._frame(self._at)
        if opcode == 0 or not self._is_record(self._at, opcode, length):
            return False
        start = self._at + FRAME.size
        if self._after_damage and opcode in _LOOSE and self._chunked:
            self._at = start + length  # what is left of a chunk whose frame is gone: no checksum vouches for it
            self._sound = self._at
            return True
        self._after_damage = False
        self._take(opcode, start, length)
        self._last = (opcode, self._at)
        self._at = start + length
        return True

    def _frame(self, at: int) -> tuple[int, int]:
        frame = self._source.read(at, FRAME.size)
        if len(frame) < FRAME.size:
            return 0, 0
        opcode, length = FRAME.unpack(frame)
        return opcode, length

    def _is_record(self, at: int, opcode: int, length: int) -> bool:
        start = at + FRAME.size
        if start + length > self._size:
            return False
        if opcode > records.DATA_END:  # other people's, or a chunk whose first byte is damaged
            return opcode >= records.PRIVATE and not self._has_structure(records.CHUNK, start, length)
        if opcode == records.MESSAGE and self._chunked and self._has_structure(records.MESSAGE_INDEX, start, length):
            return False
        return self._has_structure(opcode, start, length)

    def _has_structure(self, opcode: int, start: int, length: int) -> bool:
        return records.looks_like(opcode, length, lambda count: self._source.read(start, count), self._known)

    def _take(self, opcode: int, start: int, length: int) -> None:
        found = self._found
        if opcode == records.MESSAGE:
            found.loose += 1
        elif opcode == records.CHUNK:
            found.chunks += 1
            self._chunked = True
        elif opcode == records.FOOTER:
            self._closed = True
        elif opcode == records.ATTACHMENT:
            found.attachments.append(records.attached_of(self._source.read(start, min(length, BLOCK)), start))
        elif opcode in (records.CHANNEL, records.SCHEMA, records.METADATA, records.HEADER, records.DATA_END):
            self._take_small(opcode, self._source.read(start, length))

    def _take_small(self, opcode: int, body: bytes) -> None:
        found = self._found
        if opcode == records.CHANNEL:
            channel = records.channel_of(body)
            found.described.append(channel)
            self._known.add(channel.id)
        elif opcode == records.SCHEMA:
            schema = records.schema_of(body)
            found.schemas[schema.id] = schema.name
        elif opcode == records.METADATA:
            if self._in_data:
                found.metadata.append(records.metadata_of(body))
        elif opcode == records.HEADER:
            fields = records.Body(body)
            fields.text()
            found.library = fields.text()
        else:
            self._in_data = False
            crc = int.from_bytes(body, "little")
            if crc:
                self._checksums.append((self._begun, self._at, crc))

    def _search(self) -> None:
        """Name the stretch that is no record, and go on after it.

        The record before it is doubtful too where its content cannot be told from anything else.
        """
        start = self._last[1] if self._last[0] in records.SHAPELESS else self._at
        self._found.loose -= self._last[0] == records.MESSAGE
        self._chunked |= self._frame(self._at)[0] == records.CHUNK
        found = next(self._candidates(start + 1), None)
        end = self._size if found is None else found
        self._end_stretch(start)
        if found is None and self._is_end():
            self._at = self._sound = self._size
            return
        if self._in_data:
            what = "zeros" if self._is_zero(self._at, end) else "no records"
            self._found.damage.append(f"{counted(end - start, 'byte')} from byte {start} on are {what}")
        else:
            self._found.notes.append(f"its index is damaged at byte {start}; the messages are not in it")
        self._after_damage = True
        self._last = (0, end)
        self._at = self._sound = end
        if found is None:
            self._closed = self._closed or not self._in_data

    def _is_end(self) -> bool:
        """The file ends within the record that begins here."""
        opcode, length = self._frame(self._at)
        left = self._size - self._at
        return left < FRAME.size or (0 < opcode <= records.DATA_END and FRAME.size + length > left)

    def _is_zero(self, start: int, end: int) -> bool:
        return all(not self._source.read(at, min(BLOCK, end - at)).strip(b"\0") for at in range(start, end, BLOCK))

    def _candidates(self, start: int) -> Iterator[int]:
        """Where records that look like what they claim begin, from `start` on."""
        overlap = FRAME.size - 1
        for at in range(start, self._size, BLOCK - overlap):
            for match in records.CANDIDATE.finditer(self._source.read(at, BLOCK)):
                place = at + match.start()
                if match[0] == MAGIC[:1] or self._is_trusted(place):
                    yield place

    def _is_trusted(self, at: int) -> bool:
        """It is a record, and what follows is one, or the end."""
        opcode, length = self._frame(at)
        if opcode == records.MESSAGE and not self._known:
            return False
        if not self._is_record(at, opcode, length):
            return False
        after = at + FRAME.size + length
        if after == self._size or self._source.read(after, len(MAGIC)) == MAGIC:
            return True
        opcode, length = self._frame(after)
        return opcode != 0 and self._is_record(after, opcode, length)

    def _cut(self) -> None:
        self._found.is_cut = True
        if self._in_data:
            self._found.damage.append("it is cut or damaged: the file ends in the middle of a record")
        else:
            self._found.damage.append("it is cut or damaged: the file ends in its index, after the last message")

    def _end_stretch(self, end: int) -> None:
        if end > self._sound:
            self._found.stretches.append(Stretch(self._sound, end))

    def _check(self) -> None:
        """Hold the data sections against their checksums."""
        fits = [self._source.checksum(start, end) == crc for start, end, crc in self._checksums]
        self._found.is_covered = bool(fits) and all(fits)
        self._found.is_contradicted = not all(fits)
