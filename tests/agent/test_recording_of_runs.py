"""Whole runs whose recording is split, killed, taken away or out of disk: real processes, and what is left of them."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import time
from collections import Counter
from pathlib import Path

import pytest
from disks import disk_of
from runs import PATIENCE, alone, answer, child, decoded, end_of, line_with, peakmesh, started

from agent.contract.gains import Gains
from agent.contract.keys import EVENT, EVIDENCE
from agent.contract.recording import Logged
from agent.contract.recording.evidence.examiner import Findings, examine
from agent.contract.recording.parts import files_of, part_path, unfinished
from agent.contract.recording.reader import RecordingReader
from agent.guard import AHEAD

FULL = 60_000  # bytes after which a disk is full: the head of a recording and some steps


def messages_of(*files: Path) -> list[Logged]:
    """All messages of some files, with the evidence."""
    found = list[Logged]()
    for file in files:
        with RecordingReader(alone(file)) as reader:
            found += reader.messages()
    return found


def examined(*files: Path) -> Findings:
    messages = messages_of(*files)
    return examine(((m, decoded(m).step) for m in messages), external=(), end=end_of(alone(files[-1])) or {})


def complete_steps(messages: list[Logged]) -> int:
    """The steps of which every message is there, from the first on: two, and two of each of the two nodes."""
    there = Counter(decoded(message).step for message in messages if message.topic not in (EVENT, EVIDENCE))
    step = 0
    while there[step] == 6:
        step += 1
    return step


def wait_for(path: Path, process: subprocess.Popen[str], *, size: int = 0) -> None:
    """Until a file is there, and so long."""
    deadline = time.monotonic() + PATIENCE
    while not (path.exists() and path.stat().st_size >= size):
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.002)


# in parts
def test_a_run_in_parts_has_every_message_once_and_evidence_through_all(pair_path: Path, tmp_path: Path) -> None:
    """And it goes on for longer than anybody may be ahead of anybody."""
    recording, steps = tmp_path / "run.mcap", AHEAD + 100
    ran = peakmesh("run", pair_path, "--steps", steps, "--split-size", "1kB", "-o", recording, "--json")
    assert ran.returncode == 0, ran.stderr
    facts, files = answer(ran), files_of(recording)
    assert facts["parts"] == [str(file) for file in files]
    assert len(files) > 2
    assert [file.name for file in files] == [part_path(recording, number + 1).name for number in range(len(files))]
    messages = messages_of(*files)
    wire = [(m.topic, m.number) for m in messages if m.topic != EVIDENCE]
    assert len(set(wire)) == len(wire) == facts["messages"] == steps * 6 + 2
    assert complete_steps(messages) == steps
    assert examined(*files) == Findings(len(wire), 0, (), (), ())
    ends = [end_of(alone(file)) or {} for file in files]
    assert [end["status"] for end in ends] == ["continues"] * (len(files) - 1) + ["finished"]
    assert [int(end["steps"]) for end in ends] == sorted(int(end["steps"]) for end in ends)


# killed
@pytest.mark.parametrize("size", [1, 100_000])
def test_a_killed_recorder_leaves_a_run_that_replays_as_far_as_it_goes(
    pair_path: Path, tmp_path: Path, size: int
) -> None:
    """Kill -9, at the beginning and later: exit 3, no traceback, no false message, and no divergence."""
    part = unfinished(tmp_path / "run.mcap")
    with started("run", pair_path, "--steps", 100_000, "-o", tmp_path / "run.mcap") as launcher:
        wait_for(part, launcher, size=size)
        os.kill(child(launcher.pid, "recorder"), signal.SIGKILL)
        said = line_with(launcher, "peakmesh: ")
        assert launcher.wait(PATIENCE) == 3
    assert "the recorder was lost" in said or "the recorder ended before the run had started: killed by SIGKILL" in said
    done = peakmesh("replay", part, "--json")
    if size == 1 and done.returncode == 2:  # killed before the head was written
        assert done.stderr.startswith(f"peakmesh: {part}")
        return
    assert (done.returncode, done.stderr) == (3, "")
    assert answer(done)["first_divergence"] is None
    assert examined(part).total == 0


# full
def test_a_full_disk_stops_the_run_at_once(pair_path: Path, tmp_path: Path) -> None:
    """Exit 3; one sentence says what is full, from which step on there is nothing, and where the rest is."""
    recording = tmp_path / "run.mcap"
    with disk_of(FULL):
        ran = peakmesh("run", pair_path, "--steps", 100_000, "-o", recording)
    (part,) = files_of(recording)
    steps = complete_steps(messages_of(part))
    assert ran.stderr == (
        f"peakmesh: {recording} could not be written: File too large; there is no recording from step {steps} on; "
        f"what was recorded is in {part}\n"
    )
    assert (ran.returncode, ran.stdout) == (3, "")
    assert examined(part).total == 0
    done = peakmesh("replay", part, "--json")
    assert (done.returncode, answer(done)["first_divergence"]) == (3, None)


def test_a_run_that_may_go_on_does_so_without_a_recording(pair_path: Path, tmp_path: Path) -> None:
    """It does all its steps, says at once that they are not recorded, and ends with 3: nobody takes it for recorded."""
    recording = tmp_path / "run.mcap"
    options = ["--steps", 1500, "-o", recording, "--on-record-failure", "continue", "--json"]
    with disk_of(FULL):
        ran = peakmesh("run", pair_path, *options)
    facts, (part,) = answer(ran), files_of(recording)
    messages = messages_of(part)
    steps = complete_steps(messages)
    why = f"{recording} could not be written: File too large; there is no recording from step {steps} on"
    assert ran.stderr == f"peakmesh: the recording broke off: {why}\n"
    assert (ran.returncode, facts["steps"], facts["missing"]) == (3, 1500, 0)
    assert (facts["broken_off"], facts["recorded_steps"]) == (why, steps)
    assert (facts["parts"], facts["messages"]) == ([str(part)], sum(m.topic != EVIDENCE for m in messages))


def test_everybody_is_told_that_there_is_no_recording(pair_path: Path, tmp_path: Path, pair: Gains) -> None:
    """Roles as commands: each says so, the coordinator and the recorder at once, and each ends with 3."""
    steps, names = ("--steps", 1500), pair.problem.node_names
    with started("coordinator", pair_path, *steps, "--listen", "tcp/127.0.0.1:0") as coordinator:
        address = line_with(coordinator, "listening at").split()[-1]
        there = [started("node", pair_path, "--node", name, "--connect", address) for name in names]
        options = ["-o", tmp_path / "run.mcap", "--connect", address, "--on-record-failure", "continue"]
        with there[0] as a, there[1] as b, started("plant", pair_path, "--connect", address) as plant:
            with disk_of(FULL):
                recorder = started("recorder", pair_path, *options)
                with recorder as r:
                    at_once = [line_with(process, "the recording broke off") for process in (coordinator, r)]
                    ends = [line_with(process, "the run has ended, but") for process in (a, b, plant, r)]
                    assert [process.wait(PATIENCE) for process in (coordinator, a, b, plant, r)] == [3] * 5
            assert coordinator.stdout is not None
            summary = coordinator.stdout.read().splitlines()
    why = at_once[0].removeprefix("peakmesh: the recording broke off: ").strip()
    assert why.startswith(f"{tmp_path / 'run.mcap'} could not be written: File too large; there is no recording from")
    assert at_once == [f"peakmesh: the recording broke off: {why}\n"] * 2
    assert ends == [f"peakmesh: the run has ended, but {why}\n"] * 4
    assert summary[-1] == f"NOT RECORDED TO THE END: {why}"


def test_a_folder_that_is_removed_stops_the_run(pair_path: Path, tmp_path: Path) -> None:
    recording = tmp_path / "new" / "run.mcap"
    recording.parent.mkdir()
    with started("run", pair_path, "--steps", 100_000, "-o", recording) as launcher:
        wait_for(unfinished(recording), launcher, size=1)
        shutil.rmtree(recording.parent)
        said = line_with(launcher, "peakmesh: ")
        assert launcher.wait(PATIENCE) == 3
    assert said == (
        f"peakmesh: {recording} could not be written: its folder was removed; there is no recording from step 0 on\n"
    )


# options
@pytest.mark.parametrize(
    ("option", "value", "why"),
    [
        ("--split-size", "10", "10 is not a size from 1kB on, such as 500kB, 100MB or 2GB"),
        ("--split-size", "1TB", "1TB is not a size"),
        ("--split-size", "-5MB", "expected one argument"),
        ("--split-duration", "0.5s", "0.5s is not a time from 1s on, such as 90s, 10min or 2h"),
        ("--split-duration", "10 minutes", "10 minutes is not a time"),
        ("--on-record-failure", "ignore", "invalid choice: 'ignore' (choose from"),
    ],
)
def test_what_is_no_size_or_time_is_refused(pair_path: Path, option: str, value: str, why: str) -> None:
    ran = peakmesh("run", pair_path, option, value)
    assert ran.returncode == 2
    assert why in ran.stderr
