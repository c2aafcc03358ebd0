"""What breaks a run, and what is left of it: real processes, real Zenoh on loopback, real recordings."""

from __future__ import annotations

import os
import pty
import re
import select
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from runs import (
    MANY,
    PATIENCE,
    child,
    children,
    decoded,
    end_of,
    freeze,
    kill,
    logged,
    program,
    roles_left,
    run_here,
    started,
    wait_until_gone,
)

from agent.contract.errors import Interrupted, RunBroken
from agent.contract.gains import Gains
from agent.contract.keys import MODE
from agent.contract.recording.reader import RecordingReader
from agent.launch import RECORDER_SECONDS
from agent.network.ending import CLOSE_SECONDS
from designer.replay import replay


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signal_ends_the_run_in_order(ctrl_c: None, lone_path: Path, tmp_path: Path, number: int) -> None:
    """Ctrl-C and SIGTERM: exit 130 or 143, soon, with a recording that is whole as far as it goes.

    Where a run starts with SIGINT ignored, it stays ignored by everybody, and SIGTERM ends the run all the same.
    """
    recording = tmp_path / "run.mcap"
    sent = 0.0
    if number == signal.SIGTERM:
        signal.signal(signal.SIGINT, signal.SIG_IGN)

    def send() -> None:
        nonlocal sent
        sent = time.monotonic()
        if number == signal.SIGTERM:
            for pid in (os.getpid(), *roles_left()):
                os.kill(pid, signal.SIGINT)
        os.kill(os.getpid(), number)

    with pytest.raises(Interrupted) as caught:
        run_here(lone_path, recording, at=20, do=send)
    assert time.monotonic() - sent < CLOSE_SECONDS  # nobody had to give up waiting for the recorder
    assert caught.value.exit_code == 128 + number
    end = end_of(recording)
    assert end is not None
    assert (end["status"], end["reason"]) == ("stopped", "interrupted" if number == signal.SIGINT else "terminated")
    verdict = replay(recording)
    assert (verdict.exit_code, verdict.finished, verdict.first_divergence) == (3, False, None)
    assert roles_left() == {}


def test_signal_before_the_start_ends_the_run(lone_path: Path, tmp_path: Path) -> None:
    """A run that is stopped while it gathers leaves nothing: no process, no file."""

    def stop(word: dict[str, Any]) -> None:
        if "listening" in word:
            os.kill(os.getpid(), signal.SIGTERM)

    started_at = time.monotonic()
    with pytest.raises(Interrupted):
        run_here(lone_path, tmp_path / "run.mcap", heed=stop)
    assert time.monotonic() - started_at < RECORDER_SECONDS  # what a recorder at work would be given
    assert roles_left() == {}
    assert list(tmp_path.iterdir()) == []


def test_killed_node_ends_the_run(pair_path: Path, tmp_path: Path, pair: Gains) -> None:
    """Kill -9 of a node: exit 3, the node and its step named, a readable recording, no process left."""
    name = pair.problem.node_names[1]
    recording = tmp_path / "run.mcap"
    with pytest.raises(RunBroken) as caught:
        run_here(pair_path, recording, at=20, do=kill("node", name))
    assert f'node "{name}" was lost' in str(caught.value)
    last = int(re.findall(r"is of step (\d+); what was recorded is in ", str(caught.value))[0])
    steps = [decoded(m).step for m in logged(recording) if m.topic == f"node/{name}/estimate"]
    assert last == max(steps) >= 20
    end = end_of(recording)
    assert end is not None
    assert end["status"] == "stopped"
    assert replay(recording).exit_code == 3
    assert roles_left() == {}


def test_killed_recorder_leaves_what_it_flushed(lone_path: Path, tmp_path: Path) -> None:
    """Kill -9 of the recorder: exit 3, and the .part file has what was flushed while the run went on.

    How soon that is, the tests of the recording say.
    """
    recording = tmp_path / "run.mcap"
    part = recording.with_name("run.mcap.part")

    def flushed() -> bool:
        """Whether the file has the modes of the first 20 steps; it is read no further, for it goes on growing."""
        with RecordingReader(part) as reader:
            return any(message.topic == MODE and message.number >= 20 for message in reader.messages())

    def kill_recorder() -> None:
        deadline = time.monotonic() + PATIENCE
        while not flushed():
            assert time.monotonic() < deadline
            time.sleep(0.01)
        kill("recorder")()

    with pytest.raises(RunBroken, match=r"the recorder was lost: .*; \d+ steps were complete"):
        run_here(lone_path, recording, at=20, do=kill_recorder)
    assert end_of(part) is None
    assert flushed()
    assert replay(part).exit_code == 3
    assert not recording.exists()


def test_killed_coordinator_ends_the_run(lone_path: Path, tmp_path: Path) -> None:
    """Kill -9 of the coordinator: exit 3, the recorder closes the recording by itself, no process left."""
    recording = tmp_path / "run.mcap"
    with pytest.raises(RunBroken, match="the coordinator ended without a word: killed by SIGKILL"):
        run_here(lone_path, recording, at=20, do=kill("coordinator"))
    end = end_of(recording)
    assert end is not None
    assert end["status"] == "broken"
    assert "the coordinator was lost" in end["reason"]
    assert roles_left() == {}


def test_killed_launcher_leaves_no_process(lone_path: Path, tmp_path: Path) -> None:
    """Kill -9 of the launcher: its children notice, the recording is closed, nobody stays, nor their sockets."""
    recording = tmp_path / "run.mcap"
    with started("run", lone_path, "--steps", MANY, "-o", recording) as launcher:
        while not recording.with_name("run.mcap.part").exists():  # the recorder opens it when the run starts
            assert launcher.poll() is None
            time.sleep(0.01)
        crew = children(launcher.pid)
        assert len(crew) == 4
        (sockets,) = {Path(command[command.index("--sockets") + 1]) for command in crew.values()}
        assert sockets.is_dir()
        launcher.kill()
        wait_until_gone(list(crew))
    assert end_of(recording) is not None
    deadline = time.monotonic() + PATIENCE
    while sockets.exists():
        assert time.monotonic() < deadline
        time.sleep(0.01)


TERMINAL = "import fcntl, os, sys, termios; fcntl.ioctl(0, termios.TIOCSCTTY, 0); os.execv(sys.argv[1], sys.argv[1:])"


def test_a_closed_terminal_leaves_no_process(lone_path: Path, tmp_path: Path) -> None:
    """It is SIGHUP: the run ends in order, exit 129, though nothing can be said any more."""
    recording = tmp_path / "run.mcap"
    ours, theirs = pty.openpty()
    command = program("run", lone_path, "--steps", MANY, "-o", recording)
    launcher = subprocess.Popen(
        [sys.executable, "-c", TERMINAL, *command], stdin=theirs, stdout=theirs, stderr=theirs, start_new_session=True
    )
    try:
        os.close(theirs)
        deadline = time.monotonic() + PATIENCE
        while not recording.with_name("run.mcap.part").exists():
            assert time.monotonic() < deadline
            if select.select([ours], [], [], 0.05)[0]:
                os.read(ours, 65536)
        crew = list(children(launcher.pid))
        assert len(crew) == 4
        os.close(ours)
        assert launcher.wait(PATIENCE) == 129
        wait_until_gone(crew)
    finally:
        launcher.kill()
        launcher.wait()
    end = end_of(recording)
    assert end is not None
    assert (end["status"], end["reason"]) == ("stopped", "the terminal was closed")


@pytest.mark.parametrize("closed", [">&-", "2>&-", "<&- >&- 2>&-"])
def test_closed_streams_change_nothing(lone_path: Path, tmp_path: Path, closed: str) -> None:
    """Whoever starts a run without stdin, stdout or stderr has it all the same, and nothing else is taken for them."""
    recording = tmp_path / "run.mcap"
    command = program("run", lone_path, "--steps", 5, "-o", recording)
    done = subprocess.run(
        ["/bin/sh", "-c", f'exec "$@" {closed}', "sh", *command], capture_output=True, text=True, timeout=PATIENCE
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert ("5 steps" in done.stdout) == (closed == "2>&-")
    assert replay(recording).exit_code == 0


def test_frozen_node_is_named_after_the_deadline(pair_path: Path, tmp_path: Path, pair: Gains) -> None:
    """A node that stands still is named with the step that lacks its estimate."""
    name = pair.problem.node_names[1]
    with pytest.raises(RunBroken, match=rf"step \d+ lacks node/{name}/estimate after 3 s"):
        run_here(
            pair_path,
            tmp_path / "run.mcap",
            at=20,
            do=lambda: freeze(child(os.getpid(), "node", name)),
            deadline=3.0,
        )
    assert roles_left() == {}
