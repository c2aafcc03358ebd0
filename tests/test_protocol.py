"""docs/protocol.md says what the code says: keys, fields, what is refused, the numbers in its sentences."""

from __future__ import annotations

import re

import pytest
from places import ROOT

from agent.contract import keys, messages
from agent.contract.schedule import DELIVERIES
from agent.guard import AHEAD, KINDS
from agent.guests import _VARIABLES
from agent.network.session import CAPACITY
from agent.plan import LARGEST_WINDOW

TEXT = (ROOT / "docs" / "protocol.md").read_text()
SECTIONS = dict(re.findall(r"^##+ (.*?)\n(.*?)(?=^##|\Z)", TEXT, flags=re.DOTALL | re.MULTILINE))
MODELS = [getattr(messages, name) for name in SECTIONS if hasattr(messages, name)]
SAID = {"Mode", "Measurement", "Estimate", "Event", "Account"}  # with an attachment
WORDS = {"Joining", "Ready", "Leaving", "Refusals", "Control", "Acknowledged"}


def rows(section: str) -> list[list[str]]:
    """Of the tables of a section."""
    lines = [line for line in SECTIONS[section].splitlines() if line.startswith("|")]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    return [row for row in cells if not set("".join(row)) <= set("-")][1:]


def test_every_message_of_a_node_has_its_table() -> None:
    assert {model.__name__ for model in MODELS} == SAID | WORDS


@pytest.mark.parametrize("model", MODELS, ids=lambda model: model.__name__)
def test_every_field_is_there_and_may_be_left_out_where_it_says_so(model: type[messages.Frozen]) -> None:
    told = {
        name: cell.startswith("*")
        for row in rows(model.__name__)
        for cell in row[0].split(", ")
        for name in re.findall(r"`(\w+)`", cell)
    }
    fields = {name: not field.is_required() for name, field in model.model_fields.items()}
    common = set(messages.Word.model_fields) if issubclass(model, messages.Word) else set()
    assert told == {name: optional for name, optional in fields.items() if name not in common}


def test_what_all_words_have() -> None:
    told = {name for row in rows("Words") for name in re.findall(r"`(\w+)`", row[0])}
    assert told == set(messages.Word.model_fields)


def test_keys_are_those_of_the_table() -> None:
    """Each topic as the functions of the one table make it."""
    node, other, who = "<n>", "<j>", keys.node_who("<n>")
    topics = [keys.MODE, keys.measurement(node), keys.estimate(other), keys.estimate(node), keys.CONTROL]
    topics += [f"{keys.EVENT}/{who}", f"{keys.ACCOUNT}/{who}", keys.ACKNOWLEDGED, keys.session("*", "*")]
    topics += [keys.session(who, "<id>"), keys.alive(who), keys.joining(who), keys.ready(who), keys.leaving(who)]
    topics += [keys.refusals(who), keys.refused(who, "<id>"), keys.replay(who)]
    table = rows("Keys")
    assert sorted(re.findall(r"`(.*?)`", row[0])[0] for row in table) == sorted(topics)
    known = re.findall(r"^\| (\S+)", keys.__doc__ or "", flags=re.MULTILINE)
    whole = {re.sub(r"<who>|node-<n>|\*", "<>", re.sub(r"<(id|n|j)>", "<>", topic)) for topic in known}
    for row in table:
        topic = re.findall(r"`(.*?)`", row[0])[0].replace("node-<n>", "<>").replace("*", "<>")
        assert re.sub(r"<(id|n|j)>", "<>", topic).removesuffix("/<>") in {
            *whole,
            *(w.removesuffix("/<>") for w in whole),
        }


def test_what_is_refused_is_named() -> None:
    assert [re.findall(r"`(\w+)`", row[0])[0] for row in rows("What is refused")] == list(KINDS)
    assert f"more than {AHEAD} ahead" in SECTIONS["What is refused"]
    assert f"more wait than are kept ({CAPACITY} of a topic)" in SECTIONS["What is refused"]


def test_the_attachment_has_these_bytes() -> None:
    payload, session = b'{"step":0}', "someone"
    digest, tag = messages.digest_of("mode", payload), messages.tag_of(session)
    stamp = messages.Stamp(1, 2, "node-1", digest, tag).encode()
    sizes = [row[0] for row in rows("The attachment of a message")]
    name = b"node-1"
    assert sizes == ["8", "8", "", "1", str(len(digest)), str(len(tag))]
    assert stamp == (1).to_bytes(8, "little") + (2).to_bytes(8, "little") + name + b"\0" + digest + tag


def test_what_a_program_is_told() -> None:
    assert {(row[0].strip("`"), row[1].strip("`{}")) for row in rows("What it is told")} == {
        (variable, name) for name, variable in _VARIABLES.items()
    }


def test_numbers_in_sentences() -> None:
    assert f"key (`seed`, {DELIVERIES})" in SECTIONS["A step"]
    assert f"{messages.CEILING:.0e}".replace("+", "") in SECTIONS["What it says and hears"].replace("\n", " ")
    room = f"no more than {LARGEST_WINDOW} steps ahead of the last mode has room where it waits, {CAPACITY} messages"
    assert room in SECTIONS["Measurement"].replace("\n", " ")
    assert messages.ZERO_STATE in SECTIONS["Against the clock"]
