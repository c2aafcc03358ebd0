"""Every key expression: who says what to whom. One table for the runtime, the recorder and the replay.

Keys are `peakmesh/<run>/<topic>`; where several may say something on a topic, `peakmesh/<run>/<topic>/<who>`, so that a
key always says who speaks. Messages of the data topics are recorded as they were on the wire:

| topic                  | model       | from                       | to                                         |
|------------------------|-------------|----------------------------|--------------------------------------------|
| mode                   | Mode        | coordinator                | nodes, plant, sensor drivers, recorder     |
| plant/state            | PlantState  | plant                      | recorder                                   |
| node/<n>/measurement   | Measurement | plant, or a sensor driver  | node n, recorder                           |
| node/<n>/estimate      | Estimate    | node n                     | nodes that hear n in some mode, recorder   |
| event                  | Event       | anyone                     | recorder, watchers                         |
| account                | Account     | nodes of a paced run       | coordinator, recorder                      |

Topics that run the run itself, not recorded; <who> is node-<n>, plant, sensor-<n>, coordinator or recorder:

| topic                  | what        | from                       | to                                         |
|------------------------|-------------|----------------------------|--------------------------------------------|
| alive/<who>            | liveliness  | everyone                   | sensor drivers; of sensors, everyone       |
| session/<who>/<id>     | liveliness  | everyone but sensors       | everyone: it is there, it is gone          |
| refused/<who>/<id>     | a sentence  | everyone but sensors       | session <id> of <who>: its place is taken  |
| joining/<who>          | Joining     | everyone but sensors       | coordinator: where it is, whom it lacks    |
| leaving/<who>          | Leaving     | everyone but sensors       | coordinator: why it goes                   |
| ready/<who>            | Ready       | everyone but sensors       | coordinator, recorder: it has seen others  |
| control                | Control     | coordinator                | everyone: start, close, stop               |
| acknowledged           | Acknowledged| recorder                   | publishers, coordinator                    |
| refusals/<who>         | Refusals    | everyone but sensors       | coordinator: what was refused of others    |
| replay/<who>           | queryable   | publishers                 | recorder: messages from ?from=<number> on  |
| facts                  | Facts       | recorder, when asked       | viewers: what run this is                  |
| watch/<data topic>     | the same    | publishers, to viewers     | viewers, where there are any, without stamp|

The recorder writes one more topic to the file, which is never on the wire:

| topic                  | what        | from                       | to                                         |
|------------------------|-------------|----------------------------|--------------------------------------------|
| evidence               | Evidence    | recorder                   | whoever checks a recording                 |

The models are in `messages`. Every data message carries an attachment: its number among the sender's messages, the
sender's clock, the sender's name, a digest of the message, a tag of the sender's session (`messages.Stamp`). A sensor
driver may leave it out, or all that follows the name.
"""

from __future__ import annotations

from collections.abc import Container

from pydantic import ValidationError

from agent.contract.errors import RunBroken, first_fault
from agent.contract.messages import Account, Estimate, Event, Evidence, Measurement, Message, Mode, PlantState
from agent.contract.problem import Problem


def key(run: str, topic: str, *, who: str = "*") -> str:
    """What is said on a topic; on one that several share, what `who` says there."""
    return f"peakmesh/{run}/{topic}/{who}" if _is_shared(topic) else f"peakmesh/{run}/{topic}"


def topic_of(key_expression: str) -> str:
    """The inverse of `key`."""
    topic = key_expression.split("/", 2)[2]
    shared, _, _who = topic.rpartition("/")
    return shared if _is_shared(shared) else topic


def speaker_of(key_expression: str) -> str:
    """Who speaks under a key of a topic that several share; "" for any other key: `sender_of` its topic does."""
    topic, _, who = key_expression.split("/", 2)[2].rpartition("/")
    return who if _is_shared(topic) else ""


def run_of(key_expression: str) -> str:
    """The run that a key is of."""
    return key_expression.split("/", 2)[1]


# data
MODE, PLANT_STATE, EVENT, ACCOUNT, EVIDENCE = "mode", "plant/state", "event", "account", "evidence"
BESIDE = (EVENT, ACCOUNT, EVIDENCE)  # what is said of the run beside its steps


def _is_shared(topic: str) -> bool:
    return topic.removeprefix(watch("")) in (EVENT, ACCOUNT)


def measurement(node: str) -> str:
    return f"node/{node}/measurement"


def estimate(node: str) -> str:
    return f"node/{node}/estimate"


def data_topics(problem: Problem) -> list[str]:
    """Every topic that has a message of each step, of a run of this problem: all but events."""
    names = problem.node_names
    return [MODE, PLANT_STATE, *map(measurement, names), *map(estimate, names)]


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
        case ["evidence"]:
            return Evidence
        case ["account"]:
            return Account
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


# what runs the run
CONTROL, ACKNOWLEDGED, FACTS = "control", "acknowledged", "facts"


def alive(who: str) -> str:
    return f"alive/{who}"


def session(who: str, identity: str) -> str:
    return f"session/{who}/{identity}"


def refused(who: str, identity: str) -> str:
    return f"refused/{who}/{identity}"


def joining(who: str) -> str:
    return f"joining/{who}"


def leaving(who: str) -> str:
    return f"leaving/{who}"


def ready(who: str) -> str:
    return f"ready/{who}"


def refusals(who: str) -> str:
    return f"refusals/{who}"


def replay(who: str) -> str:
    return f"replay/{who}"


def watch(topic: str) -> str:
    """Where viewers are shown the messages of a data topic."""
    return f"watch/{topic}"


# who there is
COORDINATOR, PLANT, RECORDER = "coordinator", "plant", "recorder"
VIEWER = "viewer"  # looks on, and takes no part


def node_who(node: str) -> str:
    return f"node-{node}"


def sensor_who(node: str) -> str:
    return f"sensor-{node}"


def sender_of(topic: str, *, external: Container[str] = ()) -> str:
    """Who numbers the messages of a topic; the nodes in `external` are measured by sensors."""
    match topic.split("/"):
        case ["node", name, "estimate"]:
            return node_who(name)
        case ["node", name, "measurement"] if name in external:
            return sensor_who(name)
        case ["plant", "state"] | ["node", _, "measurement"]:
            return PLANT
    return COORDINATOR


def participants(problem: Problem) -> list[str]:
    """Everybody who takes part in a run, but for sensors."""
    return [COORDINATOR, PLANT, RECORDER, *map(node_who, problem.node_names)]


def in_words(who: str) -> str:
    """`node "3"` for node-3, for people."""
    kind, _, name = who.partition("-")
    return f'{kind} "{name}"' if name else f"the {kind}"
