"""Keys, topics and the table that documents them are one."""

from __future__ import annotations

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st
from places import ROOT

from agent.contract import keys
from agent.contract.gains import Gains
from agent.contract.keys import (
    ACCOUNT,
    ACKNOWLEDGED,
    CONTROL,
    COORDINATOR,
    EVENT,
    EVIDENCE,
    FACTS,
    MODE,
    PLANT,
    PLANT_STATE,
    RECORDER,
    alive,
    estimate,
    in_words,
    joining,
    key,
    leaving,
    measurement,
    model_of,
    node_who,
    participants,
    ready,
    refusals,
    refused,
    replay,
    run_of,
    sender_of,
    sensor_who,
    session,
    speaker_of,
    topic_of,
    watch,
)
from agent.contract.messages import Estimate, Event, Measurement, Mode, PlantState

NAMES = st.from_regex(r"[A-Za-z0-9_-]{1,64}", fullmatch=True)


@given(NAMES, NAMES)
def test_a_topic_is_the_inverse_of_its_key(run: str, node: str) -> None:
    for topic in (MODE, PLANT_STATE, EVENT, ACCOUNT, measurement(node), estimate(node)):
        for shown in (topic, watch(topic)):
            assert topic_of(key(run, shown, who=node_who(node))) == topic_of(key(run, shown)) == shown
        assert key(run, topic).split("/")[:2] == ["peakmesh", run]
        assert run_of(key(run, topic)) == run


@given(NAMES, NAMES)
def test_every_key_of_data_says_who_speaks(run: str, node: str) -> None:
    """By its end where several share the topic, by the topic itself otherwise; measurements have two that may."""
    who = node_who(node)
    assert [speaker_of(key(run, topic, who=who)) for topic in (EVENT, ACCOUNT, watch(EVENT))] == [who] * 3
    assert {speaker_of(key(run, topic, who=who)) for topic in (MODE, PLANT_STATE, estimate(node))} == {""}


@given(NAMES)
def test_every_topic_has_one_model(node: str) -> None:
    models = [model_of(topic) for topic in (MODE, PLANT_STATE, measurement(node), estimate(node), EVENT)]
    assert models == [Mode, PlantState, Measurement, Estimate, Event]


@pytest.mark.parametrize(
    "topic", ["", "modes", "plant", "plant/states", "node/1", "node/1/x", "node/a/b/estimate", CONTROL, ACKNOWLEDGED]
)
def test_what_is_no_topic_has_no_model(topic: str) -> None:
    assert model_of(topic) is None


@given(NAMES)
def test_participants_are_named_in_words(node: str) -> None:
    assert in_words(node_who(node)) == f'node "{node}"'
    assert in_words(sensor_who(node)) == f'sensor "{node}"'
    assert [in_words(who) for who in (COORDINATOR, PLANT, RECORDER)] == ["the coordinator", "the plant", "the recorder"]


@given(NAMES)
def test_every_topic_has_a_sender(name: str) -> None:
    assert sender_of(estimate(name), external=(name,)) == node_who(name)
    assert sender_of(measurement(name)) == sender_of(PLANT_STATE) == PLANT
    assert sender_of(measurement(name), external=(name,)) == sensor_who(name)
    assert sender_of(MODE) == sender_of(EVENT) == COORDINATOR


def test_everybody_takes_part_once(gains: Gains) -> None:
    everybody = participants(gains.problem)
    assert everybody == ["coordinator", "plant", "recorder", "node-n0", "node-n1", "node-n2"]


def test_the_table_names_every_key_of_the_code() -> None:
    """The docstring's tables have one row for each topic and each key, under the model the code gives it."""
    rows = [[cell.strip() for cell in row.split("|")[1:3]] for row in re.findall(r"^\|.*\|$", keys.__doc__, re.M)]
    table = dict(row for row in rows if not row[0].startswith("-") and row[0] != "topic")
    data = (MODE, PLANT_STATE, EVENT, ACCOUNT, EVIDENCE, measurement("<n>"), estimate("<n>"))
    topics = {topic: model_of(topic).__name__ for topic in data}
    others = {
        alive("<who>"): "liveliness",
        session("<who>", "<id>"): "liveliness",
        refused("<who>", "<id>"): "a sentence",
        joining("<who>"): "Joining",
        leaving("<who>"): "Leaving",
        ready("<who>"): "Ready",
        CONTROL: "Control",
        ACKNOWLEDGED: "Acknowledged",
        refusals("<who>"): "Refusals",
        replay("<who>"): "queryable",
        FACTS: "Facts",
        watch("<data topic>"): "the same",
    }
    assert table == topics | others


def test_the_sensor_that_the_documents_show_uses_these_keys() -> None:
    """It is written without peakmesh, so it spells them out."""
    text = (ROOT / "docs" / "sensor.py").read_text()
    spelt = [*re.findall(r'f"(peakmesh/[^"]+)"', text), *re.findall(r'f"\{base\}/([^"]+)"', text)]
    sensor, reading = alive(sensor_who("{node}")), measurement("{node}")
    assert spelt == [key("{sys.argv[1]}", "").rstrip("/"), MODE, alive("*"), alive(COORDINATOR), sensor, reading]
