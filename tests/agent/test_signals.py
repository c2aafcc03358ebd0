"""A signal is raised where a duty is done, and nowhere else: not in a callback, which would lose it."""

from __future__ import annotations

import signal
from collections.abc import Callable
from queue import SimpleQueue

import pytest

from agent.contract.errors import Interrupted
from agent.signals import interrupted_through


@pytest.mark.usefixtures("ctrl_c")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_callback_goes_on_and_the_duty_raises(number: signal.Signals) -> None:
    duties, done = SimpleQueue[Callable[[], None]](), list[str]()

    def callback() -> None:
        signal.raise_signal(number)
        done.append("callback")

    def work() -> None:
        callback()
        done.append("after it")
        duties.get_nowait()()
        done.append("never")

    with pytest.raises(Interrupted) as caught, interrupted_through(duties.put):
        work()
    assert caught.value.exit_code == Interrupted(number).exit_code
    assert done == ["callback", "after it"]


@pytest.mark.usefixtures("ctrl_c")
def test_whoever_does_no_duty_is_interrupted_at_the_end() -> None:
    with pytest.raises(Interrupted), interrupted_through(lambda duty: None):
        signal.raise_signal(signal.SIGINT)


@pytest.mark.usefixtures("ctrl_c")
def test_afterwards_signals_do_what_they_did() -> None:
    with interrupted_through(lambda duty: None):
        pass
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)
