"""What a node must say, and the first thing that it says otherwise. Pure."""

from __future__ import annotations

import json
import struct
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydantic import ValidationError

from agent.contract.errors import first_fault
from agent.contract.gains import NodeGains
from agent.contract.keys import estimate, model_of, node_who
from agent.contract.messages import Estimate, Message, Stamp, digest_of, tag_of
from agent.estimates import told
from agent.filter import Pair, innovation, step

_VECTORS = ("x_hat", "innovation", "z_hat")
_ROUNDING = 1e-9  # of the largest number: what is off by less is off by rounding


@dataclass
class Difference(Exception):
    """The node is none of this run: `says` is the whole sentence, the rest its parts, as far as there are any."""

    says: str
    step: int | None = None
    field: str = ""
    value: Any = None
    wanted: Any = None

    def __str__(self) -> str:
        return self.says


class Judge:
    """Examines what a node sends, in the order in which it comes. `tolerance` is of the largest number of a vector."""

    def __init__(self, own: NodeGains, *, session: str, first: int = 0, tolerance: float = 0.0) -> None:
        """`session` is that of its token, `first` the number of its first message."""
        self._own, self._who, self._session, self._tolerance = own, node_who(own.node), session, tolerance
        self._number = first

    def read(self, topic: str, payload: bytes, stamp: Stamp | None, *, flaw: str = "") -> Message:
        """A message, once its stamp and its form are right."""
        if stamp is None:
            why = "has a stamp that nobody can read" if flaw else "has no stamp: no attachment"
            raise Difference(f"a message on {topic} {why}", field="stamp")
        if flaw:
            raise Difference(f"a message on {topic} stands under the key of another than its sender", field="key")
        number, self._number = self._number, self._number + 1
        marks: dict[str, tuple[Any, Any]] = {
            "sender": (stamp.sender, self._who),
            "number": (stamp.number, number),
            "digest": (stamp.digest.hex(), digest_of(topic, payload).hex()),
            "session": (stamp.session.hex(), tag_of(self._session).hex()),
        }
        for field, (value, wanted) in marks.items():
            if value != wanted:
                raise _differs(_step_of(payload), f"stamp.{field}", value, wanted)
        model = model_of(topic)
        assert model is not None
        try:
            return model.decode(payload)
        except ValidationError as error:
            fault = first_fault(error, {})
            raise Difference(f"a message on {topic} is not a {model.__name__}: {fault}", _step_of(payload)) from None

    def compare(self, message: Estimate, wanted: Estimate) -> None:
        """Raise Difference at the first field that is not as it must be; numbers are held bit against bit."""
        if message.step != wanted.step:
            raise _differs(message.step, "step", message.step, wanted.step)
        for field in ("mode", "measured", "origin"):
            self._same(message, wanted, field)
        if sorted(message.heard) != sorted(wanted.heard):
            raise _differs(message.step, "heard", message.heard, wanted.heard)
        for field in _VECTORS:
            self._hold(message.step, field, getattr(message, field), getattr(wanted, field))

    def _same(self, message: Estimate, wanted: Estimate, field: str) -> None:
        value, right = getattr(message, field), getattr(wanted, field)
        if value != right:
            raise _differs(message.step, field, value, right)

    def _hold(self, k: int, field: str, values: list[float], wanted: list[float]) -> None:
        if len(values) != len(wanted):
            raise _differs(k, f"the length of {field}", len(values), len(wanted))
        largest = max(map(abs, wanted), default=0.0)
        for place, (value, right) in enumerate(zip(values, wanted, strict=True)):
            off = abs(value - right)
            if _bits(value) != _bits(right) and (not self._tolerance or off > self._tolerance * largest):
                raise _differs(k, f"{field}[{place}]", value, right, _hint(off, largest))

    # What is right, from what the node has told before: so a difference is of its own step, and none follows from it.
    def first(self, y: Iterable[float] | None) -> Estimate:
        """Of step 0."""
        return self._told(0, np.zeros(self._own.M.shape[1]), y, "", [])

    def following(self, before: Estimate, mode: str, heard: dict[str, Estimate], y: Iterable[float] | None) -> Estimate:
        """After what it has told of the step before; `heard` are the others, `y` is None without a measurement."""
        pairs = {self._own.node: before} | heard
        there = {link.sender for link in self._own.links[mode]} & pairs.keys()
        found = {
            sender: Pair(np.array(pairs[sender].x_hat), np.array(pairs[sender].innovation)) for sender in sorted(there)
        }
        x_hat = step(self._own, mode, found)
        return self._told(before.step + 1, x_hat, y, mode, sorted(there))

    def beginning(self, k: int, x_hat: Iterable[float], origin: str) -> Estimate:
        """Where a node of a paced run begins again."""
        nothing = np.zeros(len(self._own.C))
        return told(self._own, k, Pair(np.array(list(x_hat)), nothing), measured=False, origin=origin)

    def _told(self, k: int, x_hat: Any, y: Iterable[float] | None, mode: str, heard: list[str]) -> Estimate:
        nu = np.zeros(len(self._own.C)) if y is None else innovation(self._own, np.array(list(y)), x_hat)
        return told(self._own, k, Pair(x_hat, nu), mode=mode, heard=heard, measured=y is not None)

    @property
    def topic(self) -> str:
        """Where the node publishes its estimates."""
        return estimate(self._own.node)


def _differs(k: int | None, field: str, value: Any, wanted: Any, hint: str = "") -> Difference:
    where = f"step {k}: " if k is not None else ""
    says = f"{where}{field} is {_shown(value)}, must be {_shown(wanted)}{hint}"
    return Difference(says, k, field, value, wanted)


def _shown(value: Any) -> str:
    return json.dumps(value) if not isinstance(value, str) or not value else value


def _hint(off: float, largest: float) -> str:
    if off > _ROUNDING * largest:
        return ""
    return f", off by {off:.1e}: sums in another order, or fused; or give --tolerance"


def _bits(value: float) -> bytes:
    return struct.pack("<d", value)


def _step_of(payload: bytes) -> int | None:
    try:
        found = json.loads(payload)["step"]
    except (ValueError, LookupError, TypeError):
        return None
    return found if isinstance(found, int) else None
