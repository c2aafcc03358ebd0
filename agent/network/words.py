"""What a participant hears: messages of the run, who comes and goes, the coordinator's and the recorder's word.

Everything that the main thread must deal with waits in one queue, `Words`, in the order in which it came.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import suppress
from queue import Empty, SimpleQueue
from typing import Any, NamedTuple, TypeVar

from agent.contract.errors import InputError
from agent.contract.messages import Acknowledged, Control, Facts, Joining, Leaving, Ready, Refusals, Stamp


class Sample(NamedTuple):
    """A data message as it came in. `stamp` is None where the sender left it out; `flaw` is a kind of agent.guard.

    `trace` is Zenoh's record of when it was where; see `session.way_of`.
    """

    topic: str
    payload: bytes
    stamp: Stamp | None
    flaw: str = ""
    trace: Any = None


class Peer(NamedTuple):
    """Somebody who has come or gone. `succeeds`: another process of that name was there, and is gone."""

    who: str
    present: bool
    succeeds: bool = False


class Namesake(NamedTuple):
    """A session of somebody with our name, ours among them."""

    identity: str


class Replayed(NamedTuple):
    """The answers of `who` to a request for replay are complete."""

    who: str


class Ignored(NamedTuple):
    """A word that was refused: as if nothing had come."""


class Quota:
    """How much of one origin may wait; one thread lets in, another lets out."""

    def __init__(self, most: int) -> None:
        self._most, self._in, self._out = most, 0, 0

    def enter(self) -> bool:
        """False where there is no room."""
        if self._in - self._out >= self._most:
            return False
        self._in += 1
        return True

    def leave(self) -> None:
        self._out += 1


Said = Control | Acknowledged | Joining | Leaving | Ready | Refusals
Incoming = Sample | Peer | Namesake | Said | Replayed | Facts | Ignored
Duty = Callable[[], Incoming | None]  # decodes a word, or does what was asked for; called on the main thread
T = TypeVar("T")


class RunClosed(Exception):
    """The run is over; `control` says how."""

    def __init__(self, control: Control) -> None:
        super().__init__(control.reason)
        self.control = control


class UnderWay(Exception):
    """Raised while others are waited for: the run has begun without us."""

    def __init__(self, start: Control) -> None:
        super().__init__()
        self.start = start


class Orphaned(Exception):
    """Raised at a coordinator that waits for others: the run has begun, and `ready` was in it."""

    def __init__(self, ready: Ready) -> None:
        super().__init__()
        self.ready = ready


class Refused(InputError):
    """Our place is taken: another process has our name in this run."""


class ChannelClosed(Exception):
    """Raised by `Channel.next` when this participant leaves, and by `Bus.publish` when the run is over."""


class Words:
    """The main thread's queue. Any thread may `put`; the main thread alone takes, so that failures end the process."""

    def __init__(self, who: str, *, meanwhile: Callable[[], float] = lambda: math.inf) -> None:
        """`meanwhile` is done while nothing comes; it says when to do it again, on time.monotonic()."""
        self._meanwhile = meanwhile
        self.present: set[str] = set()  # whose token is there
        self.reasons: dict[str, str] = {}  # why those have gone who have said so
        self.alone = True  # nobody else of this run has been heard
        self.taken = 0  # duties done so far
        self._who = who
        self._queue: SimpleQueue[Duty] = SimpleQueue()
        self._early: list[Incoming] = []  # what came while something else was waited for

    def put(self, duty: Duty) -> None:
        self._queue.put(duty)

    def see(self, who: str, identity: str, present: bool) -> None:
        """Somebody has come or gone; whoever only looks on believes it as it is."""
        self.put(lambda: Peer(who, present))

    def next(self, deadline: float) -> Incoming | None:
        """The next word, what was set aside first; None as from `take`."""
        return self._early.pop(0) if self._early else self.take(deadline)

    def take(self, deadline: float) -> Incoming | None:
        """The next word; None at the deadline, or where a duty was done without one. Raises what a duty does."""
        word: Incoming | None = Ignored()
        while isinstance(word, Ignored):
            left = min(deadline, self._meanwhile()) - time.monotonic()
            with suppress(Empty):
                word = self._queue.get(timeout=None if left == math.inf else max(0.0, left))()
            if isinstance(word, Ignored) and time.monotonic() >= deadline:
                return None
        self.taken += 1
        is_own = isinstance(word, Namesake) or (isinstance(word, Peer) and word.who == self._who)
        if word is not None and not is_own:
            self.alone = False
        match word:
            case Peer(who=who, present=True):
                self.present.add(who)
            case Peer(who=who) if is_own:
                return None  # a namesake has gone; we have not
            case Peer(who=who):
                self.present.discard(who)
            case Leaving(who=who, reason=reason):
                self.reasons[who] = reason
        return word

    def set_aside(self, word: Incoming) -> None:
        """Keep a word for `next`."""
        self._early.append(word)

    def early(self, kind: type[T]) -> T | None:
        """The first word of one kind that was set aside."""
        for word in self._early:
            if isinstance(word, kind):
                self._early.remove(word)
                return word
        return None
