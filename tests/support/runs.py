"""Starts real runs for tests: the program itself, its roles one by one, and what can be done to their processes."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from agent.contract.gains import Gains
from agent.contract.keys import EVIDENCE, model_of
from agent.contract.messages import Message
from agent.contract.recording import Logged
from agent.contract.recording.reader import RecordingReader
from agent.guests import Guests
from agent.launch import launch
from agent.plan import Plan

MANY = 100_000  # steps of a run that a test ends itself
NURSERY = "agent.nursery"
PATIENCE = 300.0  # seconds after which a wait of a test has failed, on a busy machine too


def program(*arguments: object) -> list[str]:
    """The command line of `peakmesh`."""
    return [sys.executable, "-m", "designer", *map(str, arguments)]


def peakmesh(*arguments: object, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Run a command to its end."""
    return subprocess.run(program(*arguments), capture_output=True, text=True, timeout=PATIENCE, cwd=cwd, check=False)


@contextlib.contextmanager
def started(*arguments: object) -> Iterator[subprocess.Popen[str]]:
    """A command that is running; killed at the end of the block if it still is."""
    process = subprocess.Popen(
        program(*arguments), stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        yield process
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.kill()
        process.communicate()


def line_with(process: subprocess.Popen[str], text: str) -> str:
    """The first line of stderr that has `text`."""
    assert process.stderr is not None
    for line in process.stderr:
        if text in line:
            return line
    raise AssertionError(f'"{text}" was never said')


def child(parent: int, *words: str) -> int:
    """The process id of a child of `parent` whose command line has all `words`."""
    found = [pid for pid, command in children(parent).items() if all(word in command for word in words)]
    assert len(found) == 1, (words, children(parent))
    return found[0]


def children(parent: int) -> dict[int, list[str]]:
    """Process ids and command lines of the children of `parent`; instead of a nursery, those that it has forked."""
    found = {}
    for pid, command in _children(parent).items():
        found |= _children(pid) if NURSERY in command else {pid: command}
    return found


def _children(parent: int) -> dict[int, list[str]]:
    found = {}
    for entry in Path("/proc").iterdir():
        with contextlib.suppress(OSError, ValueError, IndexError):
            fields = (entry / "stat").read_text().rpartition(")")[2].split()
            if int(fields[1]) == parent:
                found[int(entry.name)] = (entry / "cmdline").read_text().replace("\0", " ").split()
    return found


def wait_until_gone(pids: list[int]) -> None:
    """Until none of these processes runs any more."""
    deadline = time.monotonic() + PATIENCE
    while any(_runs(pid) for pid in pids):
        assert time.monotonic() < deadline, f"still running: {[pid for pid in pids if _runs(pid)]}"
        time.sleep(0.01)


def _runs(pid: int) -> bool:
    with contextlib.suppress(OSError):
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    return False


def logged(path: Path) -> list[Logged]:
    """All messages of a recording that were on the wire, as far as it goes."""
    with RecordingReader(path) as reader:
        return [message for message in reader.messages() if message.topic != EVIDENCE]


def alone(path: Path) -> Path:
    """A copy of a file in a folder of its own, where nobody finds the other parts beside it."""
    folder = path.parent.with_name(f"{path.parent.name}-alone") / path.stem
    folder.mkdir(parents=True, exist_ok=True)
    return Path(shutil.copy(path, folder))


def end_of(path: Path) -> dict[str, str] | None:
    """The `end` metadata of a recording."""
    with RecordingReader(path) as reader:
        for _ in reader.messages():
            pass
        return reader.end


def numbers_of(path: Path) -> dict[tuple[str, int], bytes]:
    """The payload of every topic and step, but for events."""
    found = {}
    for message in logged(path):
        if message.topic != "event":
            found[message.topic, decoded(message).step] = message.payload
    return found


def decoded(message: Logged) -> Message:
    model = model_of(message.topic)
    assert model is not None
    return model.decode(message.payload)


def answer(done: subprocess.CompletedProcess[str]) -> dict[str, Any]:
    """The JSON object that a command printed."""
    assert done.stdout, done.stderr
    return dict(json.loads(done.stdout))


def freeze(pid: int) -> None:
    os.kill(pid, signal.SIGSTOP)


def thaw(pid: int) -> None:
    os.kill(pid, signal.SIGCONT)


def run_here(
    gains_path: Path,
    recording: Path,
    *,
    at: int = 0,
    do: Callable[[], None] = lambda: None,
    heed: Callable[[dict[str, Any]], None] = lambda word: None,
    keys: Path | None = None,
    guests: Guests | None = None,
    wait: float = PATIENCE,
    **plan: Any,
) -> dict[str, Any]:
    """Launch a run from this process, call `do` once `at` steps are complete; `heed` gets every word."""
    done = False

    def report(word: dict[str, Any]) -> None:
        nonlocal done
        heed(word)
        if word.get("complete", 0) > at and not done:
            done = True
            do()

    return launch(
        gains_path,
        Gains.load(gains_path),
        Plan(**{"steps": MANY, "seed": 1, "deadline": PATIENCE, **plan}),
        run="test",
        recording=recording,
        force=False,
        wait=wait,
        report=report,
        keys=keys,
        guests=guests,
    )


def roles_left() -> dict[int, list[str]]:
    """The children of this process that play a role of a run, and what they are forked from."""
    own = _children(os.getpid()) | children(os.getpid())
    return {pid: command for pid, command in own.items() if NURSERY in command or "--child" in command}


def kill(*words: str) -> Callable[[], None]:
    """Kill -9 the child of this process whose command line has these words."""
    return lambda: os.kill(child(os.getpid(), *words), signal.SIGKILL)
