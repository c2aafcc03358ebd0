"""Faults that befall one's own process: killed, or standing still for a while."""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Iterable

from agent.faults import Fault


def suffer(faults: Iterable[Fault]) -> None:
    """Let them happen to this process, one after the other."""
    for fault in faults:
        if fault.kind == "kill":
            os.kill(os.getpid(), signal.SIGKILL)
        waker = subprocess.Popen(
            ["/bin/sh", "-c", f"sleep {fault.seconds:.3f}; kill -CONT {os.getpid()}"], start_new_session=True
        )
        os.kill(os.getpid(), signal.SIGSTOP)
        waker.wait()
