"""Writes an MCAP of messages that are computed from a recording: a layer, to be opened above it or merged with it.

It is no recording of a run: it has no metadata `run`, and topics of its own.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from mcap.writer import CompressionType, Writer

from agent.contract.files import canonical, writing_whole


class LayerWriter:
    """Takes the messages of an open layer."""

    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._channels: dict[str, int] = {}
        self._numbers: dict[str, int] = {}

    def topic(self, topic: str, schema_name: str, schema: Mapping[str, Any]) -> None:
        """Declare a topic, before its first message; topics may share a schema by its name."""
        number = self._writer.register_schema(schema_name, "jsonschema", json.dumps(schema).encode())
        self._channels[topic] = self._writer.register_channel(topic, "json", number)
        self._numbers[topic] = 0

    def add(self, topic: str, time: int, message: Mapping[str, Any]) -> None:
        """A message of a declared topic, at `time` in ns since the epoch. It must not hold NaN or infinity."""
        number = self._numbers[topic]
        self._numbers[topic] += 1
        data = json.dumps(message, separators=(",", ":"), allow_nan=False).encode()
        self._writer.add_message(self._channels[topic], time, data, time, number)


@contextmanager
def writing_layer(
    path: Path, name: str, facts: Mapping[str, str], attachments: Mapping[str, Any], *, time: int, force: bool
) -> Iterator[LayerWriter]:
    """An open layer, whole at the end of the block or not there; `facts` become its metadata `name`.

    Attachments are JSON documents under their names, of the time `time`, in ns. Raises InputError where `path` cannot
    be written.
    """
    with writing_whole(path, force=force) as part, part.open("wb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD, enable_data_crcs=True)
        writer.start(profile="", library="peakmesh")
        writer.add_metadata(name, dict(facts))
        for title, document in attachments.items():
            writer.add_attachment(time, time, title, "application/json", canonical(document))
        yield LayerWriter(writer)
        writer.finish()
