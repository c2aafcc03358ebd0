"""The network of a trial: one session that speaks for everybody but the judged node, and hears all that this one says.

A link, a token and a word of each other participant is all that a node can know of them, so it cannot tell.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from contextlib import ExitStack, closing, suppress
from queue import Empty, SimpleQueue
from typing import Any, NamedTuple

from pydantic import ValidationError

from agent.contract.closing import Closing
from agent.contract.errors import first_fault
from agent.contract.keys import (
    ACCOUNT,
    ACKNOWLEDGED,
    CONTROL,
    COORDINATOR,
    EVENT,
    estimate,
    joining,
    leaving,
    node_who,
    ready,
)
from agent.contract.messages import Acknowledged, Control, Joining, Leaving, Message, Ready, Word, tag_of
from agent.network.configuration import Network
from agent.network.outbox import Outbox
from agent.network.session import Session
from agent.network.words import Replayed, Sample
from agent.signals import interrupted_through


class Came(NamedTuple):
    """A token of the node's session."""

    session: str


class Gone(NamedTuple):
    """It is there no more."""

    session: str


class Garbled(NamedTuple):
    """A word that is none."""

    topic: str
    why: str


class Ended(NamedTuple):
    """The program has ended."""

    code: int


Heard = Came | Gone | Garbled | Ended | Sample | Joining | Ready | Leaving | Replayed


class Stage(Closing):
    """Use it with `with`. `hand_over` may be called by any thread, the rest by one.

    A signal meanwhile raises Interrupted where `next` is called, or at the end.
    """

    def __init__(self, run: str, node: str) -> None:
        self._who, self._words, self._outboxes = node_who(node), 0, dict[str, Outbox]()
        self._queue: SimpleQueue[Callable[[], Any]] = SimpleQueue()
        self._models: dict[str, type[Word]] = {
            joining(self._who): Joining,
            ready(self._who): Ready,
            leaving(self._who): Leaving,
        }
        with ExitStack() as stack:
            stack.enter_context(interrupted_through(self._queue.put))
            session = Session(Network(), run=run, who=COORDINATOR, hand_over=self._queue.put)
            self._session = stack.enter_context(closing(session))
            self.identity = self._session.identity
            self.address = self._session.locators()[0]
            self._session.watch(self._see)
            self._session.collect([estimate(node), EVENT, ACCOUNT, *self._models])
            self._opened = stack.pop_all()

    def close(self) -> None:
        """Leave, all at once: links and tokens are gone. Raises Interrupted where a signal came late."""
        self._opened.close()

    def hand_over(self, heard: Heard) -> None:
        """Have `next` return it."""
        self._queue.put(lambda: heard)

    def next(self, seconds: float) -> Heard | None:
        """What is heard next; None where it is nothing for so long."""
        deadline = time.monotonic() + seconds
        while (left := deadline - time.monotonic()) > 0.0:
            with suppress(Empty):
                heard = self._read(self._queue.get(timeout=left)())
                if isinstance(heard, Heard):
                    return heard
        return None

    # Everybody else.
    def appear(self, who: str) -> None:
        """Show the tokens of somebody."""
        self._session.appear(who)

    def advertise(self, topics: Iterable[str]) -> None:
        for topic in topics:
            self._session.advertise(topic, express=True)

    def publish(self, who: str, topic: str, message: Message, *, also: bytes = b"") -> None:
        """Send a message of somebody; `also` stands in it, too, as a later version might have it."""
        outbox = self._outboxes.setdefault(who, Outbox(who, session=tag_of(self.identity)))
        payload = message.encode()
        self._session.publish(outbox.add(topic, payload[:-1] + also + payload[-1:]))
        outbox.forget(outbox.number)

    def order(self, control: Control) -> None:
        self._say(CONTROL, control)

    def acknowledge(self, acknowledged: Acknowledged) -> None:
        self._say(ACKNOWLEDGED, acknowledged)

    def ask(self, first: int) -> None:
        """As the recorder, for the node's messages from a number on: Samples, and then Replayed."""
        self._session.request_replay(self._who, first=first, seconds=60.0)

    def _say(self, topic: str, word: Word) -> None:
        signed = word.model_copy(update={"session": self.identity, "number": self._words})
        self._words += 1
        self._session.say(topic, signed.model_dump_json().encode())

    def _see(self, who: str, session: str, present: bool) -> None:
        if who == self._who and session:
            self.hand_over(Came(session) if present else Gone(session))

    def _read(self, heard: Any) -> Any:
        """A word, where it is one."""
        model = self._models.get(heard.topic) if isinstance(heard, Sample) else None
        if model is None:
            return heard
        try:
            return model.model_validate_json(heard.payload)
        except ValidationError as error:
            return Garbled(heard.topic, f"not a {model.__name__}: {first_fault(error, {})}")
