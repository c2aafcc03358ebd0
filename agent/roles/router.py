"""The router: takes part in no run, and passes on what those say who are connected to it."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from queue import SimpleQueue
from types import FrameType

from agent.network.configuration import Network
from agent.network.session import Session
from agent.signals import heed, restore


def run(network: Network, *, say: Callable[[list[str]], None]) -> None:
    """Until a signal asks it to end; `say` gets the addresses at which it can be reached."""
    asked = SimpleQueue[int]()

    def stop(number: int, frame: FrameType | None) -> None:
        asked.put(number)

    handlers = heed(stop)
    try:
        with closing(Session(network, run="", who="router", hand_over=lambda duty: None)) as session:
            say(session.locators())
            asked.get()
    finally:
        restore(handlers)
