"""What a participant has published: numbered, and kept until the recorder has acknowledged it.

A run in lock-step waits for its recorder; one against the clock does not, and keeps no more than `most` bytes for one
that stays away: the oldest messages go, and are lost for the record.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Iterator
from typing import NamedTuple

from agent.contract.messages import Stamp, digest_of


class Sent(NamedTuple):
    """A data message as it goes out."""

    topic: str
    payload: bytes
    stamp: Stamp


class Outbox:
    """The messages of `who`. One thread may add while another forgets and replays."""

    def __init__(self, who: str, *, session: bytes = b"") -> None:
        """`session` is the tag of the session that they are sent in."""
        self._who, self._session = who, session
        self._number = 0  # of the next message
        self._kept: deque[Sent] = deque()
        self._bytes = 0  # of what is kept
        self._lock = threading.Lock()  # held by whoever lets go of something
        self._has_sent = False
        self.most = math.inf  # bytes
        self.dropped = 0  # messages that the recorder had not acknowledged

    def __len__(self) -> int:
        return len(self._kept)

    @property
    def has_sent(self) -> bool:
        """Whether this process has sent any."""
        return self._has_sent

    @property
    def number(self) -> int:
        """Of the next message: so many were sent, in this process and those before it."""
        return self._number

    def add(self, topic: str, payload: bytes) -> Sent:
        """Number a message, say what is in it, and keep it."""
        stamp = Stamp(self._number, time.time_ns(), self._who, digest_of(topic, payload), self._session)
        sent = Sent(topic, payload, stamp)
        self._number += 1
        self._has_sent = True
        with self._lock:
            self._kept.append(sent)
            self._bytes += _size(sent)
            while self._bytes > self.most and len(self._kept) > 1:
                self._bytes -= _size(self._kept.popleft())
                self.dropped += 1
        return sent

    def go_on(self, number: int) -> None:
        """Number what follows from here on: a process before this one has used the numbers below."""
        self._number = number

    def since(self, first: int) -> Iterator[Sent]:
        """What is kept, from number `first` on."""
        return (sent for sent in tuple(self._kept) if sent.stamp.number >= first)

    def forget(self, received: int) -> None:
        """Drop the first `received` messages: the recorder has them."""
        with self._lock:
            while self._kept and self._kept[0].stamp.number < received:
                self._bytes -= _size(self._kept.popleft())


def _size(sent: Sent) -> int:
    """In memory, about: the stamp, its digest and the rest take 320 bytes beside the payload."""
    return len(sent.payload) + 320
