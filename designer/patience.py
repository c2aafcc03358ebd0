"""Until when work may go on, and who asks it to end: whoever takes long looks at every step of it.

Cancellation is cooperative. A signal and the end of a budget are seen where somebody looks, and nowhere else:
KeyboardInterrupt and TimeIsUp come from there, never out of the middle of a library. What is raised for depends on what
goes on, and a `Budget` knows three kinds of work: a search, which ends at once; what there has to be, which a second
signal alone cuts short; and comparisons, which are left out where they cannot be had.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from typing import TypeVar

Made = TypeVar("Made")
_OFTEN = 5.0  # seconds between two words on what goes on

Look = Callable[[int], None]  # of how many steps are done, where that is known
Over = Callable[[], bool]  # asked before each step that may be left out


def _on(steps: int) -> None:
    """Nobody asks for an end."""


def _unknown() -> int | None:
    return None


_looks: ContextVar[Look] = ContextVar("looks", default=_on)


def never() -> bool:
    """There is no budget."""
    return False


class TimeIsUp(Exception):
    """Ends a search, as Ctrl-C does."""


def look(steps: int = 0) -> None:
    """At every step of what takes long: KeyboardInterrupt or TimeIsUp where it is to end here."""
    _looks.get()(steps)


@contextmanager
def looking(at: Look) -> Iterator[None]:
    """Within the block `look` calls this."""
    before = _looks.set(at)
    try:
        yield
    finally:
        _looks.reset(before)


class Budget:
    """Seconds for a whole design, by a clock that may be another than that on the wall; and the signals that came.

    `tell` gets words on what goes on after the search.
    """

    def __init__(self, seconds: float = math.inf, clock: Callable[[], float] = time.perf_counter) -> None:
        self.seconds, self.kept, self._later, self._clock, self._begun = seconds, 0.0, 0.0, clock, clock()
        self.asked = 0  # to end, by signals
        self.over = False  # no search comes any more
        self.left_out: list[str] = []
        self.tell: Callable[[str], None] = lambda words: None
        self._goes_on, self._told, self._steps = "", math.inf, _unknown

    @property
    def spent(self) -> float:
        return self._clock() - self._begun

    @property
    def left(self) -> float:
        """For searches."""
        return 0.0 if self.over else self._left - self.kept

    @property
    def _left(self) -> float:
        """For whatever goes on now."""
        return self.seconds - self._later - self.spent

    @property
    def is_over(self) -> bool:
        """Whether what can be left out is."""
        return self.asked > 0 or self._left <= 0.0

    def end(self) -> None:
        """No more time for a search; all that is left is for what comes after it."""
        self.over = True

    def keep(self, seconds: float) -> None:
        """So much for what comes after the search, but no more than half of all."""
        self.kept = max(self.kept, min(seconds, self.seconds / 2.0))

    @contextmanager
    def leaving(self, share: float) -> Iterator[None]:
        """Within the block so much of the time for searches is left to one that comes after it."""
        before = self._later
        self._later += share * max(self.left, 0.0) if math.isfinite(self.seconds) else 0.0
        try:
            yield
        finally:
            self._later = before

    def check(self, steps: int = 0, *, ahead: float = 0.0) -> None:
        """In a search: KeyboardInterrupt after a signal; TimeIsUp where it is, or will be in so many seconds."""
        if self.asked:
            raise KeyboardInterrupt
        if self.left <= ahead:
            raise TimeIsUp

    def check_comparison(self, steps: int = 0) -> None:
        """In what can be left out: the same, but that what was kept is there for it too."""
        if self.asked:
            raise KeyboardInterrupt
        if self.is_over:
            raise TimeIsUp

    def choosing(self, seconds: float) -> Look:
        """In a choice after the search: half of what was kept is for the proof; a signal does not end it.

        So many seconds it gets in any case.
        """
        return self._after(lambda: self._left - self.kept / 2.0, seconds)

    def proving(self, seconds: float) -> Look:
        """In a proof: the same, but all of the time is for it."""
        return self._after(lambda: self._left, seconds)

    def _after(self, left: Callable[[], float], seconds: float) -> Look:
        until = self.spent + seconds

        def check(steps: int = 0) -> None:
            self.check_last(steps)
            if left() <= 0.0 and self.spent >= until:
                raise TimeIsUp

        return check

    def over_after(self, share: float, what: str) -> Over:
        """For a search with an answer before its end, which is proved: whether so much of the time left now is gone.

        Where it is, `what` is left out. A signal does not end such a search.
        """
        until = self.spent + share * max(self._left, 0.0)

        def over() -> bool:
            gone = self.spent >= until
            if gone and what not in self.left_out:
                self.left_out.append(what)
            return gone

        return over

    def check_last(self, steps: int = 0) -> None:
        """In what there has to be: KeyboardInterrupt after the second signal; every now and then a word on it."""
        if self.asked > 1:
            raise KeyboardInterrupt
        if self.spent >= self._told:
            self._told = self.spent + _OFTEN
            whole = self._steps() if steps else None
            self.tell(self._goes_on if whole is None else f"{self._goes_on}, step {steps} of about {whole}")

    def goes_on(self, words: str, steps: Callable[[], int | None] = _unknown) -> None:
        """What is told from now on, every few seconds, of work that there has to be, and of about how many steps."""
        self._goes_on, self._told, self._steps = words, self.spent + _OFTEN, cache(steps)

    def watched(self, function: Callable[..., Made]) -> Callable[..., Made]:
        """The same in a search."""

        def watched(*given: object) -> Made:
            self.check()
            return function(*given)

        return watched

    def to_its_end(self, work: Callable[[], Made], otherwise: Callable[[], Made]) -> Made:
        """What there has to be; where a second signal cuts it short, what is soon there instead, whatever comes then.

        Where somebody else heeds signals, KeyboardInterrupt may come from anywhere: then the first one counts for none.
        """
        for _ in range(2):
            try:
                with looking(self.check_last):
                    return work()
            except KeyboardInterrupt:
                if self.asked > 1:
                    break
        with looking(_on):
            return otherwise()

    def compared(self, what: str, work: Callable[[], Made]) -> Made | None:
        """What can be left out; None where it is, as a signal came or time is up."""
        try:
            self.check_comparison()
            with looking(self.check_comparison):
                return work()
        except (KeyboardInterrupt, TimeIsUp):
            self.left_out.append(what)
            return None
