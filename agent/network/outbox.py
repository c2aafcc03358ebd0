"""What a participant has published: numbered, and kept until the recorder has acknowledged it."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterator
from typing import NamedTuple

from agent.contract.messages import Stamp


class Sent(NamedTuple):
    """A data message as it goes out."""

    topic: str
    payload: bytes
    stamp: Stamp


class Outbox:
    """The messages of `who`. One thread may add while another forgets and replays."""

    def __init__(self, who: str) -> None:
        self._who = who
        self._number = 0  # of the next message
        self._kept: deque[Sent] = deque()

    def __len__(self) -> int:
        return len(self._kept)

    def add(self, topic: str, payload: bytes) -> Sent:
        """Number a message and keep it."""
        sent = Sent(topic, payload, Stamp(self._number, time.time_ns(), self._who))
        self._number += 1
        self._kept.append(sent)
        return sent

    def since(self, first: int) -> Iterator[Sent]:
        """What is kept, from number `first` on."""
        return (sent for sent in tuple(self._kept) if sent.stamp.number >= first)

    def forget(self, received: int) -> None:
        """Drop the first `received` messages: the recorder has them."""
        while self._kept and self._kept[0].stamp.number < received:
            self._kept.popleft()
