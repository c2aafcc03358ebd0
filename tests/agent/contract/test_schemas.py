"""Somebody else's validator reads the schemas of a recording, and finds every message of it to be what they say."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from jsonschema import Draft202012Validator
from mcap.reader import make_reader
from places import GOLDEN

RECORDINGS = sorted(GOLDEN.glob("*.mcap"))


def read(path: Path) -> list[tuple[str, dict[str, Any], dict[str, Any]]]:
    """Topic, schema and message of all that is in a recording."""
    with path.open("rb") as file:
        return [
            (channel.topic, json.loads(schema.data), json.loads(message.data))
            for schema, channel, message in make_reader(file).iter_messages()
            if schema is not None
        ]


def test_both_examples_are_there() -> None:
    assert [path.name for path in RECORDINGS] == ["zhu2020-ideal.mcap", "zhu2020-lossy.mcap"]
    assert sum(path.stat().st_size for path in GOLDEN.iterdir()) < 1_000_000


@pytest.mark.parametrize("path", RECORDINGS, ids=lambda path: path.stem)
def test_every_message_is_what_its_schema_says(path: Path) -> None:
    found = read(path)
    assert len([topic for topic, _, _ in found if topic != "evidence"]) == 602
    assert len(found) > 602  # evidence is told as time goes by
    for schema in {json.dumps(schema): schema for _, schema, _ in found}.values():
        Draft202012Validator.check_schema(schema)
    for topic, schema, message in found:
        assert list(Draft202012Validator(schema).iter_errors(message)) == [], topic


@pytest.mark.parametrize(
    ("topic", "change"),
    [
        ("mode", {"index": "3"}),
        ("mode", {"step": -1}),
        ("mode", {"phase": 1}),
        ("plant/state", {"arrived": [0.5]}),
        ("node/1/measurement", {"y": 0.1}),
        ("node/1/estimate", {"x_hat": [None, 1.0]}),
        ("node/1/estimate", {"heard": [1]}),
        ("event", {"kind": None}),
    ],
)
def test_what_is_no_message_is_found(topic: str, change: dict[str, Any]) -> None:
    schema, message = next((schema, message) for at, schema, message in read(RECORDINGS[0]) if at == topic)
    assert len(list(Draft202012Validator(schema).iter_errors(message | change))) == 1
