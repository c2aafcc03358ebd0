"""Processes that are forked from one that has imported everything: the nursery, as whoever starts them sees it.

Importing is most of what it costs to start a role. The nursery (`agent.nursery`) does it once, in a process of its own
that has no thread and no session, so that forking it is safe; and what was imported is there once for all.

Requests and answers are JSON, a datagram each. `{"arguments": [...]}`, which goes with the three standard streams, is
answered `{"born": pid}` or `{"failed": why}`; so is `{"program": [...], "environment": {...}}`, for a program that is
not ours. `{"kill": pid, "signal": number}` is not answered. When a child has ended `{"ended": pid, "code": code}`
comes, with the code of subprocess: minus the signal that has killed it.
"""

from __future__ import annotations

import json
import math
import os
import select
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

from agent.contract.errors import RunBroken

LARGEST = 128 * 1024  # bytes of a request
LONGEST_FOLDER = 70  # bytes; the name of a socket in it has 107 at most


class Child:
    """A process of the nursery's. `said` has what it says on stderr, `output` is its stdout, where that is wanted."""

    def __init__(self, pid: int, stdin: IO[bytes], output: IO[bytes] | None, said: IO[bytes]) -> None:
        self.pid, self.stdin, self.output, self.said = pid, stdin, output, said
        self.code: int | None = None  # once it has ended
        self.was_killed = False  # by us

    def last_words(self) -> str:
        """The last line of its stderr."""
        return _last_line(self.said)

    def close(self) -> None:
        """Let go of its streams: one that still runs takes that for the end of whoever has started it."""
        for stream in (self.stdin, self.output, self.said):
            if stream is not None:
                stream.close()


def folder_of_sockets() -> str:
    """Where temporary files go, if the addresses of sockets there are not too long."""
    temporary = tempfile.gettempdir()
    return temporary if len(os.fsencode(temporary)) <= LONGEST_FOLDER else "/tmp"


class Nursery:
    """Starts children, and tells when they end. `folder` is theirs for sockets, for as long as one of them is there."""

    def __init__(self) -> None:
        self.folder = Path(tempfile.mkdtemp(prefix="peakmesh-", dir=folder_of_sockets()))
        self._children: dict[int, Child] = {}  # those that have not ended
        self._programs = set[int]()  # children that are not ours
        self._said = tempfile.TemporaryFile()  # noqa: SIM115 -- closed with the nursery
        self._socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            words = [str(theirs.fileno()), str(self.folder)]
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", "agent.nursery", *words],  # -P: no agent.py of the current folder
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=self._said,
                pass_fds=[theirs.fileno()],
                start_new_session=True,
            )

    def start(self, arguments: Sequence[str], *, wants_output: bool) -> Child:
        """Start `peakmesh` with these arguments, in a session of its own. Raises RunBroken where that cannot be."""
        return self._start(arguments[0], {"arguments": list(arguments)}, wants_output=wants_output)

    def host(self, words: Sequence[str], environment: Mapping[str, str]) -> Child:
        """Start a program that is not ours, with these variables beside those that are there; it has nothing to read.

        All that it starts goes when it ends, but for what leaves its process group.
        """
        request = {"program": list(words), "environment": dict(environment)}
        child = self._start(words[0], request, wants_output=False)
        child.stdin.close()
        self._programs.add(child.pid)
        return child

    def _start(self, what: str, request: dict[str, Any], *, wants_output: bool) -> Child:
        said = tempfile.TemporaryFile()  # noqa: SIM115 -- closed with the child
        theirs, stdin = os.pipe()
        output, out = os.pipe() if wants_output else (None, os.open(os.devnull, os.O_WRONLY))
        child = Child(0, os.fdopen(stdin, "wb", 0), os.fdopen(output, "rb", 0) if output is not None else None, said)
        try:
            with self._still_there():
                socket.send_fds(self._socket, [json.dumps(request).encode()], [theirs, out, said.fileno()])
            answer = self._answer()
            if "failed" in answer:
                raise RunBroken(f"no process could be started for the {what}: {answer['failed']}")
        except RunBroken:
            child.close()
            raise
        finally:
            os.close(theirs)
            os.close(out)
        child.pid = answer["born"]
        self._children[child.pid] = child
        return child

    def kill(self, child: Child, number: int = signal.SIGKILL) -> None:
        """Send it a signal, unless it has ended; the nursery knows, whatever has become of the process id."""
        if child.code is None:
            child.was_killed = child.was_killed or number == signal.SIGKILL
            with suppress(OSError):
                self._socket.send(json.dumps({"kill": child.pid, "signal": int(number)}).encode())

    def watch(self, output: IO[bytes] | None = None, *, seconds: float | None = None) -> bool:
        """Wait until a child has ended, or there is something of `output`, which is returned, or time is over."""
        poll = select.poll()
        poll.register(self._socket, select.POLLIN)
        if output is not None:
            poll.register(output, select.POLLIN)
        there = {fd for fd, _ in poll.poll(None if seconds is None else 1000.0 * seconds)}
        if self._socket.fileno() in there:
            self._note(self._receive())
        return output is not None and output.fileno() in there

    def wait(self, child: Child, seconds: float = math.inf) -> bool:
        """Wait until it has ended; False where time is over."""
        deadline = time.monotonic() + seconds
        while child.code is None and (left := deadline - time.monotonic()) > 0.0:
            self.watch(seconds=None if left == math.inf else left)
        return child.code is not None

    def close(self) -> None:
        """Nobody is left behind. Where the nursery was killed, its children see that their input ends."""
        living = list(self._children.values())
        try:
            for child in living:
                self.kill(child)
            for child in living:
                self.wait(child)
        except RunBroken:  # programs need not heed their input
            for pid in self._programs & self._children.keys():
                end_group(pid)
        self._socket.close()
        self._process.wait()
        self._said.close()
        shutil.rmtree(self.folder, ignore_errors=True)

    def _answer(self) -> dict[str, Any]:
        """To a request; what is told meanwhile of those who end is noted."""
        while not self._note(answer := self._receive()):
            pass
        return answer

    def _note(self, answer: dict[str, Any]) -> bool:
        """False where it tells of somebody who has ended."""
        if "ended" not in answer:
            return True
        self._children.pop(answer["ended"]).code = answer["code"]
        return False

    def _receive(self) -> dict[str, Any]:
        with self._still_there():
            data = self._socket.recv(LARGEST)
            if not data:
                raise BrokenPipeError
        return dict(json.loads(data))

    @contextmanager
    def _still_there(self) -> Iterator[None]:
        try:
            yield
        except OSError:
            said = _last_line(self._said)
            why = f"; it said: {said}" if said else ""
            raise RunBroken(f"the process that the roles are forked from has ended{why}") from None


def end_group(pid: int) -> None:
    """Kill a program that is not ours, and what it has started."""
    try:
        os.killpg(pid, signal.SIGKILL)
    except ProcessLookupError:  # it has no session of its own yet, or is gone
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)


def _last_line(said: IO[bytes]) -> str:
    said.seek(0)
    lines = said.read().decode(errors="replace").strip().splitlines()
    return lines[-1].removeprefix("peakmesh: ") if lines else ""
