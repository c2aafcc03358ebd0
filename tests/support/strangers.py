"""Strangers in the network of a run: plain zenoh, and whatever can be done with it."""

from __future__ import annotations

import json
import queue
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import zenoh
from runs import PATIENCE

from agent.contract.messages import Stamp

BLOCK = zenoh.CongestionControl.BLOCK


class Heard(NamedTuple):
    topic: str
    payload: bytes
    attachment: bytes | None

    @property
    def document(self) -> Any:
        return json.loads(self.payload)


class Stranger:
    """A peer in the mesh of run `run`; use `stranger`."""

    def __init__(self, session: zenoh.Session, run: str) -> None:
        self.session, self._base = session, f"peakmesh/{run}/"
        self._held: list[Any] = []
        self.answers = 0  # given to whoever asked

    def put(self, topic: str, payload: object, stamp: Stamp | bytes | None = None) -> None:
        data = payload if isinstance(payload, bytes) else json.dumps(payload).encode()
        attachment = stamp.encode() if isinstance(stamp, Stamp) else stamp
        self.session.put(self._base + topic, data, attachment=attachment, congestion_control=BLOCK)

    def listen(self, topic: str) -> queue.SimpleQueue[Heard]:
        """What comes on a topic."""
        heard: queue.SimpleQueue[Heard] = queue.SimpleQueue()

        def hear(sample: zenoh.Sample) -> None:
            attachment = sample.attachment
            heard.put(
                Heard(
                    str(sample.key_expr).removeprefix(self._base),
                    sample.payload.to_bytes(),
                    None if attachment is None else attachment.to_bytes(),
                )
            )

        self._held.append(self.session.declare_subscriber(self._base + topic, hear))
        return heard

    def tokens(self, pattern: str) -> queue.SimpleQueue[str]:
        """The topics of tokens that are shown, or come."""
        seen: queue.SimpleQueue[str] = queue.SimpleQueue()

        def see(sample: zenoh.Sample) -> None:
            if sample.kind == zenoh.SampleKind.PUT:
                seen.put(str(sample.key_expr).removeprefix(self._base))

        liveliness = self.session.liveliness()
        self._held.append(liveliness.declare_subscriber(self._base + pattern, see, history=True))
        return seen

    def show(self, topic: str) -> Callable[[], None]:
        """Show a token; returns what withdraws it."""
        token = self.session.liveliness().declare_token(self._base + topic)
        self._held.append(token)  # zenoh withdraws what nobody holds

        def withdraw() -> None:
            self._held.remove(token)
            token.undeclare()

        return withdraw

    def ask(self, topic: str) -> list[Any]:
        """The answers to a question."""
        return [reply.ok for reply in self.session.get(self._base + topic, timeout=PATIENCE) if reply.ok is not None]

    def answer(self, topic: str, *replies: tuple[str, bytes, bytes | None]) -> None:
        """Answer whatever is asked there; a reply has its whole key."""

        def reply(query: zenoh.Query) -> None:
            self.answers += 1
            with query:
                for key, payload, attachment in replies:
                    query.reply(key, payload, attachment=attachment)

        self._held.append(self.session.declare_queryable(self._base + topic, reply))

    def release(self) -> None:
        for each in reversed(self._held):
            each.undeclare()


@contextmanager
def stranger(address: str, run: str = "test") -> Iterator[Stranger]:
    config = zenoh.Config()
    config.insert_json5("connect/endpoints", json.dumps([address]))
    config.insert_json5("listen/endpoints", '["tcp/127.0.0.1:0"]')
    config.insert_json5("scouting/multicast/enabled", "false")
    with zenoh.open(config) as session:
        found = Stranger(session, run)
        try:
            yield found
        finally:
            found.release()


def until(condition: Callable[[], object], what: str) -> None:
    deadline = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < deadline, what
        time.sleep(0.01)
