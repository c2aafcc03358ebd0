"""Sensors of one's own: the script in docs/, and what it may say."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import pytest
from made_recordings import observer_gains, real_problem
from places import ROOT
from runs import MANY, PATIENCE, logged, run_here

from agent.authority import Authority
from agent.contract.errors import Interrupted, RunBroken
from agent.contract.gains import Gains
from agent.contract.rights import everybody
from agent.network.session import CAPACITY
from designer.replay import replay

SENSOR = ROOT / "docs" / "sensor.py"


def measured_by(
    script: Path, gains_path: Path, recording: Path, *, node: str, steps: int, keys: Path | None = None
) -> list[tuple[int, list[float]]]:
    """Run with a sensor script for one node; step and y of its measurements. Nothing is missing, the replay agrees."""
    sensor: list[subprocess.Popen[bytes]] = []

    def start_sensor(word: dict[str, Any]) -> None:
        if "listening" in word:
            words = ["test", node, word["listening"][0], *([keys / f"sensor-{node}.json5"] if keys is not None else [])]
            sensor.append(subprocess.Popen([sys.executable, script, *words]))

    try:
        summary = run_here(gains_path, recording, heed=start_sensor, steps=steps, external=(node,), keys=keys)
        assert sensor[0].wait(PATIENCE) == 0  # it ends with the run
    finally:
        for process in sensor:
            process.kill()
            process.wait()
    assert summary["missing"] == 0
    assert replay(recording).exit_code == 0
    documents = [json.loads(m.payload) for m in logged(recording) if m.topic == f"node/{node}/measurement"]
    return [(document["step"], document["y"]) for document in documents]


def test_sensor_of_ones_own(pair_path: Path, tmp_path: Path, pair: Gains) -> None:
    """The script in docs/, plain zenoh, feeds one node; the others are simulated; the replay knows. All with keys."""
    lines = [line for line in SENSOR.read_text().splitlines() if line.strip()]
    assert len(lines) <= 30
    assert not any("peakmesh import" in line or "import agent" in line for line in lines)
    name = pair.problem.node_names[0]
    keys = tmp_path / "keys"
    keys.mkdir()
    Authority.create(keys, pair.problem.name, days=1).issue(everybody(pair.problem), days=1)
    measured = measured_by(SENSOR, pair_path, tmp_path / "run.mcap", node=name, steps=60, keys=keys)
    assert measured == [(k, [0.0]) for k in range(60)]


def test_sensor_that_has_nothing_to_say(tmp_path: Path) -> None:
    """At every third step it publishes [], which a node that sees its losses takes for what it is."""
    problem, script, reading = real_problem(5, radius=1.02, ny=(1, 1)), tmp_path / "sensor.py", '"y": [0.0]'
    assert problem.nodes[1].seen
    observer_gains(problem).save(tmp_path / "gains.json")
    text = SENSOR.read_text()
    assert text.count(reading) == 1
    script.write_text(text.replace(reading, '"y": [0.5] if json.loads(mode)["step"] % 3 else []'))
    measured = measured_by(script, tmp_path / "gains.json", tmp_path / "run.mcap", node="n1", steps=30)
    assert measured == [(k, [0.5] if k % 3 else []) for k in range(30)]


def test_a_sensor_that_is_too_far_ahead_breaks_the_run_with_a_sentence(
    pair_path: Path, tmp_path: Path, pair: Gains
) -> None:
    """It reads a file, say, and has sent more than anybody keeps before the run begins; nobody waits for the rest."""
    name, script, token = pair.problem.node_names[0], tmp_path / "sensor.py", "    ready = "
    text = SENSOR.read_text()
    assert text.count(token) == 1
    ahead = f"""    for step in range({2 * CAPACITY + 1}):
        y = json.dumps({{"step": step, "y": [0.0]}})
        session.put(f"{{base}}/node/{{node}}/measurement", y, congestion_control=zenoh.CongestionControl.BLOCK)
"""
    script.write_text(text.replace(token, ahead + token))
    said = (
        rf'(the recorder|node "{name}") has no room for step \d+ of node/{name}/measurement: {CAPACITY} messages wait'
    )
    with pytest.raises(RunBroken, match=said):
        measured_by(script, pair_path, tmp_path / "run.mcap", node=name, steps=MANY)


def test_a_forgotten_external_is_warned_of(pair_path: Path, tmp_path: Path, pair: Gains) -> None:
    """Both the sensor and the simulated plant measure the node; whoever looks at the coordinator reads so."""
    name = pair.problem.node_names[0]
    warned = threading.Event()

    def heed(word: dict[str, Any]) -> None:
        if f"without --external {name}" in word.get("warning", ""):
            warned.set()

    def wait() -> None:
        """The run goes on until the sensor was seen; then it is ended from here."""
        assert warned.wait(PATIENCE)
        os.kill(os.getpid(), signal.SIGTERM)

    sensors: list[subprocess.Popen[bytes]] = []

    def start_sensor(word: dict[str, Any]) -> None:
        heed(word)
        if "listening" in word:
            sensors.append(subprocess.Popen([sys.executable, SENSOR, "test", name, word["listening"][0]]))

    waiting = threading.Thread(target=wait)
    waiting.start()
    try:
        with pytest.raises(Interrupted):
            run_here(pair_path, tmp_path / "run.mcap", heed=start_sensor)
        assert sensors[0].wait(PATIENCE) == 0
    finally:
        for process in sensors:
            process.kill()
            process.wait()
        waiting.join()
    assert warned.is_set()


def test_run_tells_where_the_sensor_is_to_connect(pair_path: Path, tmp_path: Path, pair: Gains) -> None:
    """`peakmesh run --external`: the run's name and the address, on stderr, before it waits; they are all it needs."""
    name, recording = pair.problem.node_names[0], tmp_path / "run.mcap"
    words = ["run", pair_path, "--external", name, "--steps", "20", "--wait", str(PATIENCE), "-o", recording]
    with subprocess.Popen(
        [sys.executable, "-m", "agent", *map(str, words), "--deadline", str(PATIENCE)],
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        text=True,
    ) as run:
        sensor = None
        try:
            assert run.stderr is not None
            told = next(line for line in run.stderr if "waits for its sensor" in line)
            found = re.fullmatch(rf'node "{name}" waits for its sensor: run (\S+), address (\S+)\n', told)
            assert found is not None
            sensor = subprocess.Popen([sys.executable, SENSOR, found[1], name, found[2]])
            run.stderr.read()
            assert (run.wait(PATIENCE), sensor.wait(PATIENCE)) == (0, 0)
        finally:
            run.terminate()
            if sensor is not None:
                sensor.kill()
                sensor.wait()
    assert len([m for m in logged(recording) if m.topic == f"node/{name}/measurement"]) == 20


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([], "python sensor.py RUN NODE ADDRESS-OF-COORDINATOR [KEYS]. For example: python sensor.py "),
        (["a-run", "3"], "python sensor.py RUN NODE ADDRESS-OF-COORDINATOR [KEYS]. For example: python sensor.py "),
        (["a-run", "3", "127.0.0.1:7447"], "sensor.py a-run 3 127.0.0.1:7447: no address like tcp/127.0.0.1:7447, "),
        (["a-run", "3", "tcp/127.0.0.1:1", "no-such-file"], "or no KEYS like sensor-3.json5"),
    ],
)
def test_wrong_arguments_are_refused_in_a_sentence(words: list[str], said: str) -> None:
    ran = subprocess.run([sys.executable, SENSOR, *words], capture_output=True, text=True, timeout=PATIENCE)
    assert ran.returncode == 1
    assert said in ran.stderr
    assert ran.stderr.count("\n") == 1


def test_a_sensor_that_finds_nobody_says_so(tmp_path: Path) -> None:
    """It goes on waiting, for the others may come."""
    script = tmp_path / "sensor.py"
    script.write_text(SENSOR.read_text().replace("timeout=10", "timeout=0.1"))
    words = [sys.executable, script, "a-run", "3", "tcp/127.0.0.1:1"]
    with subprocess.Popen(words, stderr=subprocess.PIPE, text=True) as sensor:
        assert sensor.stderr is not None
        for _ in range(2):
            said = sensor.stderr.readline()
            assert said == "sensor.py waits for coordinator, node-3, recorder of peakmesh/a-run at tcp/127.0.0.1:1\n"
        sensor.kill()
