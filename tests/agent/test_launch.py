"""Whole runs: real processes, real Zenoh on loopback, real recordings."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import threading
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from made_recordings import observer_gains, real_problem, simulate
from runs import (
    PATIENCE,
    answer,
    child,
    freeze,
    logged,
    numbers_of,
    peakmesh,
    roles_left,
    run_here,
    started,
    thaw,
)

from agent.contract.errors import InputError, RunBroken
from agent.contract.gains import Gains
from designer.replay import replay


def test_run_and_replay_agree(gains_path: Path, tmp_path: Path) -> None:
    """What a live network did is what the centralised error model says, to the last message."""
    recording = tmp_path / "run.mcap"
    ran = peakmesh("run", gains_path, "--steps", 80, "--seed", 7, "-o", recording, "--json")
    assert ran.returncode == 0, ran.stderr
    facts = answer(ran)
    assert (facts["steps"], facts["seed"], facts["missing"]) == (80, 7, 0)
    assert facts["recording"] == str(recording)
    assert facts["messages"] == len(logged(recording)) == 80 * (2 + 3 + 3) + 2  # and the two events
    done = peakmesh("replay", recording, "--json")
    assert done.returncode == 0, done.stdout
    verdict = answer(done)
    assert verdict["agrees"]
    assert verdict["finished"]
    assert (verdict["steps"], verdict["missing"], verdict["duplicates"]) == (80, 0, 0)


class Run(NamedTuple):
    """A run that has ended well."""

    gains_path: Path
    recording: Path
    steps: int
    seed: int
    summary: dict[str, Any]


@pytest.fixture(scope="module")
def real(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Of a network with seen losses, lossy links, unbiased gains and an unstable plant.

    It is started in a folder where an agent.py and a queue.py lie.
    """
    folder, steps, seed = tmp_path_factory.mktemp("real"), 100, 3
    gains_path, recording = folder / "gains.json", folder / "run.mcap"
    observer_gains(real_problem(5, radius=1.02, ny=(1, 2, 1))).save(gains_path)
    for name in ("agent.py", "queue.py"):
        (folder / name).write_text("raise SystemExit('imported')\n")
    with contextlib.chdir(folder):
        summary = run_here(gains_path, recording, steps=steps, seed=seed, window=32)
    return Run(gains_path, recording, steps, seed, summary)


def test_files_of_the_current_folder_are_not_imported(real: Run) -> None:
    """An agent.py or queue.py that happens to lie where the run is started has no part in it."""
    assert (real.summary["steps"], real.summary["missing"]) == (real.steps, 0)


def test_same_seed_same_numbers(real: Run, tmp_path: Path) -> None:
    """Neither load nor window changes a bit of any message."""
    burn = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(4)]

    def load(word: dict[str, Any]) -> None:
        if "started" in word:
            for process in burn:
                thaw(process.pid)

    try:
        for process in burn:
            freeze(process.pid)
        run_here(real.gains_path, tmp_path / "busy.mcap", heed=load, steps=real.steps, seed=real.seed, window=1)
    finally:
        for process in burn:
            process.kill()
            process.wait()
    assert numbers_of(tmp_path / "busy.mcap") == numbers_of(real.recording)


def test_a_real_network_runs_and_is_replayed(real: Run) -> None:
    """Every process does what the model says."""
    gains, steps = Gains.load(real.gains_path), real.steps
    problem, payloads = gains.problem, numbers_of(real.recording)
    verdict = replay(real.recording)
    assert verdict.exit_code == 0, verdict.text()
    assert all(proof.holds and proof.compared for proof in verdict.proofs)
    found = {key: json.loads(payload) for key, payload in payloads.items()}
    empty = [key for key, document in found.items() if document.get("y") == []]
    assert {topic for topic, _ in empty} == {"node/n1/measurement"}  # n2 sees its losses too, but has none
    assert 0.1 * steps < len(empty) < 0.3 * steps  # 0.2 steps in the mean; of one seed always the same
    neighbours = {
        (mode, name): len(problem.neighbours(s, i))
        for s, mode in enumerate(problem.mode_names)
        for i, name in enumerate(problem.node_names)
    }
    estimates = [
        (topic.split("/")[1], document) for (topic, _), document in found.items() if topic.endswith("estimate")
    ]
    later = [(name, document) for name, document in estimates if document["step"]]
    unheard = [document for name, document in later if len(document["heard"]) < neighbours[document["mode"], name]]
    assert len(unheard) > 0.1 * steps
    for message in simulate(gains, steps=steps, seed=real.seed):  # the tests' own plant and nodes
        if message.topic != "event":
            for key, expected in message.document.items():
                told = found[message.topic, message.document["step"]][key]
                same = key in ("mode", "heard")
                assert told == (expected if same else pytest.approx(expected, rel=1e-12, abs=1e-12))


def test_two_runs_at_once(lone_path: Path, tmp_path: Path) -> None:
    """Two runs on one machine do not disturb each other, though they have the same gains; other seed, other numbers."""
    with started("run", lone_path, "--steps", 60, "--seed", 1, "-o", tmp_path / "first.mcap") as first:
        run_here(lone_path, tmp_path / "second.mcap", steps=60, seed=2)
        assert first.wait(PATIENCE) == 0
    paths = [tmp_path / f"{name}.mcap" for name in ("first", "second")]
    assert [replay(path).exit_code for path in paths] == [0, 0]
    ours, theirs = map(numbers_of, paths)
    assert ours.keys() == theirs.keys()
    assert ours != theirs


def test_frozen_recorder_slows_the_run(lone_path: Path, tmp_path: Path) -> None:
    """A recorder that stands still for two seconds holds a lock-step run up, and loses nothing from it."""

    def freeze_for_two_seconds() -> None:
        recorder = child(os.getpid(), "recorder")
        freeze(recorder)
        threading.Timer(2.0, thaw, [recorder]).start()

    recording = tmp_path / "run.mcap"
    run_here(lone_path, recording, at=10, do=freeze_for_two_seconds, steps=2000, window=8)
    times = [message.log_time for message in logged(recording)]
    assert max(later - earlier for earlier, later in pairwise(times)) > 1.5e9  # it did stand still
    assert replay(recording).exit_code == 0


def test_existing_recording_is_kept(lone_path: Path, tmp_path: Path) -> None:
    """A recording that exists is not replaced: exit 2, and not a byte of it changes."""
    recording = tmp_path / "run.mcap"
    recording.write_bytes(b"precious")
    done = peakmesh("run", lone_path, "--steps", 5, "-o", recording)
    assert done.returncode == 2
    assert "exists already" in done.stderr
    assert recording.read_bytes() == b"precious"


def test_child_that_cannot_start_is_reported(lone_path: Path, tmp_path: Path) -> None:
    """A role that fails before the start ends the run with its own sentence, or as another role heard it first."""
    (tmp_path / "run.mcap.part").write_bytes(b"left over")
    with pytest.raises((InputError, RunBroken), match=r"run\.mcap\.part exists already"):
        run_here(lone_path, tmp_path / "run.mcap", steps=5)
    assert roles_left() == {}
