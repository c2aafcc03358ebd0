"""The network of a trial, and signals that come while it is there."""

from __future__ import annotations

import signal

import pytest
from runs import PATIENCE

from agent.conform.stage import Stage
from agent.contract.errors import Interrupted


def test_a_signal_is_raised_where_something_is_waited_for(ctrl_c: None) -> None:
    """Not where it comes: what a program has been started for must be known by then to whoever ends it."""
    before = signal.getsignal(signal.SIGTERM)
    with Stage("test", "1") as stage:
        signal.raise_signal(signal.SIGTERM)
        with pytest.raises(Interrupted) as caught:
            stage.next(PATIENCE)
    assert caught.value.exit_code == 128 + signal.SIGTERM
    assert signal.getsignal(signal.SIGTERM) is before


def test_a_signal_that_comes_late_is_raised_at_the_end(ctrl_c: None) -> None:
    stage = Stage("test", "1")
    signal.raise_signal(signal.SIGINT)
    with pytest.raises(Interrupted):
        stage.close()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
