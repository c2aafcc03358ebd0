"""The program that is judged: how it is started and ended."""

from __future__ import annotations

import os
import signal
import subprocess
import tempfile
import threading
from collections.abc import Callable
from contextlib import suppress

from agent.contract.closing import Closing
from agent.contract.errors import InputError
from agent.guests import Program

LAST_LINES = 3  # of what it has said, that are told


class Running(Closing):
    """A program in a session of its own. `ended` is called with its exit code, on a thread."""

    def __init__(self, program: Program, *, ended: Callable[[int], None]) -> None:
        self._said = tempfile.TemporaryFile()  # noqa: SIM115 -- closed in close
        try:
            self._process = subprocess.Popen(
                program.words,
                stdin=subprocess.DEVNULL,
                stdout=self._said,
                stderr=self._said,
                start_new_session=True,
                env=os.environ | program.environment,
            )
        except OSError as error:
            self._said.close()
            raise InputError(f"the program, {program.words[0]}, cannot be started: {error.strerror}") from None
        self._watch = threading.Thread(target=lambda: ended(self._process.wait()), daemon=True)
        self._watch.start()

    def interrupt(self) -> None:
        """As somebody who wants it to end."""
        self._process.send_signal(signal.SIGTERM)

    def last_words(self) -> str:
        """What it has said last, on stdout and stderr; "" where it has said nothing."""
        self._said.seek(0)
        lines = self._said.read().decode(errors="replace").strip().splitlines()
        return " / ".join(line.strip() for line in lines[-LAST_LINES:])

    def close(self) -> None:
        """End it, and whatever it has started, if they have not ended."""
        with suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._watch.join()
        self._said.close()
