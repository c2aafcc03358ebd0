"""How words are heard: decoded by the main thread, and admitted by the guard, or refused and counted."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from pydantic import ValidationError

from agent.contract.keys import COORDINATOR, RECORDER
from agent.contract.messages import Acknowledged, Control, Joining, Leaving, Ready, Refusals
from agent.guard import FLOOD, OVERSIZED, UNREADABLE, Guard, Unfit
from agent.network.session import Session
from agent.network.words import Ignored

LONGEST_WORD = 1 << 20  # bytes

Said = TypeVar("Said", Control, Acknowledged, Joining, Leaving, Ready, Refusals)


class Hearing:
    """Of one participant."""

    def __init__(self, session: Session, guard: Guard) -> None:
        self._session, self._guard = session, guard

    def listen(self, topic: str, model: type[Said], *, heed: Callable[[Said], None] = lambda word: None) -> None:
        """Have the words of a topic handed over; `heed` sees each before, and may raise Unfit."""
        name = topic.partition("/")[0]

        def decode(payload: bytes) -> Said | Ignored:
            try:
                if len(payload) > LONGEST_WORD:
                    raise Unfit(OVERSIZED)
                word = model.model_validate_json(payload)
                self._guard.admit_word(_speaker(word), name, word, second=not isinstance(word, Acknowledged | Control))
                heed(word)
                return word
            except ValidationError:
                self._guard.refuse(name, UNREADABLE)
            except Unfit as unfit:
                self._guard.refuse(name, unfit.kind)
            return Ignored()

        self._session.listen(topic, decode, overflow=lambda: self._guard.refuse(name, FLOOD))


def _speaker(word: Said) -> str:
    """Who says such a word."""
    match word:
        case Ready() | Refusals() | Joining() | Leaving():
            return word.who
        case Acknowledged():
            return RECORDER
    return COORDINATOR
