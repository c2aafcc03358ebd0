"""How those who take part in a run end together: nobody who is well leaves before the recording is closed.

Every wait ends where nothing has come for a while: on a busy machine everything takes long, but goes on.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Set

from agent.contract.messages import Acknowledged
from agent.network.replays import Replays
from agent.network.words import Incoming, Peer, Sample, Words

# Seconds of silence that end a wait.
REPLAY_SECONDS = 5.0  # the recorder's, for what it asks for at the end
CLOSE_SECONDS = 30.0  # everybody else's, for the recorder to close, as long as it is there
LEAVE_SECONDS = 5.0  # for the others to have gone, or to say why they went
FAREWELL_SECONDS = 2.0  # for the recorder to have our messages, for who is asked to go while the run goes on
THERE_SECONDS = 3.0  # for those to come who have not been seen


class Ending:
    """Of one participant; everything belongs to the main thread."""

    def __init__(self, words: Words, replays: Replays) -> None:
        self._words, self._replays = words, replays
        self.has_begun = False  # a signal then changes nothing: we go as soon as all is recorded
        self.last_word: Acknowledged | None = None  # that the recording is closed

    def replayed(self, whos: Iterable[str]) -> Iterator[Sample]:
        """Samples that are still to come, until everybody in `whos` has answered every request for replay.

        Every one: what answers an earlier request may have left before what the last one is about was published.
        """
        names = list(whos)
        for word in self._until(lambda: not any(map(self._replays.waits_for, names)), silence=REPLAY_SECONDS):
            if isinstance(word, Sample):
                yield word

    def wait_for_close(self, keepers: Set[str], heed: Callable[[Incoming | None], None]) -> Acknowledged | None:
        """Answer replays until the recorder has closed the recording; None where none of `keepers` is there before.

        `heed` gets what is heard meanwhile.
        """
        present = self._words.present
        for word in self._until(lambda: self.last_word is not None or not keepers & present, silence=CLOSE_SECONDS):
            heed(word)
        return self.last_word

    def wait_until_recorded(self, is_recorded: Callable[[], bool]) -> None:
        """Stay until the recorder has what we have published; but not for long.

        Nobody else keeps it, and the recorder may just be on its way back, to ask for it.
        """
        deadline = time.monotonic() + FAREWELL_SECONDS
        for _ in self._until(lambda: is_recorded() or time.monotonic() >= deadline, silence=FAREWELL_SECONDS):
            pass

    def wait_until_there(self, whos: Iterable[str]) -> None:
        """Wait for those who have not been seen yet; but not for long, for they may be gone."""
        names, present = set(whos), self._words.present
        for _ in self._until(lambda: names <= present, silence=THERE_SECONDS):
            pass

    def wait_until_gone(self, whos: Iterable[str], greet: Callable[[], None]) -> None:
        """Stay until they have gone, so that our last word is sure to have reached them; but not for long.

        Whoever comes only now is told it by `greet`.
        """
        names, present = set(whos), self._words.present
        for word in self._until(lambda: not names & present, silence=LEAVE_SECONDS):
            if isinstance(word, Peer) and word.present and word.who in names:
                greet()

    def _until(self, condition: Callable[[], bool], *, silence: float) -> Iterator[Incoming | None]:
        """What comes until the condition holds, or for `silence` seconds nothing has come; None as from `take`."""
        self.has_begun = True
        while not condition():
            before = self._words.taken
            word = self._replays.noted(self._words.take(time.monotonic() + silence))
            if self._words.taken == before:
                return
            yield word
