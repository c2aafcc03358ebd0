"""The start barrier: how those who take part in a run meet, and what is said where they cannot.

The coordinator knows the most: it hears where everybody is, and whom they lack (`acquaintance`). So the others, once
they have reached it, wait a little longer than it does, and end with its sentence.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator
from importlib.metadata import version
from typing import TypeVar

from agent.contract.errors import InputError, RunBroken
from agent.contract.keys import CONTROL, COORDINATOR, RECORDER, in_words, joining
from agent.contract.messages import Control, Joining, Leaving, Ready, Word
from agent.network.acquaintance import Acquaintance, stray_sensor
from agent.network.addresses import machine
from agent.network.configuration import Network
from agent.network.words import Incoming, Namesake, Orphaned, Peer, RunClosed, UnderWay, Words

# Seconds
WORD_SECONDS = 5.0  # for the coordinator's word on why somebody went, or why nothing starts
REASON_SECONDS = 0.2  # for somebody who has gone to have said why; its words and its end come by different queues
QUIET_SECONDS = 3.0  # for those who are still to come, where the run cannot be

T = TypeVar("T")


class Barrier:
    """Participant `who`, with the session `identity`, before the start; everything belongs to the main thread."""

    def __init__(
        self,
        network: Network,
        *,
        run: str,
        who: str,
        identity: str,
        words: Words,
        say: Callable[[str, Word], None],
        heed_namesake: Callable[[str], None],
    ) -> None:
        self.network, self._run, self._who, self._identity = network, run, who, identity
        self._words, self._say, self._heed_namesake = words, say, heed_namesake
        self._is_coordinator = who == COORDINATOR
        self._expected: set[str] = set()  # who takes part
        self._absent: set[str] = set()  # whom we have still to meet
        self._deadline = math.inf
        self._left = ""  # who went away
        self._over: Control | None = None  # the run is, for the others
        self._fault: InputError | None = None  # why the run cannot be
        self._acquaintance = Acquaintance(self._joining())  # the coordinator's
        self.warn: Callable[[str], None] = lambda sentence: None  # the coordinator's, of those who join

    def meet(self, others: Iterable[str]) -> Iterator[str]:
        """Wait for everybody's token, and yield who has come; RunBroken names who is missing when time is over."""
        self._expected = set(others) - {self._who}
        self._absent = set(self._expected)
        self._deadline = time.monotonic() + self.network.wait
        while self._absent:
            peer = self._wait_for(Peer, missing=self._absent)
            if peer.who in self._absent:
                self._absent.remove(peer.who)
                yield peer.who
            elif peer.present and peer.who not in self._expected and (doubt := stray_sensor(peer.who)):
                self.warn(doubt)

    def gather(self, others: Iterable[str]) -> dict[str, Ready]:
        """The coordinator's: wait until everybody has met everybody. InputError where a name is there twice."""
        answers: dict[str, Ready] = {}
        unready = set(others) - {self._who}
        if self._fault is not None:
            raise self._fault
        self._deadline = max(self._deadline, time.monotonic() + self._grace)
        while unready:
            answer = self._wait_for(Ready, missing=unready)
            if answers.setdefault(answer.who, answer).session != answer.session:
                raise InputError(f"{in_words(answer.who)} takes part twice; start it once")
            unready.discard(answer.who)
        return answers

    def wait_for_start(self) -> Control:
        """The coordinator's order to start, with the facts of the run."""
        self._deadline = time.monotonic() + self.network.wait + 2.0 * self._grace
        return self._wait_for(Control, missing={COORDINATOR})

    @property
    def _grace(self) -> float:
        """Seconds by which whoever knows less waits longer."""
        return min(WORD_SECONDS, self.network.wait)

    def _wait_for(self, kind: type[T], *, missing: set[str]) -> T:
        """The next word of one kind; what else comes is kept for `Bus.receive`."""
        if (early := self._words.early(kind)) is not None:
            return early
        self._left = ""
        while True:
            deadline = self._deadline
            if self._fault is not None:
                deadline = min(deadline, time.monotonic() + QUIET_SECONDS)
            word = self._words.take(deadline)
            if word is None:
                if time.monotonic() >= deadline:
                    if self._over is not None:
                        raise RunClosed(self._over)
                    raise self._fault or RunBroken(self._why_not(missing, kind))
            elif not self._heed(word, kind):
                if isinstance(word, kind):
                    return word
                self._words.set_aside(word)

    def _heed(self, word: Incoming, kind: type[object]) -> bool:
        """Deal with what is of the barrier; whether that was all. Raises where no start is to be waited for."""
        match word:
            case Control(order="close" | "stop", step=step) if step and self._who == RECORDER:
                self._over = word  # but the others still keep what was not recorded: it may yet be asked to join
            case Control(order="close" | "stop"):
                raise RunClosed(word)
            case Control(order="start", step=step, cast=cast) if step:
                if cast.get(self._who) == self._identity:  # told to us, and to no namesake
                    raise UnderWay(word)
            case Ready(underway=True) if self._who == COORDINATOR:  # the recorder hears it, too
                raise Orphaned(word)
            case Namesake(identity=identity):
                self._heed_namesake(identity)
            case Control(order="tell"):
                self._say(joining(self._who), self._joining())
            case Joining():
                self._get_to_know(word)
            case Leaving(who=who):
                if who == self._left:
                    self._deadline = 0.0  # there is nothing more to wait for
            case Peer(who=who, present=False) if who in self._expected:
                self._left = self._left or who
                seconds = REASON_SECONDS if self._is_coordinator else WORD_SECONDS
                self._deadline = min(self._deadline, time.monotonic() + seconds)
            case Peer(who="coordinator", present=True) if not self._is_coordinator:
                self._say(joining(self._who), self._joining())
                self._deadline = max(self._deadline, time.monotonic() + self.network.wait + 2.0 * self._grace)
                return False
            case _:
                return False
        return True

    def _joining(self) -> Joining:
        return Joining(
            who=self._who,
            session=self._identity,
            version=version("peakmesh"),
            listen=self.network.listen,
            machine=machine(),
            lease=self.network.lease,
            lacks=sorted(self._absent),
        )

    def _get_to_know(self, joining: Joining) -> None:
        """What is wrong with those who are there is said once all are, or nobody comes any more: so it reaches all."""
        try:
            if warning := self._acquaintance.heed(joining):
                self.warn(warning)
        except InputError as fault:
            self._fault = self._fault or fault
            if not self._absent:
                raise

    def _why_not(self, missing: set[str], kind: type[object]) -> str:
        """Why there is no start when time is over."""
        seconds, names = self.network.wait, " and ".join(map(in_words, sorted(missing)))
        if self._left:
            reason = self._words.reasons.get(self._left)
            return f"{in_words(self._left)} left before the run had started{f'; it said: {reason}' if reason else ''}"
        if self._words.alone and self.network.connect:
            where = ", ".join(self.network.connect)
            return self.network.refusal() or (
                f'nobody of run "{self._run}" answered at {where} within {seconds:g} s; '
                "is the coordinator running there, under the same --run?"
            )
        if self._is_coordinator and kind is Ready:
            return self._strangers(missing)
        if self._is_coordinator or COORDINATOR not in self._words.present:
            return f"{names} did not join the run within {seconds:g} s"
        if kind is Control:
            return f"the coordinator did not start the run within {seconds:g} s; it waits for others"
        return (
            f"{in_words(self._who)}, which listens at {self.network.listen}, has reached the coordinator, but within "
            f"{seconds:g} s not {names}"
        )

    def _strangers(self, unready: set[str]) -> str:
        """Ask those who are not ready whom they lack, and say why they are not."""
        self._say(CONTROL, Control(order="tell", steps=0, seed=0, window=0, external=[], reason=""))
        waiting, deadline = set(unready), time.monotonic() + self._grace
        while waiting and time.monotonic() < deadline:
            word = self._words.take(deadline)
            if isinstance(word, Joining):
                self._get_to_know(word)
                waiting.discard(word.who)
        return self._acquaintance.strangers(unready, seconds=self.network.wait)
