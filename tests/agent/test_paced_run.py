"""Paced runs with real processes: nothing stops, whatever befalls them, and the replay says why it was so.

On a machine that is busy messages are late; so what is asserted is that each substitution has its cause, not that
there is none.
"""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from places import ROOT
from runs import PATIENCE, answer, decoded, line_with, logged, peakmesh, started

from agent.contract.gains import Gains
from agent.contract.keys import EVIDENCE
from agent.contract.messages import Event
from agent.contract.recording.reader import RecordingReader
from designer.replay import replay
from designer.replay.verdict import Verdict

STEPS = 40
PERIOD = ("--period", "100ms", "--steps", STEPS, "--seed", 3)


@pytest.fixture(scope="session")
def gains_path(gains: Gains, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("gains") / "gains.json"
    gains.save(path)
    return path


def survived(gains_path: Path, recording: Path, *faults: str) -> tuple[dict[str, Any], Verdict]:
    """What a run with these faults says of itself, and its replay, which agrees to the last message."""
    options = [word for fault in faults for word in ("--fault", fault)]
    ran = peakmesh("run", gains_path, *PERIOD, *options, "-o", recording, "--json")
    assert ran.returncode == 0, ran.stderr
    verdict = replay(recording)
    assert verdict.exit_code == 0, verdict.text()
    assert all(proof.holds and proof.compared for proof in verdict.proofs)
    assert verdict.steps == STEPS
    assert verdict.pacing is not None
    assert verdict.pacing.faults == faults
    assert answer(ran)["ledger"] == (verdict.ledger.document() if verdict.ledger else None)
    return answer(ran), verdict


def events(recording: Path, kind: str) -> list[Event]:
    found = [decoded(message) for message in logged(recording) if message.topic == "event"]
    return [event for event in found if isinstance(event, Event) and event.kind == kind]


def test_a_paced_run_keeps_time_and_explains_itself(gains_path: Path, tmp_path: Path) -> None:
    """On the absolute schedule; what was substituted is counted the same by the nodes and by the replay."""
    recording = tmp_path / "run.mcap"
    facts, verdict = survived(gains_path, recording)
    pacing = facts["pacing"]
    assert verdict.pacing is not None
    assert verdict.pacing.unexplained_total == 0
    assert pacing["accounts"] == ["node-n0", "node-n1", "node-n2"]
    assert pacing["measurements_substituted"] == verdict.pacing.measurements_substituted
    assert 0 <= pacing["pairs_substituted"] - verdict.pacing.pairs_substituted <= 6  # of the last step, none is told
    assert 0.0 < pacing["to_estimate_median"] <= pacing["to_estimate_p99"] <= 1.02 * pacing["to_estimate_max"]
    assert 0.0 < pacing["to_step_median"] <= pacing["to_step_p99"] <= 1.02 * pacing["to_step_max"]
    sent = [message.publish_time for message in logged(recording) if message.topic == "mode"]
    stood = sum(float(event.detail.split("still for ")[1].split(" s")[0]) for event in events(recording, "stood"))
    assert (sent[-1] - sent[0]) / 1e9 == pytest.approx(0.1 * (STEPS - 1) + stood, abs=0.1)  # a period: the last's delay


def test_a_killed_node_rejoins(gains_path: Path, tmp_path: Path) -> None:
    """It says from whom it has its estimate; the others go on without it."""
    recording = tmp_path / "run.mcap"
    _, verdict = survived(gains_path, recording, "kill:node=n1,step=10")
    (began,) = events(recording, "began")
    assert began.who == "node-n1"
    assert began.steps[0] > 10
    assert verdict.pacing is not None
    assert len(verdict.pacing.beginnings) == 1
    last = began.steps[0] - 1
    assert verdict.pacing.absences == (f'node "n1" in {"step 10" if last == 10 else f"steps 10 to {last}"}',)
    assert ("gone", "node-n1") in {(event.kind, event.about) for event in events(recording, "gone")}
    others = [m for m in logged(recording) if m.topic in ("node/n0/estimate", "node/n2/estimate")]
    assert len(others) == 2 * STEPS


def test_a_frozen_node_is_late_and_not_fatal(gains_path: Path, tmp_path: Path) -> None:
    """It makes up for every step that it has missed; the others have noticed within two seconds."""
    recording = tmp_path / "run.mcap"
    _, verdict = survived(gains_path, recording, "freeze:node=n0,step=8,for=1.5s")
    assert verdict.pacing is not None
    assert verdict.pacing.absences == ()
    about = [
        event for kind in ("late", "silent") for event in events(recording, kind) if event.about == "node/n0/estimate"
    ]
    assert about
    assert min(event.step for event in about) <= 8 + 20 + 10  # two seconds, and one for a busy machine


def test_the_coordinator_goes_on_with_the_same_chain(gains_path: Path, tmp_path: Path) -> None:
    """Killed at step 12: mode 12 comes from the process after it, and every mode is the seed's."""
    recording = tmp_path / "run.mcap"
    survived(gains_path, recording, "kill:coordinator,step=12")
    (resumed,) = events(recording, "resumed")
    assert resumed.detail == "the coordinator goes on at step 12"
    modes = [decoded(message).step for message in logged(recording) if message.topic == "mode"]
    assert modes == list(range(STEPS))


def test_the_plant_goes_on_from_where_it_would_be(gains_path: Path, tmp_path: Path) -> None:
    recording = tmp_path / "run.mcap"
    _, verdict = survived(gains_path, recording, "kill:plant,step=10")
    states = [decoded(message).step for message in logged(recording) if message.topic == "plant/state"]
    assert 10 not in states
    assert max(states) == STEPS - 1
    assert verdict.pacing is not None
    assert verdict.pacing.measurements_substituted >= 3


def test_the_recorder_goes_on_in_a_second_part(gains_path: Path, tmp_path: Path) -> None:
    """Nothing in between is lost: the publishers have kept what it had not written."""
    recording = tmp_path / "run.mcap"
    facts, verdict = survived(gains_path, recording, "kill:recorder,step=15")
    parts = [tmp_path / "run.mcap", tmp_path / "run.part2.mcap"]
    assert sorted(tmp_path.iterdir()) == parts
    assert facts["missing"] == 0
    assert facts["messages"] == verdict.messages == sum(message.topic != EVIDENCE for message in logged(recording))
    assert [alone(part) for part in parts] == ["continues", "finished"]
    assert verdict.pacing is not None
    assert verdict.pacing.absences == ()


def alone(part: Path) -> str:
    """How a part says that it ends."""
    with RecordingReader(part, follows=False) as reader:
        assert list(reader.messages())
        return (reader.end or {})["status"]


def test_everything_at_once(gains_path: Path, tmp_path: Path) -> None:
    """A node, the plant, the recorder and the coordinator, one after the other before any of them is back.

    On a busy machine the recorder may not have on disk yet what the others said last: that is lost with them, and run
    and replay both say that the record is not whole. Nobody is accused.
    """
    recording = tmp_path / "run.mcap"
    kills = ("kill:node=n2,step=8", "kill:plant,step=10", "kill:recorder,step=12", "kill:coordinator,step=13")
    options = [word for kill in kills for word in ("--fault", kill)]
    ran = peakmesh("run", gains_path, *PERIOD, *options, "-o", recording, "--json")
    summary, verdict = answer(ran), replay(recording)
    assert not summary["broken_off"], ran.stderr
    assert ran.returncode == (3 if summary["not_whole"] else 0)
    assert verdict.exit_code in ((0, 3) if summary["not_whole"] else (0,)), verdict.text()
    assert all(proof.holds for proof in verdict.proofs)
    assert verdict.steps == STEPS
    assert verdict.pacing is not None
    assert verdict.pacing.faults == kills
    assert len(verdict.pacing.beginnings) == 1
    modes = [decoded(message).step for message in logged(recording) if message.topic == "mode"]
    assert sorted(modes) == list(range(STEPS)) or summary["not_whole"]


def test_several_faults_at_once(gains_path: Path, tmp_path: Path) -> None:
    delays = [f"delay:node={name},by=90ms,steps=8-20" for name in ("n0", "n1", "n2")]
    faults = ("mute-link:n0>n1,steps=5-30", *delays, "drop:probability=0.1")
    _, verdict = survived(gains_path, tmp_path / "run.mcap", *faults)
    assert verdict.pacing is not None
    assert verdict.pacing.pairs_substituted > 0
    assert verdict.pacing.measurements_substituted > 0
    assert verdict.pacing.unexplained_total == 0
    assert {"late", "silent"} <= verdict.pacing.reasons.keys()
    for event in events(tmp_path / "run.mcap", "late"):
        if event.about.endswith("estimate") and event.steps[event.seconds.index(max(event.seconds))] in range(8, 21):
            assert event.way[1] > 0.089  # on the wire


def test_every_node_with_a_sensor_needs_no_plant(gains_path: Path, tmp_path: Path, gains: Gains) -> None:
    """The script of the documents, once for each node; the clock of the run is the coordinator's."""
    recording, names = tmp_path / "run.mcap", gains.problem.node_names
    external = [word for name in names for word in ("--external", name)]
    scripts, text = {}, (ROOT / "docs" / "sensor.py").read_text()
    for node in gains.problem.nodes:
        scripts[node.name] = tmp_path / f"sensor-{node.name}.py"
        scripts[node.name].write_text(text.replace('"y": [0.0]', f'"y": {[0.0] * len(node.C)}'))
    sensors: list[subprocess.Popen[bytes]] = []
    try:
        with started(
            "coordinator", gains_path, "--run", "own", "--period", "100ms", "--steps", 20, *external
        ) as coordinator:
            address = line_with(coordinator, "listening at").split()[-1]
            common = ("--run", "own", "--connect", address)
            nodes = [started("node", gains_path, "--node", name, *common) for name in names]
            recorder = started("recorder", gains_path, "-o", recording, *common)
            with nodes[0] as a, nodes[1] as b, nodes[2] as c, recorder as d:
                sensors = [subprocess.Popen([sys.executable, scripts[name], "own", name, address]) for name in names]
                everybody = (coordinator, a, b, c, d)
                codes = [process.wait(PATIENCE) for process in everybody]
                assert codes == [0] * 5
        assert [sensor.wait(PATIENCE) for sensor in sensors] == [0] * 3
    finally:
        for sensor in sensors:
            sensor.kill()
            sensor.wait()
    verdict = replay(recording)
    assert verdict.exit_code == 0, verdict.text()
    assert not verdict.is_simulated
    documents = [json.loads(m.payload) for m in logged(recording) if m.topic.endswith("measurement")]
    assert len(documents) == 20 * 3


def test_whoever_is_started_twice_is_refused(gains_path: Path, tmp_path: Path, gains: Gains) -> None:
    """One sentence and exit 2, for every role; the run of the first does not notice."""
    recording, names = tmp_path / "run.mcap", gains.problem.node_names

    def taken(words: str) -> str:
        return f'peakmesh: {words} takes part in run "own" already; start it once'

    with contextlib.ExitStack() as stack:
        coordinator = stack.enter_context(
            started("coordinator", gains_path, "--run", "own", "--period", "100ms", "--steps", 100)
        )
        address = line_with(coordinator, "listening at").split()[-1]
        common = ("--run", "own", "--connect", address)
        nodes = [started("node", gains_path, "--node", name, *common) for name in names]
        recorder = started("recorder", gains_path, "-o", recording, *common)
        with nodes[0] as a, nodes[1] as b, nodes[2] as c, started("plant", gains_path, *common) as e:
            line_with(coordinator, 'node "n0" is there')
            early = peakmesh("node", gains_path, "--node", "n0", *common)
            assert (early.returncode, early.stderr.splitlines()[-1]) == (2, taken('node "n0"'))
            d = stack.enter_context(recorder)
            line_with(coordinator, "the run starts")
            for words, role in (
                ('node "n1"', ("node", gains_path, "--node", "n1")),
                ("the plant", ("plant", gains_path)),
                ("the recorder", ("recorder", gains_path, "-o", tmp_path / "again.mcap")),
                ("the coordinator", ("coordinator", gains_path, "--steps", 10)),
            ):
                second = peakmesh(*role, *common)
                assert second.returncode == 2
                said = second.stderr.splitlines()[-1]
                assert said == taken(words)
            everybody = (coordinator, a, b, c, d, e)
            assert [process.wait(PATIENCE) for process in everybody] == [0] * 6, [
                p.communicate()[1][-200:] for p in everybody
            ]
    verdict = replay(recording)
    assert verdict.exit_code == 0, verdict.text()
    assert verdict.pacing is not None
    assert (verdict.pacing.beginnings, verdict.pacing.absences) == ((), ())
    assert not (tmp_path / "again.mcap").exists()


@pytest.mark.parametrize(
    ("options", "why"),
    [
        (("--fault", "kill:node=n1,step=3"), "a lock-step run survives nothing; --period makes it a paced one"),
        (("--period", "100ms", "--fault", "kill:node=9,step=3"), 'node "9" does not exist'),
        (("--period", "1ns"), "1ns is not a time from 1ms to 1h"),
        (("--period", "100ms", "--measure-by", "0.9"), "--measure-by 0.9 must be less than --hear-by 0.8"),
        (("--period", "100ms", "--hear-by", "1.5"), "1.5 is not a part of a period"),
    ],
)
def test_what_is_impossible_is_refused(gains_path: Path, tmp_path: Path, options: tuple[str, ...], why: str) -> None:
    done = peakmesh("run", gains_path, "-o", tmp_path / "run.mcap", *options)
    assert done.returncode == 2
    assert why in done.stderr
    assert list(tmp_path.iterdir()) == []
