"""Faults that a paced run is to survive, and what each of them does to whom. Pure; chance is the seed's.

| fault                                   | does                                                                   |
|-----------------------------------------|------------------------------------------------------------------------|
| kill:node=2,step=100                    | the process of node 2 is killed at the tick of step 100                |
| kill:coordinator,step=100               | the same; also plant and recorder                                      |
| freeze:node=3,step=50,for=2s            | the process stands still; also coordinator, plant, recorder            |
| mute-link:1>3,steps=50-80               | nothing of node 1 arrives at node 3; also plant>3, coordinator>3       |
| delay:node=2,by=30ms,steps=50-80        | everything of node 2 arrives later at the others                       |
| drop:probability=0.05,steps=50-80       | estimates and measurements do not arrive, each with this probability   |

Without `steps` the last three act from the first step to the last.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from agent.contract.errors import InputError, listed
from agent.contract.keys import COORDINATOR, MODE, PLANT, RECORDER, node_who
from agent.contract.problem import Problem
from agent.contract.schedule import FAULTS, Stream

Kind = Literal["kill", "freeze", "mute-link", "delay", "drop"]
ROLES = (COORDINATOR, PLANT, RECORDER)
ASKS = {  # the values that each kind must have, beside whom it is about; `steps` may be given to the last three
    "kill": {"step"},
    "freeze": {"step", "for"},
    "mute-link": set[str](),
    "delay": {"by"},
    "drop": {"probability"},
}


@dataclass(frozen=True)
class Fault:
    """One fault as it was asked for, `text`, and what it means."""

    text: str
    kind: Kind
    who: str  # whom it befalls, or whose messages, as a participant; "" for all
    receiver: str  # the node at the end of a muted link
    first: int
    last: int
    seconds: float  # that a freeze or a delay takes
    probability: float


def parse(text: str, problem: Problem, *, steps: int) -> Fault:
    """Raises InputError, in one sentence, for what is no fault or cannot happen in this problem and run."""
    kind, _, rest = text.partition(":")
    if kind not in ASKS:
        raise InputError(f"--fault {text}: there is no {kind!r}; there are {listed(ASKS)}")
    whom, values = "", dict[str, str]()
    for place, word in enumerate(rest.split(",") if rest else []):
        name, equals, value = word.partition("=")
        if equals:
            values[name] = value
        elif place == 0:
            whom = word
        else:
            raise InputError(f"--fault {text}: {word!r} is no value; values look like step=100")
    who, receiver = _whom(text, kind, whom, values.pop("node", None), problem)
    allowed = ASKS[kind] | ({"steps"} if kind not in ("kill", "freeze") else set())
    if unknown := sorted(values.keys() - allowed):
        raise InputError(f"--fault {text}: {kind} takes no {listed(unknown)}; it takes {listed(sorted(allowed))}")
    if lacking := sorted(ASKS[kind] - values.keys()):
        raise InputError(f"--fault {text}: {listed(lacking)} is missing")
    first, last = _steps(text, values, steps)
    return Fault(
        text=text,
        kind=kind,  # type: ignore[arg-type]
        who=who,
        receiver=receiver,
        first=first,
        last=last,
        seconds=max(_seconds(text, values[name]) if name in values else 0.0 for name in ("for", "by")),
        probability=_probability(text, values["probability"]) if "probability" in values else 0.0,
    )


def _whom(text: str, kind: str, whom: str, node: str | None, problem: Problem) -> tuple[str, str]:
    """The participant that a fault is about, and the node at the end of its link."""
    if kind == "drop":
        if whom or node is not None:
            raise InputError(f"--fault {text}: drop is about all messages; use mute-link for those of one link")
        return "", ""
    if kind == "mute-link":
        sender, arrow, receiver = whom.partition(">")
        if not arrow or node is not None:
            raise InputError(f"--fault {text}: a link looks like 1>3, from node 1 to node 3")
        i = problem.node_index(receiver)
        if sender in (PLANT, COORDINATOR) and sender not in problem.node_names:
            return sender, receiver
        j = problem.node_index(sender)
        if i == j or j not in problem.ever_heard(i):
            raise InputError(f'--fault {text}: node "{receiver}" hears node "{sender}" in no mode')
        return node_who(sender), receiver
    if node is not None and not whom:
        problem.node_index(node)
        return node_who(node), ""
    if kind != "delay" and whom in ROLES and node is None:
        return whom, ""
    roles = "" if kind == "delay" else f", or one of {listed(ROLES)}"
    raise InputError(f"--fault {text}: it must say whom it befalls: node=NAME{roles}")


def _steps(text: str, values: dict[str, str], steps: int) -> tuple[int, int]:
    words = values.get("step") or values.get("steps") or f"0-{steps - 1}"
    found = re.fullmatch(r"(\d{1,10})(?:-(\d{1,10}))?", words)
    if found is None or ("step" in values and found[2]):
        raise InputError(f"--fault {text}: {words} is neither a step, such as 50, nor steps, such as 50-80")
    first, last = int(found[1]), int(found[2] or found[1])
    if not first <= last < steps:
        raise InputError(f"--fault {text}: {words} is not within the steps of the run, 0-{steps - 1}")
    return first, last


def _seconds(text: str, value: str) -> float:
    found = re.fullmatch(r"(\d+\.?\d*|\.\d+)(ms|s)", value)
    seconds = float(found[1]) * (1e-3 if found[2] == "ms" else 1.0) if found else 0.0
    if not 0.0 < seconds <= 3600.0:
        raise InputError(f"--fault {text}: {value} is not a time up to an hour, such as 30ms or 2s")
    return seconds


def _probability(text: str, value: str) -> float:
    try:
        probability = float(value)
    except ValueError:
        probability = 0.0
    if not 0.0 < probability <= 1.0:
        raise InputError(f"--fault {text}: {value} is not a probability, above 0 and at most 1")
    return probability


class Ordeal:
    """What participant `who` suffers from the faults of a run that it takes part in from step `begin` on."""

    def __init__(self, faults: Iterable[Fault], who: str, *, begin: int, again: bool) -> None:
        """One that joins a run under way, `again`, does not die of the same fault again, be it of step 0."""
        self._befalls = [
            fault
            for fault in faults
            if fault.kind in ("kill", "freeze") and fault.who == who and not (again and fault.first <= begin)
        ]

    def due(self, step: int) -> list[Fault]:
        """What happens at the tick of `step`, or should have happened before; each once."""
        due = [fault for fault in self._befalls if fault.first <= step]
        for fault in due:
            self._befalls.remove(fault)
        return due


class Arriving:
    """What the faults do to the messages that arrive at a node."""

    def __init__(self, faults: Iterable[Fault], problem: Problem, node: str, *, seed: int) -> None:
        self._faults = [fault for fault in faults if fault.kind in ("mute-link", "delay", "drop")]
        self._node, self._names = node, problem.node_names
        self._i = problem.node_index(node)
        self._stream = Stream(seed=seed, stream=FAULTS, width=problem.n**2)

    def delay(self, topic: str, step: int) -> float:
        """By how many seconds a message is held up; infinity where it never arrives."""
        total = 0.0
        for fault in self._faults:
            if fault.first <= step <= fault.last:
                total += self._one(fault, topic, step)
        return total

    def _one(self, fault: Fault, topic: str, step: int) -> float:
        if fault.kind == "drop":
            if topic == MODE:
                return 0.0
            j = self._names.index(topic.split("/")[1])  # of its own measurement: the node itself
            return math.inf if self._stream.at(step)[self._i * len(self._names) + j] < fault.probability else 0.0
        if _sender(topic) != fault.who or fault.receiver not in ("", self._node):
            return 0.0
        return math.inf if fault.kind == "mute-link" else fault.seconds


def _sender(topic: str) -> str:
    if topic == MODE:
        return COORDINATOR
    return node_who(topic.split("/")[1]) if topic.endswith("/estimate") else PLANT
