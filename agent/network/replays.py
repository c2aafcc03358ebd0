"""Requests for replay: the recorder's, which alone are answered, and the answers that it waits for itself."""

from __future__ import annotations

from collections import Counter

from agent.contract.keys import RECORDER
from agent.guard import Guard
from agent.network.words import Duty, Ignored, Incoming, Replayed, Words

MOST_POSTPONED = 64  # requests


class Replays:
    """Of one participant; everything belongs to the main thread."""

    def __init__(self, guard: Guard, words: Words) -> None:
        self._guard, self._words = guard, words
        self.postponed: list[Duty] = []  # requests that cannot be answered yet
        self._unanswered: Counter[str] = Counter()  # requests, by whom they were made to

    def may_ask(self, by: str, question: Duty) -> bool | None:
        """Whether a session is the recorder's; None where it will be when the one before it is known to have gone."""
        if self._guard.trusts(RECORDER, by) or not self._guard.is_there(RECORDER, by):
            return self._guard.trusts(RECORDER, by)
        if len(self.postponed) == MOST_POSTPONED:
            return False
        self.postponed.append(question)
        return None

    def ask_again(self) -> Ignored:
        """Somebody else is the recorder now: what was postponed is asked once more."""
        postponed, self.postponed = self.postponed, []
        for question in postponed:
            self._words.put(question)
        return Ignored()

    def asked(self, who: str) -> None:
        """A request was made to `who`."""
        self._unanswered[who] += 1

    def noted(self, word: Incoming | None) -> Incoming | None:
        """The same word, once it is known whether it ends an answer."""
        if isinstance(word, Replayed):
            self._unanswered[word.who] -= 1
        return word

    def waits_for(self, who: str) -> bool:
        """Whether a request to `who` is not answered yet."""
        return self._unanswered[who] != 0
