"""Messages are exact, flat and finite."""

from __future__ import annotations

import json
import struct
from importlib.metadata import version
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from agent.contract import messages
from agent.contract.keys import node_who
from agent.contract.messages import (
    DIGEST_SIZE,
    Account,
    Estimate,
    Event,
    Measurement,
    Message,
    Mode,
    PlantState,
    Stamp,
    digest_of,
)

MODELS = (Mode, PlantState, Measurement, Estimate, Event, Account)
EXAMPLES: tuple[Message, ...] = (
    Mode(step=3, mode="joined", index=1),
    PlantState(step=3, x=[0.1, -0.0], z=[5e-324], w=[1e308], arrived=[1, 0]),
    Measurement(step=3, y=[1 / 3]),
    Estimate(step=3, x_hat=[0.1], innovation=[0.2], z_hat=[0.3], mode="joined", heard=["1", "2"]),
    Event(step=3, kind="lost", who="node-1", detail='says "ü"'),
    Event(step=3, kind="late", who="node-1", detail="", about="node/2/estimate", steps=[1, 2], seconds=[0.01, 5e-324]),
    Estimate(step=3, x_hat=[0.1], innovation=[0.0], z_hat=[0.3], mode="", heard=[], measured=False, origin="2"),
)
NAMES = st.from_regex(r"[A-Za-z0-9_-]{1,64}", fullmatch=True)
NUMBERS = st.lists(
    st.floats(allow_nan=False, allow_infinity=False) | st.sampled_from([-0.0, 5e-324, 1e308, -1.7976931348623157e308])
)


def bits(numbers: list[float]) -> bytes:
    return struct.pack(f"{len(numbers)}d", *numbers)


# encode, decode
@given(st.integers(0, 2**63 - 1), NUMBERS, NUMBERS, NUMBERS)
def test_every_float_comes_back_bit_for_bit(step: int, x_hat: list[float], y: list[float], z: list[float]) -> None:
    sent = Estimate(step=step, x_hat=x_hat, innovation=y, z_hat=z, mode="1", heard=["1"])
    came = Estimate.decode(sent.encode())
    assert came.step == step
    assert (bits(came.x_hat), bits(came.innovation), bits(came.z_hat)) == (bits(x_hat), bits(y), bits(z))
    assert came.encode() == sent.encode()


@pytest.mark.parametrize("message", EXAMPLES, ids=lambda message: type(message).__name__)
def test_every_message_comes_back(message: Message) -> None:
    assert type(message).decode(message.encode()) == message


def test_what_only_paced_runs_say_takes_no_byte_in_others() -> None:
    """So that a lock-step run of today has the bytes of one of yesterday."""
    estimate = Estimate(step=3, x_hat=[0.1], innovation=[0.0], z_hat=[0.3], mode="a", heard=["1"])
    assert estimate.encode() == b'{"step":3,"x_hat":[0.1],"innovation":[0.0],"z_hat":[0.3],"mode":"a","heard":["1"]}'
    event = Event(step=0, kind="start", who="coordinator", detail="")
    assert event.encode() == b'{"step":0,"kind":"start","who":"coordinator","detail":""}'


@pytest.mark.parametrize("number", [float("nan"), float("inf"), float("-inf")])
@pytest.mark.parametrize("field", ["x_hat", "innovation", "z_hat"])
def test_a_message_that_is_not_finite_is_never_made(field: str, number: float) -> None:
    fields: dict[str, Any] = {"x_hat": [0.0], "innovation": [0.0], "z_hat": [0.0], field: [1.0, number]}
    with pytest.raises(ValidationError):
        Estimate(step=0, mode="", heard=[], **fields)


@pytest.mark.parametrize("number", [b"NaN", b"Infinity", b"-Infinity", b"1e999", b"null", b'"1"', b"true", b"[1]"])
def test_a_payload_with_something_else_than_finite_numbers_is_refused(number: bytes) -> None:
    with pytest.raises(ValidationError):
        Measurement.decode(b'{"step":0,"y":[' + number + b"]}")


@pytest.mark.parametrize("step", [b"-1", b"1.5", b'"1"', b"true", b"null", b"9223372036854775808"])
def test_a_step_is_a_natural_number_of_64_bits(step: bytes) -> None:
    with pytest.raises(ValidationError):
        Mode.decode(b'{"step":' + step + b',"mode":"1"}')


@pytest.mark.parametrize(
    "payload", [b"", b"{}", b"[]", b"\xff", b'{"step":0}', b'{"step":0,"mode":"1","more":1}', b'{"step":0,"mode":"1"']
)
def test_missing_and_unknown_fields_are_refused(payload: bytes) -> None:
    with pytest.raises(ValidationError):
        Mode.decode(payload)


def after(last: int) -> str:
    """The version that comes `last` versions after this one, in the same series."""
    first, second, third = version("peakmesh").split(".")
    return f"{first}.{second}.{int(third) + last}"


@pytest.mark.parametrize("message", EXAMPLES, ids=lambda message: type(message).__name__)
def test_what_a_later_version_says_besides_is_left_out(message: Message) -> None:
    """To the last bit: what is known of it is what it was."""
    more = b',"reason":{"of":["any",1e-320]},"version":"' + after(1).encode() + b'"}'
    assert type(message).decode(message.encode()[:-1] + more) == message


@pytest.mark.parametrize(
    "said",
    [
        f'"version":"{after(0)}"',
        f'"version":"{after(-1)}"',
        '"version":"9.9.9"',
        '"version":"later"',
        '"version":""',
        '"version":7',
        '"version":[]',
        f'"version":"{after(1)}","index":0.5',
        f'"version":"{after(1)}","index":NaN',
    ],
)
def test_only_a_later_version_may_say_more(said: str) -> None:
    """Of the same series, and nothing else may be wrong with what it says."""
    with pytest.raises(ValidationError):
        Mode.decode(f'{{"step":0,"mode":"1","more":1,{said}}}'.encode())


@pytest.mark.parametrize("message", EXAMPLES, ids=lambda message: type(message).__name__)
def test_no_message_is_read_as_another(message: Message) -> None:
    for other in MODELS:
        if not isinstance(message, other):
            with pytest.raises(ValidationError):
                other.decode(message.encode())


def test_messages_cannot_be_changed() -> None:
    with pytest.raises(ValidationError, match="frozen"):
        EXAMPLES[0].step = 4


# schemas
@pytest.mark.parametrize("model", MODELS)
def test_schemas_are_flat(model: type[Message]) -> None:
    """Viewers plot a field only where it is a number, a string, or a list of one of them."""
    schema = model.model_json_schema()
    assert schema["type"] == "object"
    assert "step" in schema["required"]
    assert "$defs" not in schema
    for field in schema["properties"].values():
        assert field["description"]
        if field["type"] == "array":
            assert field["items"]["type"] in {"number", "integer", "string"}
        else:
            assert field["type"] in {"integer", "string", "number", "boolean"}


def test_a_mode_of_an_older_recording_is_read() -> None:
    """It has no index."""
    assert Mode.decode(b'{"step":3,"mode":"joined"}') == Mode(step=3, mode="joined", index=-1)


def test_numbers_name_their_unit() -> None:
    for model in MODELS:
        for name, field in model.model_json_schema()["properties"].items():
            numbers = field["type"] == "array" and field["items"]["type"] == "number"
            in_seconds = name in ("seconds", "way")
            assert ("units of the problem" in field["description"]) == (numbers and not in_seconds), name


# stamps
@given(
    st.integers(0, 2**64 - 1),
    st.integers(0, 2**64 - 1),
    NAMES,
    st.just(b"") | st.binary(min_size=DIGEST_SIZE, max_size=DIGEST_SIZE),
)
def test_a_stamp_comes_back(number: int, time: int, sender: str, digest: bytes) -> None:
    stamp = Stamp(number, time, node_who(sender), digest)
    assert Stamp.decode(stamp.encode()) == stamp


@pytest.mark.parametrize(
    "attachment", [b"", b"1", bytes(15), bytes(16), bytes(16) + b"\xff", bytes(16) + b"plant\0", bytes(48)]
)
def test_what_is_no_stamp_is_refused(attachment: bytes) -> None:
    with pytest.raises(ValueError, match=r"^a stamp is longer than 16 bytes|^a digest has 16 bytes, this|can't decode"):
        Stamp.decode(attachment)


def test_a_digest_is_of_the_topic_and_the_payload() -> None:
    """And of where the one ends and the other begins."""
    digests = {digest_of(topic, payload) for topic in ("mode", "mode1", "event") for payload in (b"", b"1", b"11")}
    assert len(digests) == 9
    assert {len(digest) for digest in digests} == {DIGEST_SIZE}


@pytest.mark.parametrize(
    "word",
    [
        messages.Joining(who="plant", session="s", version="1", listen="none", machine="", lease=1.0, lacks=[]),
        messages.Leaving(who="plant", reason="enough"),
        messages.Ready(who="plant", session="s", gains="g"),
        messages.Control(order="start", steps=1, seed=0, window=1, external=[], reason=""),
        messages.Acknowledged(steps=0, messages=0, missing=0, received={}, reached={}, lacking=[], closed=False),
    ],
)
def test_words_of_a_newer_version_may_say_more(word: messages.Ready) -> None:
    """What is not known here is left out; versions are compared, so that nobody depends on it."""
    document = json.loads(word.model_dump_json()) | {"more": [1, 2, 3]}
    assert type(word).model_validate_json(json.dumps(document)) == word
