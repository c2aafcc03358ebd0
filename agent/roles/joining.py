"""How every participant but the coordinator joins a run, and how it leaves."""

from __future__ import annotations

from collections.abc import Callable

from agent.bus import Bus, RunClosed
from agent.contract.errors import RunBroken
from agent.contract.gains import Gains
from agent.contract.messages import Control, participants


def join(bus: Bus, gains: Gains) -> Control:
    """Enter, meet everybody, say so, and wait for the start. Topics must be declared before."""
    bus.enter()
    bus.meet(participants(gains.problem))
    bus.report_ready(gains.digest())
    return bus.wait_for_start()


def take_part(bus: Bus, role: Callable[[], None]) -> None:
    """Run a publisher's role, and stay until the recorder has closed the recording.

    Raises RunBroken where the run was stopped, or may lack something.
    """
    try:
        role()
    except RunClosed as closed:
        last_word = bus.wait_for_close()
        if closed.control.order == "stop":
            raise RunBroken(closed.control.reason) from None
        if last_word is None:
            raise RunBroken("the recorder did not say that the recording is closed; it may lack messages") from None
