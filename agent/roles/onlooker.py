"""Whoever looks on: hears what a run publishes, who is there, and what run it is. It takes no part in it.

Publishers send to it what it has time for, so that it holds up nobody, even where it stands still. So it may miss
messages, and is never used for recording.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Set
from contextlib import closing, contextmanager
from types import FrameType
from typing import NoReturn

from pydantic import ValidationError

from agent.contract.errors import InputError, Interrupted, RunBroken, listed
from agent.contract.keys import COORDINATOR, FACTS, VIEWER
from agent.contract.messages import Facts
from agent.network.arrivals import Arrival, Arrivals
from agent.network.configuration import Network
from agent.network.session import Channel, Session
from agent.network.words import Sample, Words
from agent.signals import heed, interrupted_through, restore

ASK_SECONDS = 1.0  # what is not answered by then is asked again
AMONG_SECONDS = 0.2  # after the first run that is found, others have so long to show themselves


class Onlooker:
    """Looks on at one run, from the moment at which its coordinator was found."""

    def __init__(self, session: Session, words: Words, heard: Channel, run: str) -> None:
        self.run = run
        self.facts: Facts | None = None  # what run this is, as soon as somebody has answered
        self._session, self._words = session, words
        self._arrivals = Arrivals([heard.next])
        self._asked = -ASK_SECONDS

    def until(self, deadline: float) -> Iterator[Arrival[Sample]]:
        """What was published, with the time at which it arrived here; ends at the deadline, by time.monotonic()."""
        while time.monotonic() < deadline:
            yield from self._arrivals.until(deadline)

    def heed(self) -> None:
        """Note who has come and gone, and what is answered; it asks for the facts until there is an answer."""
        now = time.monotonic()
        if self.facts is None and now >= self._asked + ASK_SECONDS:
            self._asked = now
            self._session.ask(FACTS, _facts, seconds=ASK_SECONDS)
        taken = -1
        while self._words.taken != taken:
            taken = self._words.taken
            match self._words.take(now):
                case Facts() as facts:
                    self.facts = facts

    @property
    def present(self) -> Set[str]:
        """Who takes part just now, as far as was heeded."""
        return self._words.present


@contextmanager
def looking_on(network: Network, *, run: str | None) -> Iterator[Onlooker]:
    """Look on at `run`, or at the one run that is there; a signal ends it as Interrupted.

    Raises RunBroken where there is none within `network.wait` seconds, InputError where there are several.
    """
    name = find_run(network) if run is None else run
    words = Words("")
    with viewing(network, name, words) as session:
        heard = session.overhear()
        session.watch(words.see)
        wait_for_coordinator(words, name, network.wait)
        onlooker = Onlooker(session, words, heard, name)
        onlooker.heed()
        yield onlooker


def find_run(network: Network) -> str:
    """The name of the only run on this network."""
    words = Words("")
    with viewing(network, "", words) as session:
        session.watch_runs(lambda run: words.see(run, "", True))
        if not _until(words, lambda: bool(words.present), network.wait):
            where = ", ".join(network.connect)
            raise RunBroken(f"no run was found at {where} within {network.wait:g} s")
        _until(words, lambda: len(words.present) > 1, AMONG_SECONDS)
    names = sorted(words.present)
    if len(names) > 1:
        raise InputError(f"there are the runs {listed(names)}; choose one with --run")
    return names[0]


def wait_for_coordinator(words: Words, run: str, seconds: float) -> None:
    """Until it is there; RunBroken where that takes longer."""
    if not _until(words, lambda: COORDINATOR in words.present, seconds):
        raise RunBroken(f'the coordinator of run "{run}" was not found within {seconds:g} s')


def _until(words: Words, condition: Callable[[], bool], seconds: float) -> bool:
    """Take words until the condition holds; False where it does not within so many seconds."""
    deadline = time.monotonic() + seconds
    while not condition():
        if time.monotonic() >= deadline:
            return False
        words.take(deadline)
    return True


@contextmanager
def viewing(network: Network, run: str, words: Words) -> Iterator[Session]:
    """A session that hands its duties to `words`. A signal that asks for an end is raised as Interrupted: wherever it
    finds us while the session is opened, from then on where words are taken; a terminal that is closed is one.
    """

    def stop(number: int, frame: FrameType | None) -> NoReturn:
        raise Interrupted(number)

    before = heed(stop)
    try:
        session = Session(network, run=run, who=VIEWER, hand_over=words.put)
        with interrupted_through(words.put), closing(session):
            yield session
    finally:
        restore(before)


def _facts(payload: bytes) -> Facts | None:
    """None for what is not peakmesh's: somebody else may answer too."""
    try:
        return Facts.model_validate_json(payload)
    except ValidationError:
        return None
