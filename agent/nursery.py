"""`python -m agent.nursery`: the process that the roles of a run on one machine are forked from.

`agent.children` talks to it. It has no thread and opens no session: what forks must have none. It ends when whoever has
started it is gone and every child has ended; only then is the folder of their sockets removed.
"""

from __future__ import annotations

import ctypes
import gc
import json
import os
import select
import shutil
import signal
import socket
import sys
import traceback
from contextlib import suppress
from typing import Any, NoReturn

from setproctitle import setproctitle

from agent.children import LARGEST, end_group
from agent.cli import main  # before numpy: it says how many threads that may have
from agent.contract.errors import EXIT_BROKEN
from agent.network import bus  # noqa: F401 -- so that children have it already
from agent.roles import coordinator, node, plant, recorder  # noqa: F401

PR_SET_PDEATHSIG = 1  # of prctl(2): what a process gets when its parent ends


def serve(connection: socket.socket, folder: str) -> None:
    """Fork for whoever is at the other end, until they have gone."""
    ended, ends = os.pipe()
    os.set_blocking(ended, False)
    os.set_blocking(ends, False)
    signal.signal(signal.SIGCHLD, lambda number, frame: None)
    signal.set_wakeup_fd(ends, warn_on_full_buffer=False)
    gc.freeze()  # nothing of what is here is looked at again, so its pages stay common
    children, is_wanted, poll = dict[int, bool](), True, select.poll()  # whether they are programs that are not ours
    poll.register(ended, select.POLLIN)
    poll.register(connection, select.POLLIN)
    while children or is_wanted:
        there = {fd for fd, _ in poll.poll()}
        if ended in there:
            with suppress(BlockingIOError):
                os.read(ended, LARGEST)
            _tell_who_has_ended(connection, children)
        if connection.fileno() in there:
            request, streams = _next_request(connection)
            if not request:
                poll.unregister(connection)
                is_wanted = False
            else:
                _do(json.loads(request), streams, connection, children)
        if not is_wanted and all(children.values()):  # the run is over for all of ours, and nobody waits for them
            for pid in children:
                end_group(pid)
    shutil.rmtree(folder, ignore_errors=True)


def _next_request(connection: socket.socket) -> tuple[bytes, list[int]]:
    """And the streams that go with it; nothing where whoever asks has gone."""
    try:
        request, streams, _, _ = socket.recv_fds(connection, LARGEST, 3)
    except ConnectionResetError:  # they had not read all that they were told
        return b"", []
    return request, streams


def _do(request: dict[str, Any], streams: list[int], connection: socket.socket, children: dict[int, bool]) -> None:
    if "kill" in request:
        pid, number = request["kill"], request["signal"]
        if children.get(pid) and number == signal.SIGKILL:
            end_group(pid)
        elif pid in children:
            os.kill(pid, number)
        return
    try:
        pid = os.fork()
    except OSError as error:
        _tell(connection, {"failed": error.strerror})
    else:
        if pid == 0 and "program" in request:
            _execute(request["program"], request["environment"], streams)
        if pid == 0:
            _become(request["arguments"], streams)
        children[pid] = "program" in request
        _tell(connection, {"born": pid})
    for stream in streams:
        os.close(stream)


def _tell_who_has_ended(connection: socket.socket, children: dict[int, bool]) -> None:
    for pid, is_program in list(children.items()):
        if is_program and os.waitid(os.P_PID, pid, os.WEXITED | os.WNOHANG | os.WNOWAIT):
            end_group(pid)  # while it is there to be waited for, nobody else can have its number
        which, status = os.waitpid(pid, os.WNOHANG)
        if which:
            del children[pid]
            _tell(connection, {"ended": pid, "code": os.waitstatus_to_exitcode(status)})


def _tell(connection: socket.socket, answer: dict[str, Any]) -> None:
    with suppress(OSError):  # they have gone
        connection.send(json.dumps(answer).encode())


def _become(arguments: list[str], streams: list[int]) -> NoReturn:
    """Play a role, in the child; it leaves without what Python does at its end, which is the nursery's."""
    code = EXIT_BROKEN
    try:
        _leave_home(streams)
        setproctitle(" ".join(["peakmesh", *arguments]))  # what ps and top show
        code = main(arguments)
    except SystemExit as end:  # argparse's
        code = end.code if isinstance(end.code, int) else EXIT_BROKEN
    except BaseException:
        traceback.print_exc()
    finally:
        for stream_object in (sys.stdout, sys.stderr):
            with suppress(OSError):
                stream_object.flush()
        os._exit(code)


def _execute(words: list[str], environment: dict[str, str], streams: list[int]) -> NoReturn:
    """Become a program that is not ours, in the child. It is killed where the nursery is: it may heed nothing."""
    try:
        _leave_home(streams)
        for number in (signal.SIGPIPE, signal.SIGXFSZ):  # Python ignores them
            signal.signal(number, signal.SIG_DFL)
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
        os.execvpe(words[0], words, os.environ | environment)
    except (OSError, ValueError) as error:
        os.write(2, f"{words[0]}: {error}\n".encode())
    finally:
        os._exit(EXIT_BROKEN)


def _leave_home(streams: list[int]) -> None:
    """Have a session of its own, these streams, and nothing else of the nursery's."""
    signal.set_wakeup_fd(-1)
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    os.setsid()
    for number, stream in enumerate(streams):
        os.dup2(stream, number)
    os.closerange(3, os.sysconf("SC_OPEN_MAX"))


if __name__ == "__main__":
    serve(socket.socket(fileno=int(sys.argv[1])), sys.argv[2])
