"""Every message, as a model. Which key it is published under, by whom and for whom, is in `keys`.

Data messages are flat JSON objects with a `step`; what is on the wire is what is recorded.
"""

from __future__ import annotations

import hashlib
import json
import re
import struct
from importlib.metadata import version
from typing import Literal, NamedTuple, Self

from pydantic import ConfigDict, Field, ValidationError

from agent.contract.frozen import Frozen

_UNIT = "in the units of the problem"
CEILING = 1e140  # of every number in a message: squares of larger ones overflow where messages are judged


def beyond_ceiling(*vectors: list[float]) -> bool:
    """Whether a number of a message is so large that nobody would take it."""
    return any(not (min(values) >= -CEILING and max(values) <= CEILING) for values in vectors if values)


class Message(Frozen):
    """Flat and finite: NaN and infinity are refused, unknown fields too, and numbers in quotes.

    Unknown fields are refused but in messages that say that they are of a later version: see `decode`.
    """

    model_config = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)

    step: int = Field(ge=0, lt=2**63, description="k, counted from 0: messages belong together by it, never by time")

    def encode(self) -> bytes:
        """JSON; every float64 comes back bit for bit. A field with a default is left out where it has that value."""
        return self.__pydantic_serializer__.to_json(self, exclude_defaults=True)

    @classmethod
    def decode(cls, payload: bytes) -> Self:
        """Raises pydantic.ValidationError for anything else than this message.

        Fields that a later version of the same series has added are left out, where the message says that it is of one.
        """
        try:
            return cls.model_validate_json(payload)
        except ValidationError as error:
            if (known := _known_of_a_later_version(cls, payload, error)) is None:
                raise
        return cls.model_validate_json(known)


def _known_of_a_later_version(model: type[Message], payload: bytes, error: ValidationError) -> bytes | None:
    """A message without the fields that are unknown here; None where its `version` is none to have others.

    Whoever adds a field to a message has it say `version`, as a field, wherever the new one is not at its default.
    """
    if any(fault["type"] != "extra_forbidden" for fault in error.errors(include_url=False, include_input=False)):
        return None
    try:
        document = json.loads(payload)
    except (ValueError, RecursionError):
        return None
    if not is_later(document.get("version"), than=version("peakmesh")):
        return None
    return json.dumps({name: document[name] for name in model.model_fields if name in document}).encode()


def is_later(text: object, *, than: str) -> bool:
    """Whether a version is later than another, and of the same series: its first two numbers are the same."""
    numbers, own = (re.fullmatch(r"(\d{1,9})\.(\d{1,9})\.(\d{1,9})", str(some)) for some in (text, than))
    if numbers is None or own is None:
        return False
    return numbers.groups()[:2] == own.groups()[:2] and int(numbers[3]) > int(own[3])


class Mode(Message):
    """r(k): the topology of step k, by name, and by its place among the topologies for viewers that plot numbers.

    The name is what counts. A recording made before there was an `index` has -1 for it.
    """

    mode: str = Field(description="r(k), the name of the topology of step k")
    index: int = Field(
        default=-1, ge=-1, lt=2**31, description="its place in the problem's list of topologies, from 0; -1: not said"
    )


class PlantState(Message):
    """The simulated plant at step k: x (nx), z = M x (nz), w (nw), and theta_i for each node in file order."""

    x: list[float] = Field(description=f"x(k), the state, nx numbers; {_UNIT}")
    z: list[float] = Field(description=f"z(k) = M x(k), what is to be estimated, nz numbers; {_UNIT}")
    w: list[float] = Field(description=f"w(k), the disturbance, nw numbers; {_UNIT}")
    arrived: list[int] = Field(
        description="theta_i(k) of each node in the order of the problem: 1 its measurement arrived, 0 it was lost"
    )


class Measurement(Message):
    """y_i(k), eq. (2), (ny_i); empty where nothing arrived at a node that sees its losses."""

    y: list[float] = Field(description=f"y_i(k), ny_i numbers; [] where nothing arrived and the node sees it; {_UNIT}")


class Estimate(Message):
    """What node i sends at step k: x_hat_i(k), and innovation_i(k) = y_i(k) - beta_i C_i x_hat_i(k).

    A node that sees its losses has y_i(k) - C_i x_hat_i(k) for its innovation, and zeros where nothing arrived.
    z_hat_i(k) = M x_hat_i(k). `mode` and `heard` say how x_hat_i(k) was made: the mode of step k - 1 and the
    nodes whose messages of step k - 1 went into it; at step 0, where x_hat is the initial 0, "" and [].

    Paced runs alone have the rest. `measured` is false where y_i(k) was not there in time: innovation_i(k) is 0.
    `origin` says where x_hat_i(k) is from where a node begins again: a node, whose x_hat_j(k) it is, or ZERO_STATE;
    then `mode` is "" and `heard` [] as at step 0.
    """

    x_hat: list[float] = Field(description=f"x_hat_i(k), the node's estimate of x(k), nx numbers; {_UNIT}")
    innovation: list[float] = Field(description=f"y_i(k) less what the node expected of it, ny_i numbers; {_UNIT}")
    z_hat: list[float] = Field(description=f"z_hat_i(k) = M x_hat_i(k), its estimate of z(k), nz numbers; {_UNIT}")
    mode: str = Field(description='the mode of step k - 1, by which x_hat was made; "" at step 0')
    heard: list[str] = Field(description="the nodes whose messages of step k - 1 went into x_hat; [] at step 0")
    measured: bool = Field(default=True, description="whether y_i(k) was there in time; in lock-step it always is")
    origin: str = Field(default="", description="where x_hat is from, where the node begins again in a paced run")


ZERO_STATE = "the zero state"  # no node has such a name
# kinds of events: why their `about` was substituted
LATE, SILENT, GONE, REFUSED = "late", "silent", "gone", "refused"
LOST = "lost"  # messages that will not be recorded


class Event(Message):
    """Something worth knowing: `kind` (a word), `who` says it, `detail` in words.

    In paced runs events also say what became of messages: `about` is a topic or a participant, `steps` are those of
    which it is said, `seconds` by how much each of them was late, where that is known, and `way` where the latest of
    them spent its time once it was sent (`Way`), as far as Zenoh says; what is more than that the sender has taken.
    """

    kind: str = Field(description="what happened, in a word")
    who: str = Field(description="whom it is about: coordinator, plant, recorder, node-<name> or sensor-<name>")
    detail: str = Field(description="what happened, in words")
    about: str = Field(default="", description="in a paced run: the topic or the participant that it is said of")
    steps: list[int] = Field(default=[], max_length=1024, description="and the steps")
    seconds: list[float] = Field(default=[], max_length=1024, description="by how much each of them was late, in s")
    way: list[float] = Field(
        default=[], max_length=3, description="of the latest: seconds in sending, on the wire, in receiving"
    )


class Way(NamedTuple):
    """Where a message spent its time, in s: in the sender's Zenoh, between that and the receiver's, and in the latter.

    The second is by the clocks of both, and has their difference.
    """

    sending: float
    wire: float
    receiving: float


class Account(Message):
    """What node `who` did in a paced run up to step k: now and then, and at its end.

    Latencies are from a measurement's arrival to the estimate with it, and from a tick to the next estimate.
    """

    who: str = Field(description="the node, as node-<name>")
    steps: int = Field(description="steps that it made")
    pairs: int = Field(description="messages of neighbours that it was to use")
    pairs_substituted: int = Field(description="those of them that were not there in time")
    measurements_substituted: int = Field(description="measurements that were not there in time")
    late: int = Field(description="messages that came after their deadline")
    processor: float = Field(default=0.0, description="processor time of the process, in s")
    to_estimate_median: float = Field(description="from measurement to estimate, in s: half take no longer")
    to_estimate_p99: float = Field(description="99 of 100 take no longer, in s")
    to_estimate_max: float = Field(description="none took longer, in s")
    to_step_median: float = Field(description="from tick to step, in s: half take no longer")
    to_step_p99: float = Field(description="99 of 100 take no longer, in s")
    to_step_max: float = Field(description="none took longer, in s")


class Evidence(Message):
    """What sender `who` says of its messages from number `first` on: the recorder's, beside the messages themselves.

    `digests` has eight hexadecimal digits for each, the first four bytes of the sender's digest, or "--------" where
    there is none. `head` is the head of the sender's chain after the last of them, in hexadecimal; `step` is the last
    step among them. Heads and digests: see agent.contract.recording.evidence.
    """

    who: str
    first: int = Field(ge=0)
    digests: str = Field(pattern=r"^([0-9a-f]{8}|-{8})+$")
    head: str = Field(pattern=r"^[0-9a-f]{32}$")


class Word(Frozen):
    """What runs the run: each says which session it is from, and its number among all words of that session."""

    session: str = ""
    number: int = Field(default=0, ge=0)


class Joining(Word):
    """`who` is there, as the coordinator needs to know it before the run can start.

    `listen` is where it was asked to listen, `machine` whose network it is on, "" where that cannot be said; `lacks`
    are those whom it has to meet and has not; a peer that is silent for `lease` seconds is lost to it.
    """

    who: str
    version: str
    listen: str
    machine: str
    lease: float
    lacks: list[str]


class Leaving(Word):
    """`who` leaves, because `reason`."""

    who: str
    reason: str


class Ready(Word):
    """`who` has seen everybody's token; `gains` is the digest of its gains.

    Said again to a coordinator that has come back, `underway`: `step` is the first of which `who` has had no mode. Said
    to the recorder, it `asks` for a greeting.
    """

    who: str
    gains: str
    underway: bool = False
    asks: bool = False
    step: int = 0
    identity: str = ""  # of the run that it has seen begin


class Control(Word):
    """The coordinator's word.

    "start": the facts of the run; "close": all its steps are done and recorded; "stop": end now, because `reason`;
    "tell": say again whom you lack.
    `external` names the nodes whose measurements come from a sensor, not from the simulated plant.

    A paced run has a `period` in seconds, 0 in lock-step. From a step's mode on a node waits for its measurement for
    `measure_by` and for its neighbours' pairs for `hear_by` of a period. `faults` are what it is to survive. Who joins
    while it goes on is told to "start" too: `step` is the next one.

    `cast` names the sessions of those who are to start, at the beginning everybody's: nobody else of their names does.
    """

    order: Literal["start", "close", "stop", "tell"]
    steps: int
    seed: int
    window: int
    external: list[str]
    reason: str
    period: float = 0.0
    measure_by: float = 0.0
    hear_by: float = 0.0
    step: int = 0
    gains: str = ""
    identity: str = ""  # of this run alone, though others have its name
    faults: list[str] = Field(default=[])
    version: str = ""  # of the coordinator
    cast: dict[str, str] = Field(default={})


class Facts(Frozen):
    """What a viewer is told who asks what run this is: the order that it started by, and its gains file."""

    start: Control
    gains: str


class BrokenOff(Frozen):
    """The recording could not be written any more, because `reason`; it holds every step < `steps`.

    `stop`: the run is to end for that; otherwise it goes on without a recording.
    """

    reason: str
    steps: int
    stop: bool

    def __str__(self) -> str:
        return f"{self.reason}; there is no recording from step {self.steps} on"


class Acknowledged(Word):
    """The recorder's word: it has the first `received[who]` messages of everyone, and every step < `steps`.

    `messages` are recorded, `missing` are known to lack. `reached[who]` is the last step of which it has anything of
    theirs, `lacking` the topics that keep step `steps` incomplete. `closed`: the recording is whole and has its name,
    or is `broken_off`; everybody may go.
    """

    steps: int
    messages: int
    missing: int
    received: dict[str, int]
    reached: dict[str, int]
    lacking: list[str]
    closed: bool
    broken_off: BrokenOff | None = None
    lost: int = 0  # of those that are missing, what nobody keeps any more
    greets: str = ""  # who has just joined: `received` holds the number of their next message


class Refusals(Word):
    """What `who` has refused since it began: how many messages, by topic and by kind of fault."""

    who: str
    counts: dict[str, dict[str, int]]


class Stamp(NamedTuple):
    """The attachment of a data message: `number` counts the sender's messages from 0, `time` is in ns.

    `digest` is `digest_of` the message, or b"" where the sender gives none. `session` is `tag_of` the sender's session.
    """

    number: int
    time: int
    sender: str
    digest: bytes = b""
    session: bytes = b""

    def encode(self) -> bytes:
        """Number and time, the sender's name, and after a zero byte the digest and the session."""
        name = self.sender.encode()
        rest = name + b"\0" + self.digest + self.session if self.digest else name
        return _STAMP.pack(self.number, self.time) + rest

    @classmethod
    def decode(cls, attachment: bytes) -> Self:
        """Raises ValueError for anything else than a stamp."""
        if len(attachment) <= _STAMP.size:
            raise ValueError(f"a stamp is longer than {_STAMP.size} bytes, this one has {len(attachment)}")
        number, time = _STAMP.unpack_from(attachment)
        name, zero, rest = attachment[_STAMP.size :].partition(b"\0")
        if len(rest) not in ((DIGEST_SIZE, DIGEST_SIZE + TAG_SIZE) if zero else (0,)):
            raise ValueError(f"a digest has {DIGEST_SIZE} bytes, this one has {len(rest)}")
        return cls(number, time, name.decode(), rest[:DIGEST_SIZE], rest[DIGEST_SIZE:])


_STAMP = struct.Struct("<QQ")
DIGEST_SIZE, TAG_SIZE = 16, 8  # bytes


def tag_of(session: str) -> bytes:
    """A session, short enough for every message: BLAKE2b, 8 bytes."""
    return hashlib.blake2b(session.encode(), digest_size=TAG_SIZE).digest()


def digest_of(topic: str, payload: bytes) -> bytes:
    """What a sender says of its message, so that nobody can change it later unnoticed: BLAKE2b, 16 bytes."""
    return hashlib.blake2b(topic.encode() + b"\0" + payload, digest_size=DIGEST_SIZE).digest()
