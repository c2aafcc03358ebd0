"""Every message and every key expression.

Data messages are flat JSON objects with a `step`; what is on the wire is what is recorded. Their keys are
`peakmesh/<run>/<topic>`:

| topic                  | model       | from                       | to                                         |
|------------------------|-------------|----------------------------|--------------------------------------------|
| mode                   | Mode        | coordinator                | nodes, plant, sensor drivers, recorder     |
| plant/state            | PlantState  | plant                      | recorder                                   |
| node/<n>/measurement   | Measurement | plant, or a sensor driver  | node n, recorder                           |
| node/<n>/estimate      | Estimate    | node n                     | nodes that hear n in some mode, recorder   |
| event                  | Event       | anyone                     | recorder, watchers                         |

Keys that run the run itself, not recorded; <who> is node-<n>, plant, sensor-<n>, coordinator or recorder:

| key                    | what        | from                       | to                                         |
|------------------------|-------------|----------------------------|--------------------------------------------|
| alive/<who>            | liveliness  | everyone                   | everyone: it is there, it is gone          |
| ready/<who>            | Ready       | everyone but sensors       | coordinator: it has seen all the others    |
| control                | Control     | coordinator                | everyone: start, close, stop               |
| acknowledged           | Acknowledged| recorder                   | publishers, coordinator                    |
| replay/<who>           | queryable   | publishers                 | recorder: their messages from a number on  |

Every data message carries an attachment: its number among the sender's messages, the sender's clock, the
sender's name (see `Stamp`). A sensor driver may leave it out.
"""

from __future__ import annotations

import struct
from typing import Literal, NamedTuple, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from agent.contract.errors import RunBroken, first_fault
from agent.contract.problem import Problem


class Message(BaseModel):
    """Flat, frozen, finite: NaN and infinity are refused, unknown fields too, and numbers in quotes."""

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid", allow_inf_nan=False)

    step: int = Field(ge=0, lt=2**63)

    def encode(self) -> bytes:
        """JSON; every float64 comes back bit for bit."""
        return self.__pydantic_serializer__.to_json(self)

    @classmethod
    def decode(cls, payload: bytes) -> Self:
        """Raises pydantic.ValidationError for anything else than this message."""
        return cls.model_validate_json(payload)


class Mode(Message):
    """r(k): the topology of step k, by name."""

    mode: str


class PlantState(Message):
    """The simulated plant at step k: x (nx), z = M x (nz), w (nw), and theta_i for each node in file order."""

    x: list[float]
    z: list[float]
    w: list[float]
    arrived: list[int]


class Measurement(Message):
    """y_i(k), eq. (2), (ny_i); empty where nothing arrived at a node that sees its losses."""

    y: list[float]


class Estimate(Message):
    """What node i sends at step k: x_hat_i(k), and innovation_i(k) = y_i(k) - beta_i C_i x_hat_i(k).

    A node that sees its losses has y_i(k) - C_i x_hat_i(k) for its innovation, and zeros where nothing arrived.
    z_hat_i(k) = M x_hat_i(k). `mode` and `heard` say how x_hat_i(k) was made: the mode of step k - 1 and the
    nodes whose messages of step k - 1 went into it; at step 0, where x_hat is the initial 0, "" and [].
    """

    x_hat: list[float]
    innovation: list[float]
    z_hat: list[float]
    mode: str
    heard: list[str]


class Event(Message):
    """Something worth knowing: `kind` (a word), `who` it is about, `detail` in words."""

    kind: str
    who: str
    detail: str


class Ready(BaseModel):
    """`who`, with the zenoh session `session`, has seen everybody's token; `gains` is the digest of its gains."""

    who: str
    session: str
    gains: str


class Control(BaseModel):
    """The coordinator's word.

    "start": the facts of the run; "close": all its steps are done and recorded; "stop": end now, because `reason`.
    `external` names the nodes whose measurements come from a sensor, not from the simulated plant.
    """

    order: Literal["start", "close", "stop"]
    steps: int
    seed: int
    window: int
    external: list[str]
    reason: str


class Acknowledged(BaseModel):
    """The recorder's word: it holds the first `received[who]` messages of everyone, and every step < `steps`.

    `messages` are recorded, `missing` are known to lack. `reached[who]` is the last step of which it has anything of
    theirs, `lacking` the topics that keep step `steps` incomplete. `closed`: the recording is whole and has its name;
    everybody may go.
    """

    steps: int
    messages: int
    missing: int
    received: dict[str, int]
    reached: dict[str, int]
    lacking: list[str]
    closed: bool


class Stamp(NamedTuple):
    """The attachment of a data message: `number` counts the sender's messages from 0, `time` is in ns."""

    number: int
    time: int
    sender: str

    def encode(self) -> bytes:
        return _STAMP.pack(self.number, self.time) + self.sender.encode()

    @classmethod
    def decode(cls, attachment: bytes) -> Self:
        """Raises ValueError for anything else than a stamp."""
        if len(attachment) <= _STAMP.size:
            raise ValueError(f"a stamp is longer than {_STAMP.size} bytes, this one has {len(attachment)}")
        number, time = _STAMP.unpack_from(attachment)
        return cls(number, time, attachment[_STAMP.size :].decode())


_STAMP = struct.Struct("<QQ")


# topics: one table feeds roles, recorder and replay
MODE, PLANT_STATE, EVENT = "mode", "plant/state", "event"


def measurement(node: str) -> str:
    return f"node/{node}/measurement"


def estimate(node: str) -> str:
    return f"node/{node}/estimate"


def model_of(topic: str) -> type[Message] | None:
    """The model of a topic's messages; None for a key that is not a topic."""
    match topic.split("/"):
        case ["mode"]:
            return Mode
        case ["plant", "state"]:
            return PlantState
        case ["node", _, "measurement"]:
            return Measurement
        case ["node", _, "estimate"]:
            return Estimate
        case ["event"]:
            return Event
    return None


def decode(topic: str, payload: bytes) -> Message:
    """A message of a known topic. Raises RunBroken: one sentence that says what came there."""
    model = model_of(topic)
    if model is None:
        raise RunBroken(f"there is no topic {topic}")
    try:
        return model.decode(payload)
    except ValidationError as error:
        raise RunBroken(f"a message on {topic} is not a {model.__name__}: {first_fault(error, {})}") from None


def key(run: str, topic: str) -> str:
    return f"peakmesh/{run}/{topic}"


def topic_of(key_expression: str) -> str:
    """The inverse of `key`."""
    return key_expression.split("/", 2)[2]


def node_who(node: str) -> str:
    return f"node-{node}"


def sensor_who(node: str) -> str:
    return f"sensor-{node}"


COORDINATOR, PLANT, RECORDER = "coordinator", "plant", "recorder"
CONTROL, ACKNOWLEDGED = "control", "acknowledged"


def participants(problem: Problem) -> list[str]:
    """Everybody who takes part in a run, but for sensors."""
    return [COORDINATOR, PLANT, RECORDER, *map(node_who, problem.node_names)]


def alive(who: str) -> str:
    return f"alive/{who}"


def ready(who: str) -> str:
    return f"ready/{who}"


def replay(who: str) -> str:
    return f"replay/{who}"


def in_words(who: str) -> str:
    """`node "3"` for node-3, for people."""
    kind, _, name = who.partition("-")
    return f'{kind} "{name}"' if name else f"the {kind}"
