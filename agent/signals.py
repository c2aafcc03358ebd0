"""Which signals ask a program to end: SIGTERM always, SIGINT and SIGHUP unless it was started with them ignored.

A shell starts with SIGINT ignored what a script puts in the background (`peakmesh run ... &`), so that Ctrl-C reaches
only what stands in the foreground; nohup does the same for SIGHUP, which comes where a terminal is closed. Whoever
wants such a program to end sends SIGTERM.
Processes that it starts inherit what is ignored.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, NoReturn

from agent.contract.errors import Interrupted

Handler = Callable[[int, FrameType | None], None]
Handlers = dict[int, Any]  # of signals; what signal.signal returns


def heed(handler: Handler) -> Handlers:
    """Have `handler` called when this program is asked to end; returns what was there before, for `restore`.

    In a thread that is not the main one nothing is: signals are the main thread's.
    """
    if threading.current_thread() is not threading.main_thread():
        return {}
    terminal = [stream for stream in (1, 2) if os.isatty(stream)]

    def asked_to_end(number: int, frame: FrameType | None) -> None:
        if number == signal.SIGHUP:  # what is still to be said would fail on a terminal that is gone
            nowhere = os.open(os.devnull, os.O_WRONLY)
            for stream in terminal:
                os.dup2(nowhere, stream)
            os.close(nowhere)
        handler(number, frame)

    asked = [signal.SIGTERM]
    asked += [number for number in (signal.SIGINT, signal.SIGHUP) if signal.getsignal(number) is not signal.SIG_IGN]
    return {number: signal.signal(number, asked_to_end) for number in asked}


def restore(handlers: Handlers) -> None:
    """Give the signals back."""
    for number, handler in handlers.items():
        signal.signal(number, handler)


@contextmanager
def interrupted_through(hand_over: Callable[[Callable[[], NoReturn]], None]) -> Iterator[None]:
    """While a session is open: a signal raises Interrupted where the main thread next does a duty that it was handed.

    Not where it finds that thread, which may be in a callback of zenoh's, where an exception is printed and lost.
    Whoever leaves the block without having done the duty is interrupted there.
    """
    asked: list[int] = []

    def interrupt() -> NoReturn:
        raise Interrupted(asked.pop(0))

    def stop(number: int, frame: FrameType | None) -> None:
        asked.append(number)
        hand_over(interrupt)

    before = heed(stop)
    try:
        yield
    finally:
        restore(before)
    if asked:
        interrupt()
