"""Whole runs: real processes, real Zenoh on loopback, real recordings."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import zenoh
from made_recordings import observer_gains, real_problem, simulate
from places import ROOT
from runs import (
    answer,
    child,
    children,
    decoded,
    end_of,
    freeze,
    line_with,
    logged,
    numbers_of,
    peakmesh,
    started,
    thaw,
    wait_until_gone,
)

from agent.contract.errors import InputError, Interrupted, RunBroken
from agent.contract.gains import Gains
from agent.launch import launch
from agent.plan import Plan
from designer.replay import replay
from designer.replay.verdict import Verdict

MANY = 100_000  # steps of a run that a test ends itself
SENSOR = ROOT / "docs" / "sensor.py"


@pytest.fixture(scope="session")
def gains_path(gains: Gains, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The gains of three nodes and two modes, in a file."""
    path = tmp_path_factory.mktemp("gains") / "gains.json"
    gains.save(path)
    return path


def roles_left() -> dict[int, list[str]]:
    """The children of this process that play a role of a run."""
    return {pid: command for pid, command in children(os.getpid()).items() if "agent" in command}


def run_here(
    gains_path: Path,
    recording: Path,
    *,
    at: int = 0,
    do: Callable[[], None] = lambda: None,
    heed: Callable[[dict[str, Any]], None] = lambda word: None,
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
        Plan(**{"steps": MANY, "seed": 1, "deadline": 60.0, **plan}),
        run="test",
        recording=recording,
        force=False,
        wait=60.0,
        report=report,
    )


def kill(*words: str) -> Callable[[], None]:
    """Kill -9 the child of this process whose command line has these words."""
    return lambda: os.kill(child(os.getpid(), *words), signal.SIGKILL)


def judged(recording: Path) -> Verdict:
    return replay(recording)


# A run that ends well.
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


def test_same_seed_same_numbers(gains_path: Path, tmp_path: Path) -> None:
    """Neither load nor window changes a bit of any message; another seed does."""
    run_here(gains_path, tmp_path / "calm.mcap", steps=120, window=32)
    burn = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(4)]
    try:
        run_here(gains_path, tmp_path / "busy.mcap", steps=120, window=1)
    finally:
        for process in burn:
            process.kill()
            process.wait()
    run_here(gains_path, tmp_path / "other.mcap", steps=120, window=5, seed=2)
    calm, busy, other = (numbers_of(tmp_path / f"{name}.mcap") for name in ("calm", "busy", "other"))
    assert calm == busy
    assert calm.keys() == other.keys()
    assert calm != other


def test_a_real_network_runs_and_is_replayed(tmp_path: Path) -> None:
    """Seen losses, lossy links, unbiased gains, an unstable plant: every process does what the model says.

    A second run of the seed sends the same messages bit for bit.
    """
    problem, steps = real_problem(5, radius=1.02, ny=(1, 2, 1)), 100
    gains_path = tmp_path / "gains.json"
    observer_gains(problem).save(gains_path)
    for name, window in (("first", 32), ("again", 2)):
        run_here(gains_path, tmp_path / f"{name}.mcap", steps=steps, seed=3, window=window)
    payloads, again = (numbers_of(tmp_path / f"{name}.mcap") for name in ("first", "again"))
    assert payloads == again
    verdict = judged(tmp_path / "first.mcap")
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
    for message in simulate(Gains.load(gains_path), steps=steps, seed=3):  # the tests' own plant and nodes
        if message.topic != "event":
            for key, expected in message.document.items():
                told = found[message.topic, message.document["step"]][key]
                same = key in ("mode", "heard")
                assert told == (expected if same else pytest.approx(expected, rel=1e-12, abs=1e-12))


def test_two_runs_at_once(gains_path: Path, tmp_path: Path) -> None:
    """Two runs on one machine do not disturb each other, though they have the same name and gains."""
    with started("run", gains_path, "--steps", 60, "--seed", 1, "-o", tmp_path / "first.mcap") as first:
        run_here(gains_path, tmp_path / "second.mcap", steps=60, seed=2)
        assert first.wait(60) == 0
    for name in ("first", "second"):
        assert judged(tmp_path / f"{name}.mcap").exit_code == 0


# Nothing is lost.
def test_frozen_recorder_slows_the_run(gains_path: Path, tmp_path: Path) -> None:
    """A recorder that stands still for two seconds holds a lock-step run up, and loses nothing from it."""

    def freeze_for_two_seconds() -> None:
        recorder = child(os.getpid(), "recorder")
        freeze(recorder)
        threading.Timer(2.0, thaw, [recorder]).start()

    recording = tmp_path / "run.mcap"
    run_here(gains_path, recording, at=10, do=freeze_for_two_seconds, steps=400, window=8)
    times = [message.log_time for message in logged(recording)]
    assert max(later - earlier for earlier, later in pairwise(times)) > 1.5e9  # it did stand still
    assert judged(recording).exit_code == 0


def test_roles_by_hand_with_a_late_recorder(gains_path: Path, tmp_path: Path, gains: Gains) -> None:
    """Roles started one by one as commands, the recorder last, when all the others wait for it: nothing is lost."""
    recording = tmp_path / "run.mcap"
    names = gains.problem.node_names
    with started("coordinator", gains_path, "--steps", 50, "--listen", "tcp/127.0.0.1:0") as coordinator:
        address = line_with(coordinator, "listening at").split()[-1]
        there = [started("node", gains_path, "--node", name, "--connect", address) for name in names]
        with there[0] as a, there[1] as b, there[2] as c, started("plant", gains_path, "--connect", address) as plant:
            for _ in range(len(names) + 1):
                line_with(coordinator, "is there")
            with started("recorder", gains_path, "-o", recording, "--connect", address) as recorder:
                for process in (coordinator, a, b, c, plant, recorder):
                    assert process.wait(60) == 0
    assert judged(recording).exit_code == 0


# What breaks a run, and what is left of it.
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signal_ends_the_run_in_order(gains_path: Path, tmp_path: Path, number: int) -> None:
    """Ctrl-C and SIGTERM: exit 130 or 143, soon, with a recording that is whole as far as it goes."""
    recording = tmp_path / "run.mcap"
    sent = 0.0

    def send() -> None:
        nonlocal sent
        sent = time.monotonic()
        os.kill(os.getpid(), number)

    with pytest.raises(Interrupted) as caught:
        run_here(gains_path, recording, at=20, do=send)
    assert time.monotonic() - sent < 10.0  # far below every time-out there is
    assert caught.value.exit_code == 128 + number
    end = end_of(recording)
    assert end is not None
    assert (end["status"], end["reason"]) == ("stopped", "interrupted" if number == signal.SIGINT else "terminated")
    verdict = judged(recording)
    assert (verdict.exit_code, verdict.finished, verdict.first_divergence) == (3, False, None)
    assert roles_left() == {}


def test_signal_before_the_start_ends_the_run(gains_path: Path, tmp_path: Path) -> None:
    """A run that is stopped while it gathers leaves nothing: no process, no file."""

    def stop(word: dict[str, Any]) -> None:
        if "listening" in word:
            os.kill(os.getpid(), signal.SIGTERM)

    started_at = time.monotonic()
    with pytest.raises(Interrupted):
        run_here(gains_path, tmp_path / "run.mcap", heed=stop)
    assert time.monotonic() - started_at < 10.0  # below the time that a recorder at work would be given
    assert roles_left() == {}
    assert list(tmp_path.iterdir()) == []


def test_killed_node_ends_the_run(gains_path: Path, tmp_path: Path, gains: Gains) -> None:
    """Kill -9 of a node: exit 3, the node and its step named, a readable recording, no process left."""
    name = gains.problem.node_names[1]
    recording = tmp_path / "run.mcap"
    with pytest.raises(RunBroken) as caught:
        run_here(gains_path, recording, at=20, do=kill("node", name))
    assert f'node "{name}" was lost' in str(caught.value)
    last = int(re.findall(r"is of step (\d+); what was recorded is in ", str(caught.value))[0])
    steps = [decoded(m).step for m in logged(recording) if m.topic == f"node/{name}/estimate"]
    assert last == max(steps) >= 20
    end = end_of(recording)
    assert end is not None
    assert end["status"] == "stopped"
    assert judged(recording).exit_code == 3
    assert roles_left() == {}


def test_killed_recorder_leaves_what_it_flushed(gains_path: Path, tmp_path: Path) -> None:
    """Kill -9 of the recorder: exit 3, and the .part file lacks at most the last half second."""
    recording = tmp_path / "run.mcap"
    killed = 0

    def kill_recorder() -> None:
        nonlocal killed
        killed = time.time_ns()
        kill("recorder")()

    with pytest.raises(RunBroken, match=r"the recorder was lost: .*; \d+ steps were complete"):
        run_here(gains_path, recording, at=800, do=kill_recorder)
    part = recording.with_name("run.mcap.part")
    assert end_of(part) is None
    assert killed - max(message.log_time for message in logged(part)) < 0.5e9
    assert judged(part).exit_code == 3
    assert not recording.exists()


def test_killed_coordinator_ends_the_run(gains_path: Path, tmp_path: Path) -> None:
    """Kill -9 of the coordinator: exit 3, the recorder closes the recording by itself, no process left."""
    recording = tmp_path / "run.mcap"
    with pytest.raises(RunBroken, match="the coordinator ended without a word: killed by SIGKILL"):
        run_here(gains_path, recording, at=20, do=kill("coordinator"))
    end = end_of(recording)
    assert end is not None
    assert end["status"] == "broken"
    assert "the coordinator was lost" in end["reason"]
    assert roles_left() == {}


def test_killed_launcher_leaves_no_process(gains_path: Path, tmp_path: Path) -> None:
    """Kill -9 of the launcher: its children notice, the recording is closed, nobody stays."""
    recording = tmp_path / "run.mcap"
    with started("run", gains_path, "--steps", MANY, "-o", recording) as launcher:
        while not recording.with_name("run.mcap.part").exists():  # the recorder opens it when the run starts
            assert launcher.poll() is None
            time.sleep(0.01)
        crew = list(children(launcher.pid))
        assert len(crew) == 6
        launcher.kill()
        wait_until_gone(crew)
    assert end_of(recording) is not None


def test_frozen_node_is_named_after_the_deadline(gains_path: Path, tmp_path: Path, gains: Gains) -> None:
    """A node that stands still is named with the step that lacks its estimate."""
    name = gains.problem.node_names[2]
    with pytest.raises(RunBroken, match=rf"step \d+ lacks node/{name}/estimate after 1 s"):
        run_here(
            gains_path,
            tmp_path / "run.mcap",
            at=20,
            do=lambda: freeze(child(os.getpid(), "node", name)),
            deadline=1.0,
        )
    assert roles_left() == {}


def test_garbage_on_a_topic_ends_the_run_in_order(gains_path: Path, tmp_path: Path) -> None:
    """A foreign message among the data: exit 3, one sentence that says where, and the recording is closed."""
    recording = tmp_path / "run.mcap"
    address = ""

    def garbage() -> None:
        config = zenoh.Config()
        config.insert_json5("connect/endpoints", f'["{address}"]')
        config.insert_json5("listen/endpoints", '["tcp/127.0.0.1:0"]')
        config.insert_json5("scouting/multicast/enabled", "false")
        with zenoh.open(config) as session:
            publisher = session.declare_publisher("peakmesh/test/event")
            while not publisher.matching_status.matching:
                time.sleep(0.01)
            for _ in range(3):
                publisher.put(b"hello")

    def listen(word: dict[str, Any]) -> None:
        nonlocal address
        address = word["listening"][0] if "listening" in word else address

    with pytest.raises(RunBroken, match="a message on event is not a Event: "):
        run_here(gains_path, recording, at=20, do=garbage, heed=listen)
    end = end_of(recording)
    assert end is not None
    assert end["status"] == "broken"


def test_files_of_the_current_folder_are_not_imported(
    gains_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An agent.py or queue.py that happens to lie where the run is started has no part in it."""
    for name in ("agent.py", "queue.py"):
        (tmp_path / name).write_text("raise SystemExit('imported')\n")
    monkeypatch.chdir(tmp_path)
    assert run_here(gains_path, tmp_path / "run.mcap", steps=5)["missing"] == 0


# Sensors of one's own.
def measured_by(
    script: Path, gains_path: Path, recording: Path, *, node: str, steps: int
) -> list[tuple[int, list[float]]]:
    """Run with a sensor script for one node; step and y of its measurements. Nothing is missing, the replay agrees."""
    sensor: list[subprocess.Popen[bytes]] = []

    def start_sensor(word: dict[str, Any]) -> None:
        if "listening" in word:
            sensor.append(subprocess.Popen([sys.executable, script, "own", node, word["listening"][0]]))

    try:
        summary = launch(
            gains_path,
            Gains.load(gains_path),
            Plan(steps=steps, seed=1, external=(node,)),
            run="own",
            recording=recording,
            force=False,
            wait=60.0,
            report=start_sensor,
        )
        assert sensor[0].wait(60) == 0  # it ends with the run
    finally:
        for process in sensor:
            process.kill()
            process.wait()
    assert summary["missing"] == 0
    assert judged(recording).exit_code == 0
    documents = [json.loads(m.payload) for m in logged(recording) if m.topic == f"node/{node}/measurement"]
    return [(document["step"], document["y"]) for document in documents]


def test_sensor_of_ones_own(gains_path: Path, tmp_path: Path, gains: Gains) -> None:
    """The script in docs/, plain zenoh, feeds one node; the others are simulated; the replay knows."""
    lines = [line for line in SENSOR.read_text().splitlines() if line.strip()]
    assert len(lines) < 20
    assert not any("peakmesh import" in line or "import agent" in line for line in lines)
    name = gains.problem.node_names[0]
    measured = measured_by(SENSOR, gains_path, tmp_path / "run.mcap", node=name, steps=60)
    assert measured == [(k, [0.0]) for k in range(60)]


def test_sensor_that_has_nothing_to_say(tmp_path: Path) -> None:
    """At every third step it publishes [], which a node that sees its losses takes for what it is."""
    problem, script, reading = real_problem(5, radius=1.02, ny=(1, 2, 1)), tmp_path / "sensor.py", '"y": [0.0]'
    assert problem.nodes[2].seen
    observer_gains(problem).save(tmp_path / "gains.json")
    text = SENSOR.read_text()
    assert text.count(reading) == 1
    script.write_text(text.replace(reading, '"y": [0.5] if json.loads(mode)["step"] % 3 else []'))
    measured = measured_by(script, tmp_path / "gains.json", tmp_path / "run.mcap", node="n2", steps=30)
    assert measured == [(k, [0.5] if k % 3 else []) for k in range(30)]


# Bad input.
def test_other_gains_are_refused(gains_path: Path, tmp_path: Path, gains: Gains) -> None:
    """A node that runs on other gains than the coordinator is named, and nothing starts."""
    other = tmp_path / "other.json"
    gains.model_copy(update={"method": "other"}).save(other)
    names = gains.problem.node_names
    with started("coordinator", gains_path, "--listen", "tcp/127.0.0.1:0") as coordinator:
        address = line_with(coordinator, "listening at").split()[-1]
        files = {name: other if name == names[1] else gains_path for name in names}
        there = [started("node", files[name], "--node", name, "--connect", address) for name in names]
        recorder = started("recorder", gains_path, "-o", tmp_path / "run.mcap", "--connect", address)
        plant = started("plant", gains_path, "--connect", address)
        with there[0] as a, there[1] as b, there[2] as c, plant as d, recorder as e:
            said = line_with(coordinator, "peakmesh: ")
            assert coordinator.wait(60) == 2
            assert [line_with(process, "peakmesh: ") for process in (a, b, c, d, e)] == [said] * 5
            assert [process.wait(60) for process in (a, b, c, d, e)] == [3] * 5
    assert f'node "{names[1]}" runs on other gains' in said
    assert not (tmp_path / "run.mcap").exists()


def test_port_in_use(gains_path: Path) -> None:
    """A port that is taken: exit 2, the address and the cause."""
    with started("coordinator", gains_path, "--listen", "tcp/127.0.0.1:0") as first:
        address = line_with(first, "listening at").split()[-1]
        second = peakmesh("coordinator", gains_path, "--listen", address)
    assert second.returncode == 2
    assert second.stderr == f"peakmesh: cannot listen on {address}: the port is in use; port 0 takes a free one\n"


def test_nobody_listens(gains_path: Path, gains: Gains) -> None:
    """A seed address where nobody is: exit 3, the address, and how long was waited."""
    name = gains.problem.node_names[0]
    done = peakmesh("node", gains_path, "--node", name, "--connect", "tcp/127.0.0.1:1", "--wait", "0.5")
    assert done.returncode == 3
    assert done.stderr.endswith(
        f'peakmesh: nobody of run "{gains.problem.name}" answered at tcp/127.0.0.1:1 within 0.5 s; '
        "is the coordinator running there, under the same --run?\n"
    )


def test_missing_participants_are_named(gains_path: Path) -> None:
    """A coordinator to whom nobody comes says who is missing: exit 3."""
    done = peakmesh("coordinator", gains_path, "--wait", "0.5")
    assert done.returncode == 3
    assert 'node "' in done.stderr
    assert "the plant and the recorder did not join the run within 0.5 s" in done.stderr


def test_unknown_node(gains_path: Path, gains: Gains) -> None:
    """An unknown node: exit 2, and the nodes that there are."""
    for arguments in (
        ("node", gains_path, "--node", "9", "--connect", "tcp/127.0.0.1:1"),
        ("run", gains_path, "--external", "9"),
    ):
        done = peakmesh(*arguments)
        assert done.returncode == 2
        assert 'peakmesh: node "9" does not exist; the problem has nodes' in done.stderr


def test_existing_recording_is_kept(gains_path: Path, tmp_path: Path) -> None:
    """A recording that exists is not replaced: exit 2, and not a byte of it changes."""
    recording = tmp_path / "run.mcap"
    recording.write_bytes(b"precious")
    done = peakmesh("run", gains_path, "--steps", 5, "-o", recording)
    assert done.returncode == 2
    assert "exists already" in done.stderr
    assert recording.read_bytes() == b"precious"


def test_child_that_cannot_start_is_reported(gains_path: Path, tmp_path: Path) -> None:
    """A role that fails before the start ends the run at once with its own sentence."""
    (tmp_path / "run.mcap.part").write_bytes(b"left over")
    with pytest.raises(InputError, match=r"run\.mcap\.part exists already"):
        run_here(gains_path, tmp_path / "run.mcap", steps=5)
    assert roles_left() == {}
