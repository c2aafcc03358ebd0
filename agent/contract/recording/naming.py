"""Which channels of a file are topics of a run, whatever a tool has put before their names, and which are others'."""

from __future__ import annotations

import re
from collections import defaultdict

from agent.contract.recording import records
from agent.contract.recording.records import Broken, Channel, Schema
from agent.contract.recording.survey import Survey

TOPIC = re.compile(r"(.*/)?(mode|plant/state|event|account|evidence|node/[^/]+/(?:measurement|estimate))", re.DOTALL)
ENCODINGS = ("json", "")  # of their messages
SCHEMAS = "peakmesh."  # what the names of our schemas begin with
_CHUNKS = 8  # looked into for channels where none is described outside chunks


class Naming:
    """The topics of a run under the names that they have in one file.

    All of them have the same prefix there, mostly none: that under which most topics of a run are. Where somebody
    else's channel has one of these names too, the schema tells; what is not JSON is somebody else's.
    """

    def __init__(self, survey: Survey) -> None:
        self._schemas = dict(survey.schemas)
        channels = survey.described or _packed_channels(survey, self._schemas)
        self._described: dict[int, Channel] = {}
        ambiguous = set()
        for channel in channels:
            if self._described.setdefault(channel.id, channel).topic != channel.topic:
                ambiguous.add(channel.id)  # files were joined
        for number in ambiguous:
            del self._described[number]
        under: defaultdict[str, set[tuple[bool, str]]] = defaultdict(set)
        for channel in channels:
            match = TOPIC.fullmatch(channel.topic)
            if match is not None and channel.encoding in ENCODINGS:
                under[match[1] or ""].add((self._is_named(channel), match[2]))
        weights = {prefix: (sum(named for named, _ in found), len(found)) for prefix, found in under.items()}
        self.prefix = min(weights, key=lambda prefix: (*(-weight for weight in weights[prefix]), prefix), default="")
        self._named = {self._topic(channel) for channel in channels if self._is_named(channel)}

    def topic(self, channel: Channel) -> str | None:
        """The topic of a run that a channel has; None where it is somebody else's."""
        topic = self._topic(channel)
        if topic is None or channel.encoding not in ENCODINGS:
            return None
        return topic if topic not in self._named or self._is_named(channel) else None

    def described(self, number: int) -> Channel | None:
        """The channel of this id by the file's index; None where it does not say, or has several."""
        return self._described.get(number)

    def learn(self, schema: Schema) -> None:
        """Enter a schema that stands in a chunk."""
        self._schemas[schema.id] = schema.name

    def _topic(self, channel: Channel) -> str | None:
        match = TOPIC.fullmatch(channel.topic)
        return match[2] if match is not None and (match[1] or "") == self.prefix else None

    def _is_named(self, channel: Channel) -> bool:
        return self._schemas.get(channel.schema, "").startswith(SCHEMAS)


def _packed_channels(survey: Survey, schemas: dict[int, str]) -> list[Channel]:
    """The channels in the first sound chunks; their schemas are entered."""
    found: list[Channel] = []
    chunks = 0
    for frame in survey.frames():
        if frame.opcode != records.CHUNK:
            continue
        chunks += 1
        try:
            for record in records.records_in(records.unpacked(records.chunk_of(survey.body(frame)))):
                if isinstance(record, Channel):
                    found.append(record)
                elif isinstance(record, Schema):
                    schemas[record.id] = record.name
        except Broken:
            continue
        if chunks == _CHUNKS:
            break
    return found
