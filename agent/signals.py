"""Which signals ask a program to end: SIGTERM always, SIGINT unless it was started with SIGINT ignored.

That is how a shell starts what a script puts in the background (`peakmesh run ... &`), so that Ctrl-C reaches only
what stands in the foreground; nohup does the same for SIGHUP. Whoever wants such a program to end sends SIGTERM.
Processes that it starts inherit what is ignored.
"""

from __future__ import annotations

import signal
from collections.abc import Callable
from types import FrameType
from typing import Any

Handler = Callable[[int, FrameType | None], None]
Handlers = dict[int, Any]  # of signals; what signal.signal returns


def heed(handler: Handler) -> Handlers:
    """Have `handler` called when this program is asked to end; returns what was there before, for `restore`."""
    asked = [signal.SIGTERM]
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        asked.append(signal.SIGINT)
    return {number: signal.signal(number, handler) for number in asked}


def restore(handlers: Handlers) -> None:
    """Give the signals back."""
    for number, handler in handlers.items():
        signal.signal(number, handler)
