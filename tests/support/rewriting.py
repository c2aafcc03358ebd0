"""What other tools do to recordings, honestly: read by the mcap library's reader, changed, written by its writer.

A rewrite takes `Contents` and gives `Contents`; a `Style` is how a tool lays them out in a file.
"""

from __future__ import annotations

import itertools
import json
import random
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple

from mcap.records import Attachment, Channel, Message, Metadata, Schema
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, IndexType, Writer

COMPRESSIONS = (CompressionType.ZSTD, CompressionType.LZ4, CompressionType.NONE)


class Item(NamedTuple):
    """A message. `copy` tells channels of the same topic apart."""

    topic: str
    payload: bytes
    sequence: int
    log_time: int
    publish_time: int
    schema: str = "peakmesh.Message"
    encoding: str = "json"
    copy: int = 0


@dataclass(frozen=True)
class Contents:
    """What is in a file, in the order of the file."""

    metadata: tuple[tuple[str, dict[str, str]], ...]
    attachments: tuple[tuple[str, bytes], ...]
    items: tuple[Item, ...]

    def with_items(self, items: Iterable[Item]) -> Contents:
        return replace(self, items=tuple(items))


@dataclass(frozen=True)
class Style:
    """How a tool writes a file. `order` is that of metadata `run`, attachments, messages, metadata `end`."""

    order: tuple[str, ...] = ("run", "attachments", "items", "end")
    chunk_size: int | None = 4096  # bytes; None: messages stand outside chunks
    compression: CompressionType = CompressionType.ZSTD
    crcs: bool = True
    data_crcs: bool = True
    index: IndexType = IndexType.ALL
    repeat: bool = True  # channels and schemas, in the index
    prefix: str = ""  # before the topics
    first_id: int = 0  # channels used up before ours


def read(path: Path) -> Contents:
    """A file by the mcap library's own reader."""
    metadata, attachments, items = [], [], []
    channels: dict[int, Channel] = {}
    schemas: dict[int, Schema] = {}
    with path.open("rb") as file:
        for record in StreamReader(file, validate_crcs=True).records:
            match record:
                case Metadata():
                    metadata.append((record.name, dict(record.metadata)))
                case Attachment():
                    attachments.append((record.name, record.data))
                case Schema():
                    schemas[record.id] = record
                case Channel():
                    channels[record.id] = record
                case Message():
                    channel = channels[record.channel_id]
                    items.append(
                        Item(
                            channel.topic,
                            record.data,
                            record.sequence,
                            record.log_time,
                            record.publish_time,
                            schemas[channel.schema_id].name,
                        )
                    )
    return Contents(tuple(metadata), tuple(attachments), tuple(items))


def write(path: Path, contents: Contents, style: Style = Style()) -> Path:
    """Write a file by the mcap library's own writer."""
    with path.open("wb") as file:
        writer = Writer(
            file,
            chunk_size=style.chunk_size or 1,
            use_chunking=style.chunk_size is not None,
            compression=style.compression,
            enable_crcs=style.crcs,
            enable_data_crcs=style.data_crcs,
            index_types=style.index,
            repeat_channels=style.repeat,
            repeat_schemas=style.repeat,
        )
        writer.start(library="rewriter")
        _Filling(writer, contents, style).fill()
        writer.finish()
    return path


class _Filling:
    """Writes contents in the order of a style."""

    def __init__(self, writer: Writer, contents: Contents, style: Style) -> None:
        self._writer, self._contents, self._style = writer, contents, style
        self._channels: dict[tuple[str, str, str, int], int] = {}
        self._schemas: dict[str, int] = {}

    def fill(self) -> None:
        for number in range(self._style.first_id):
            self._writer.register_channel(f"unused/{number}", "json", self._schema("unused"))
        for kind in self._style.order:
            if kind == "items":
                self._items()
            elif kind == "attachments":
                for name, data in self._contents.attachments:
                    self._writer.add_attachment(0, 0, name, "application/json", data)
            else:
                for name, facts in self._contents.metadata:
                    if (name == "end") == (kind == "end"):
                        self._writer.add_metadata(name, facts)

    def _items(self) -> None:
        for item in self._contents.items:
            key = (item.topic, item.schema, item.encoding, item.copy)
            if key not in self._channels:
                topic = item.topic if item.topic.startswith("/") else self._style.prefix + item.topic
                self._channels[key] = self._writer.register_channel(topic, item.encoding, self._schema(item.schema))
            self._writer.add_message(self._channels[key], item.log_time, item.payload, item.publish_time, item.sequence)

    def _schema(self, name: str) -> int:
        if name not in self._schemas:
            self._schemas[name] = self._writer.register_schema(name, "jsonschema", b"{}")
        return self._schemas[name]


def any_style(chance: random.Random) -> Style:
    """A style that some tool has."""
    order = ["run", "attachments", "items", "end"]
    chance.shuffle(order)
    return Style(
        order=tuple(order),
        chunk_size=chance.choice([None, 300, 4096, 1 << 20]),
        compression=chance.choice(COMPRESSIONS),
        crcs=chance.random() < 0.8,
        data_crcs=chance.random() < 0.5,
        index=chance.choice([IndexType.ALL, IndexType.NONE, IndexType.CHUNK]),
        repeat=chance.random() < 0.7,
        prefix=chance.choice(["", "", "/", "robot/net/"]),
        first_id=chance.choice([0, 0, 3, 17]),
    )


# rewrites that leave nothing out
Rewrite = Callable[[Contents, random.Random], Contents]


def by_time(contents: Contents, chance: random.Random) -> Contents:
    return contents.with_items(sorted(contents.items, key=lambda item: item.log_time))


def by_topic(contents: Contents, chance: random.Random) -> Contents:
    return contents.with_items(sorted(contents.items, key=lambda item: (item.topic, item.log_time)))


def shuffled(contents: Contents, chance: random.Random) -> Contents:
    return contents.with_items(chance.sample(contents.items, len(contents.items)))


def numbered_through(contents: Contents, chance: random.Random) -> Contents:
    """One sequence for the whole file."""
    return contents.with_items(item._replace(sequence=at) for at, item in enumerate(contents.items))


def numbered_by_topic(contents: Contents, chance: random.Random) -> Contents:
    counts: dict[str, int] = {}
    items = []
    for item in contents.items:
        counts[item.topic] = counts.get(item.topic, -1) + 1
        items.append(item._replace(sequence=counts[item.topic]))
    return contents.with_items(items)


def not_numbered(contents: Contents, chance: random.Random) -> Contents:
    return contents.with_items(item._replace(sequence=0) for item in contents.items)


def channels_split(contents: Contents, chance: random.Random) -> Contents:
    """Several channels for one topic, as from several connections."""
    return contents.with_items(item._replace(copy=chance.randrange(3)) for item in contents.items)


def merged_with_itself(contents: Contents, chance: random.Random) -> Contents:
    again = [item._replace(copy=item.copy + 7) for item in contents.items]
    merged = sorted([*contents.items, *again], key=lambda item: item.log_time)
    return Contents(contents.metadata * 2, contents.attachments * 2, tuple(merged))


def with_strangers(contents: Contents, chance: random.Random) -> Contents:
    """Merged with a file of somebody else, who has an attachment and metadata of the same names too."""
    times = [item.log_time for item in contents.items] or [0]
    strangers = [
        Item("/imu", bytes([at]), at, chance.choice(times), 0, schema="sensor_msgs/Imu", encoding="cdr")
        for at in range(9)
    ]
    strangers.append(Item("/camera/mode", b"\x00\x01", 0, times[0], 0, schema="std_msgs/String", encoding="cdr"))
    return Contents(
        (("run", {"experiment": "17"}), ("rosbag2", {"version": "9"}), *contents.metadata),
        (("gains.json", b'{"kp": 1.0}'), ("photo.jpg", b"\xff\xd8"), *contents.attachments),
        tuple(sorted([*contents.items, *strangers], key=lambda item: item.log_time)),
    )


def joined_again(contents: Contents, chance: random.Random) -> Contents:
    """Split by time into parts, each with all metadata and attachments, and merged again."""
    return merged(split_by_time(contents, chance.randint(2, 4)), chance)


WHOLE: tuple[Rewrite, ...] = (
    by_time,
    by_topic,
    shuffled,
    numbered_through,
    numbered_by_topic,
    not_numbered,
    channels_split,
    merged_with_itself,
    with_strangers,
    joined_again,
)


# rewrites that leave something out
def filtered_by_topic(contents: Contents, chance: random.Random) -> Contents:
    topics = sorted({item.topic for item in contents.items})
    gone = set(chance.sample(topics, chance.randint(1, max(1, len(topics) // 2)))) if topics else set()
    return contents.with_items(item for item in contents.items if item.topic not in gone)


def filtered_by_node(contents: Contents, chance: random.Random) -> Contents:
    nodes = sorted({item.topic.split("/")[1] for item in contents.items if item.topic.startswith("node/")})
    gone = f"node/{chance.choice(nodes)}/" if nodes else "none"
    return contents.with_items(item for item in contents.items if not item.topic.startswith(gone))


def without_events(contents: Contents, chance: random.Random) -> Contents:
    return contents.with_items(item for item in contents.items if item.topic != "event")


def filtered_by_time(contents: Contents, chance: random.Random) -> Contents:
    """From somewhere to somewhere."""
    times = sorted(item.log_time for item in contents.items) or [0]
    first, last = sorted(chance.choices(times, k=2))
    return contents.with_items(item for item in contents.items if first <= item.log_time <= last)


def first_half(contents: Contents, chance: random.Random) -> Contents:
    """Of the file, in its order."""
    return contents.with_items(contents.items[: len(contents.items) // 2])


def second_half(contents: Contents, chance: random.Random) -> Contents:
    return contents.with_items(contents.items[len(contents.items) // 2 :])


def joined_without_a_part(contents: Contents, chance: random.Random) -> Contents:
    parts = split_by_time(contents, chance.randint(3, 5))
    parts.pop(chance.randrange(len(parts)))
    return merged(parts, chance)


def thinned(contents: Contents, chance: random.Random) -> Contents:
    """Every second or third message of some topics."""
    topics = sorted({item.topic for item in contents.items})
    some = set(chance.sample(topics, chance.randint(1, max(1, len(topics) // 2)))) if topics else set()
    every, counts = chance.randint(2, 3), dict.fromkeys(topics, -1)
    kept = []
    for item in contents.items:
        counts[item.topic] += 1
        if item.topic not in some or counts[item.topic] % every == 0:
            kept.append(item)
    return contents.with_items(kept)


def without_the_end(contents: Contents, chance: random.Random) -> Contents:
    return replace(contents, metadata=tuple(record for record in contents.metadata if record[0] != "end"))


PARTIAL: tuple[Rewrite, ...] = (
    filtered_by_topic,
    filtered_by_node,
    without_events,
    filtered_by_time,
    first_half,
    second_half,
    joined_without_a_part,
    thinned,
    without_the_end,
)


def split_by_time(contents: Contents, parts: int) -> list[Contents]:
    """Parts of about equal numbers of messages."""
    items = sorted(contents.items, key=lambda item: item.log_time)
    edges = [len(items) * part // parts for part in range(parts + 1)]
    return [contents.with_items(items[first:end]) for first, end in itertools.pairwise(edges)]


def merged(parts: Sequence[Contents], chance: random.Random) -> Contents:
    """By time, metadata and attachments of all of them."""
    items = [item for part in parts for item in part.items]
    return Contents(
        tuple(record for part in parts for record in part.metadata),
        tuple(attached for part in parts for attached in part.attachments),
        tuple(sorted(items, key=lambda item: item.log_time)),
    )


def rewritten(contents: Contents, rewrites: Iterable[Rewrite], chance: random.Random) -> Contents:
    for rewrite in rewrites:
        contents = rewrite(contents, chance)
    return contents


def drained(sent: Sequence[Any], *, ahead: int = 6, pause: int = 1_000_000) -> list[tuple[Any, int]]:
    """Messages of `simulate` with the log times that a recorder gives them.

    It empties one topic after the other every `pause` ns, and modes and states run `ahead` of estimates.
    """
    order = {"mode": 0, "plant/state": 1, "event": 2}
    first = sent[0]
    timed = []
    for message in sent:
        step, kind = message.document["step"], message.topic.rpartition("/")[2]
        if message.topic == "event":
            round_ = 0 if message is first else max(m.document["step"] for m in sent) + ahead + 2
        else:
            lag = {"mode": 0, "state": 0, "measurement": ahead // 2, "estimate": ahead}[kind]
            round_ = (step + lag) // 3
        place = order.get(message.topic, 3 + sum(map(ord, message.topic)) % 50 + 50 * (kind == "estimate"))
        timed.append((message, (round_ + 1) * pause + place * 2000 + step))
    return sorted(timed, key=lambda pair: pair[1])


def nanoseconds(time: str) -> int:
    """An ISO time, in ns since the epoch."""
    return round(datetime.fromisoformat(time).timestamp()) * 10**9


def moved(contents: Contents, *, node: str, step: int, by: float = 1e-6) -> Contents:
    """No honest rewrite: one estimate is another one, in every copy of it."""
    items = []
    for item in contents.items:
        if item.topic == f"node/{node}/estimate":
            document = json.loads(item.payload)
            if document["step"] == step:
                document["x_hat"][0] += by
                item = item._replace(payload=json.dumps(document).encode())
        items.append(item)
    return contents.with_items(items)
