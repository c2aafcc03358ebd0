"""The layer that a replay writes: what it found at every step, at its time, in schemas that viewers know."""

from __future__ import annotations

import json
import random
import re
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rewriting
from foxglove.messages import Event, KeyValuePair, Log, LogLevel, Timestamp
from foxglove_settings import faults
from here import here
from jsonschema import Draft202012Validator
from made_recordings import Sent, random_gains, random_problem, real_problem, record, simulate
from mcap.reader import make_reader
from places import GOLDEN
from rewriting import merged
from runs import logged

from agent.contract.gains import Gains
from agent.contract.schedule import Deliveries
from designer.replay import judge, replay
from designer.replay import log as logs
from designer.replay.audit import OF_NODE, OF_STEP, Audit, audit_layout, write_audit
from designer.replay.times import Times
from designer.replay.verdict import Verdict

STEPS = 30
NETWORK = random_gains(real_problem(6, unbiased=False, nz=2))  # seen losses and lossy links
Found = dict[str, list[tuple[int, dict[str, Any]]]]  # log time and message, by topic


@pytest.fixture(scope="module")
def sent() -> list[Sent]:
    return simulate(NETWORK, steps=STEPS)


def read(path: Path) -> Found:
    """Every message of a layer, each held against its schema by somebody else's validator."""
    found: Found = defaultdict(list)
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            assert schema is not None
            document = json.loads(message.data)
            Draft202012Validator(json.loads(schema.data)).validate(document)
            assert schema.name == SCHEMAS.get(channel.topic, "peakmesh.AuditNode")
            found[channel.topic].append((message.log_time, document))
    return found


SCHEMAS = {"audit/step": "peakmesh.AuditStep", "audit/event": "foxglove.Event", "audit/log": "foxglove.Log"}


def audited(path: Path, output: Path) -> Found:
    verdict = written(path, output)
    assert verdict.document() == replay(path).document()  # writing changes nothing
    return read(output)


def written(path: Path, output: Path) -> Verdict:
    log = logs.load(path)
    audit = Audit(log)
    verdict = judge(log, audit)
    write_audit(log, verdict, audit, Times(logged(path), log.steps), output)
    return verdict


def write(folder: Path, sent: list[Sent], gains: Gains = NETWORK, **facts: Any) -> Path:
    return record(folder / "run.mcap", gains, sent, steps=STEPS, **facts)


def told(found: Found, kind: str) -> list[dict[str, str]]:
    """The events of a kind."""
    events = [{pair["key"]: pair["value"] for pair in event["metadata"]} for _, event in found["audit/event"]]
    return [event for event in events if event["kind"] == kind]


def recorded_at(path: Path) -> dict[tuple[str, int], int]:
    return {(m.topic, json.loads(m.payload)["step"]): m.log_time for m in logged(path) if m.topic != "event"}


# numbers
def test_errors_and_energy_are_those_of_the_messages(sent: list[Sent], tmp_path: Path) -> None:
    path = write(tmp_path, sent)
    found, log = audited(path, tmp_path / "audit.mcap"), logs.load(path)
    energy = np.cumsum((log.w**2).sum(axis=1)) - (log.w**2).sum(axis=1)
    steps = [message for _, message in found["audit/step"]]
    assert [message["step"] for message in steps] == list(range(STEPS))
    assert [message["energy"] for message in steps] == pytest.approx(energy)
    assert [message["error"] for message in steps] == pytest.approx(log.error_norms())
    nodes = [found[f"audit/node/{name}"] for name in NETWORK.problem.node_names]
    weights = NETWORK.problem.weights
    for k, of_nodes in enumerate(zip(*nodes, strict=True)):
        squares = [(weight * message["error"]) ** 2 for weight, (_, message) in zip(weights, of_nodes, strict=True)]
        assert sum(squares) == pytest.approx(log.error_norms()[k] ** 2)


def test_the_bound_is_the_largest_singular_value_of_what_w_does(sent: list[Sent], tmp_path: Path) -> None:
    """gamma_path(k): by running each w that is 1 at one place through the same modes, losses and deliveries."""
    from designer.model.error_model import realised
    from designer.replay.central import Central

    path = write(tmp_path, sent)
    log, central = logs.load(path), Central.of(NETWORK)
    steps = [message for _, message in audited(path, tmp_path / "audit.mcap")["audit/step"]]
    deliveries, columns = Deliveries(NETWORK.problem, seed=1), []
    model, size = central.model, central.model.size
    state = np.zeros((size, 0))
    for k in range(STEPS):
        gain = np.linalg.norm(model.M @ state, 2) if k else 0.0
        columns.append(gain)
        AB = realised(model, int(log.mode[k]), log.theta[k], deliveries.at(k).astype(bool))
        state = np.hstack([AB[:, :size] @ state, AB[:, size:]])
    assert [message.get("gamma_path", 0.0) for message in steps] == pytest.approx(columns)
    for message in steps[1:]:
        assert message["path_bound"] == pytest.approx(message["gamma_path"] * message["energy"] ** 0.5)
        assert message["margin"] == pytest.approx(1.0 - message["error"] / message["path_bound"])


def test_gaps_are_those_of_the_verdict(sent: list[Sent], tmp_path: Path) -> None:
    path = write(tmp_path, sent)
    found, verdict = audited(path, tmp_path / "audit.mcap"), replay(path)
    for proof in verdict.proofs[:3]:
        gaps = [message.get(f"gap_{proof.number}", 0.0) for _, message in found["audit/step"]]
        assert max(gaps) == proof.worst_gap
    assert {message["tolerance"] for _, message in found["audit/step"]} == {verdict.tolerance}
    of_nodes = [m["gap"] for topic, all_of in found.items() if topic.startswith("audit/node") for _, m in all_of]
    assert max(of_nodes) <= verdict.worst_gap
    assert (told(found, "divergence"), told(found, "missing")) == ([], [])


def test_gamma_is_beside_the_bound_where_it_is_claimed(tmp_path: Path) -> None:
    steps = [message for _, message in audited(GOLDEN / "zhu2020-lossy.mcap", tmp_path / "audit.mcap")["audit/step"]]
    gamma = replay(GOLDEN / "zhu2020-lossy.mcap").gamma.value
    assert [message["mean_bound"] for message in steps] == pytest.approx([gamma * m["energy"] ** 0.5 for m in steps])


# what happened, and when
def test_every_loss_is_an_event_at_its_time(sent: list[Sent], tmp_path: Path) -> None:
    path = write(tmp_path, sent)
    found, times = audited(path, tmp_path / "audit.mcap"), recorded_at(path)
    problem = NETWORK.problem
    expected = {
        (message.document["step"], node.name): times[
            f"node/{node.name}/measurement" if node.seen else "plant/state", message.document["step"]
        ]
        for message in sent
        if message.topic == "plant/state"
        for node, arrived in zip(problem.nodes, message.document["arrived"], strict=True)
        if not arrived
    }
    assert len(expected) > 3
    losses = {
        (int(event["step"]), event["node"]): time
        for (time, _), event in zip(found["audit/event"], told_all(found), strict=True)
        if event["kind"] == "loss"
    }
    assert losses == expected


def told_all(found: Found) -> list[dict[str, str]]:
    return [{pair["key"]: pair["value"] for pair in event["metadata"]} for _, event in found["audit/event"]]


def test_every_message_that_was_not_used_is_an_event(sent: list[Sent], tmp_path: Path) -> None:
    """Those that the seed loses, of neighbours in the present mode."""
    problem, deliveries = NETWORK.problem, Deliveries(NETWORK.problem, seed=1)
    found = audited(write(tmp_path, sent), tmp_path / "audit.mcap")
    modes = {message.document["step"]: message.document["mode"] for message in sent if message.topic == "mode"}
    expected = {
        (k, problem.node_names[i], problem.node_names[j])
        for k in range(STEPS - 1)
        for i in range(problem.n)
        for j in problem.neighbours(problem.mode_index(modes[k]), i)
        if not deliveries.at(k)[i, j]
    }
    pattern = r'node "(\S+)" did not use the message of node "(\S+)"'
    events = told(found, "substitution")
    said = {(int(event["step"]), *re.match(pattern, event["text"]).groups()) for event in events}  # type: ignore[union-attr]
    assert len(expected) > 3
    assert said == expected


@pytest.mark.parametrize(
    ("topic", "change", "field"),
    [
        ("node/n1/estimate", lambda m: m["x_hat"].__setitem__(0, m["x_hat"][0] + 1e-6), "x_hat[0]"),
        ("node/n2/estimate", lambda m: m["z_hat"].__setitem__(1, m["z_hat"][1] + 1e-6), "z_hat[1]"),
        ("node/n0/measurement", lambda m: m["y"].__setitem__(0, m["y"][0] + 1e-6), "y[0]"),
        ("plant/state", lambda m: m["w"].__setitem__(0, m["w"][0] + 1e-6), "w[0]"),
        ("mode", lambda m: m.__setitem__("mode", "mode-0" if m["mode"] != "mode-0" else "mode-1"), "mode"),
        ("node/n1/estimate", lambda m: m.__setitem__("heard", ["n1"] if m["heard"] != ["n1"] else []), "heard"),
    ],
)
def test_what_diverges_is_named_at_its_step_and_time(topic: str, change: Any, field: str, tmp_path: Path) -> None:
    gains = random_gains(random_problem(5, nz=2))
    sent = simulate(gains, steps=STEPS)
    message = next(m for m in sent if m.topic == topic and m.document["step"] == 6)
    plain = {
        name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in message.document.items()
    }
    message.document.update(plain)
    change(message.document)
    path = write(tmp_path, sent, gains)
    found, verdict = audited(path, tmp_path / "audit.mcap"), replay(path)
    assert not verdict.agrees
    events = told(found, "divergence")
    node = topic.split("/")[1] if topic.startswith("node/") else None
    mine = [event for event in events if f"step 6: {field} of" in event["text"]]
    assert {event.get("node") for event in mine} == {node}
    assert verdict.first_divergence is not None
    assert verdict.first_divergence.text() in events[0]["text"]
    told_at = [time for (time, _), event in zip(found["audit/event"], told_all(found), strict=True) if event in events]
    assert len(told_at) == len(events)
    assert set(told_at) <= set(recorded_at(path).values())
    levels = {line["level"] for _, line in found["audit/log"] if line["name"] == "divergence"}
    assert levels == {4}  # an error
    assert found["audit/log"][-1][1]["message"].endswith(f"replay: DIVERGES, {STEPS} of {STEPS} steps")


def test_missing_messages_are_named(sent: list[Sent], tmp_path: Path) -> None:
    gone = {("mode", 2), ("node/n1/estimate", 5), ("plant/state", 7)}
    path = write(tmp_path, [m for m in sent if (m.topic, m.document["step"]) not in gone])
    found = audited(path, tmp_path / "audit.mcap")
    events = told(found, "missing")
    assert {(event["text"], int(event["step"])) for event in events} == {
        (f"the message of {topic} is not in the file", step) for topic, step in gone
    }
    without = [m for m in sent if m.topic != "node/n1/measurement"]
    (tmp_path / "run.mcap").unlink()
    (tmp_path / "audit.mcap").unlink()
    found = audited(write(tmp_path, without), tmp_path / "audit.mcap")
    assert [event["text"] for event in told(found, "missing")] == ["no message of node/n1/measurement is in the file"]


# schemas and layout
def test_events_and_lines_are_those_of_foxglove(sent: list[Sent], tmp_path: Path) -> None:
    """Its own SDK takes every field, and no field is left out."""
    found = audited(write(tmp_path, sent), tmp_path / "audit.mcap")
    assert len(found["audit/event"]) == len(found["audit/log"]) > 5
    for (time, event), (same, line) in zip(found["audit/event"], found["audit/log"], strict=True):
        assert time == same
        assert event["start_time"]["sec"] * 10**9 + event["start_time"]["nsec"] == time
        times = {name: Timestamp(**event[name]) for name in ("start_time", "end_time")}
        Event(**event | times | {"metadata": [KeyValuePair(**pair) for pair in event["metadata"]]})
        Log(**line | {"timestamp": Timestamp(**line["timestamp"]), "level": LogLevel.Info})
        assert set(line) == {"timestamp", "level", "message", "name", "file", "line"}


def test_its_layout_shows_what_is_there(sent: list[Sent], tmp_path: Path) -> None:
    path, output = write(tmp_path, sent), tmp_path / "audit.mcap"
    found = audited(path, output)
    document = audit_layout(NETWORK.problem)
    panels = document["configById"]
    assert [faults(panel) for name, panel in panels.items() if name.startswith("Plot!")] == [[]] * 5
    topics = {message.topic for message in logged(path)} | set(found)
    for topic, field in re.findall(r'"(?:value|xValuePath)": "([\w/-]+)\.(\w+)', json.dumps(document)):
        assert topic in topics
        known = OF_STEP if topic == "audit/step" else OF_NODE
        assert not topic.startswith("audit/") or field in {"step", *known}
    assert panels["RosOut!happenings"]["topicToRender"] in found
    with output.open("rb") as file:
        attached = {a.name: json.loads(a.data) for a in make_reader(file).iter_attachments()}
    assert attached["audit-layout.json"] == document
    assert attached["verdict.json"] == json.loads(json.dumps(replay(path).document()))


# other logs
def test_without_a_plant_there_are_gaps_and_no_errors(tmp_path: Path) -> None:
    gains = random_gains(random_problem(5))
    rng = np.random.default_rng(0)
    y = {node.name: rng.normal(size=(STEPS, len(node.C))) for node in gains.problem.nodes}
    sent = [message for message in simulate(gains, steps=STEPS, real_y=y) if message.topic != "plant/state"]
    found = audited(write(tmp_path, sent, gains, external=",".join(y)), tmp_path / "audit.mcap")
    for _, message in found["audit/step"]:
        assert set(message) <= {"step", "gap_1", "gap_2", "gap_3", "tolerance"}
    assert all("gap" in message and "error" not in message for _, message in found["audit/node/n0"])
    assert (told(found, "missing"), told(found, "loss")) == ([], [])


def test_cut_and_empty_recordings_have_a_layer(sent: list[Sent], tmp_path: Path) -> None:
    for name, part in (("half", sent[: len(sent) // 2]), ("empty", [])):
        folder = tmp_path / name
        folder.mkdir()
        found = audited(write(folder, part, whole=False), folder / "audit.mcap")
        assert len(found["audit/step"]) == len({m.document["step"] for m in part if m.topic != "event"})
        assert found["audit/log"][-1][1]["name"] == "verdict"


def test_many_divergences_are_counted_and_the_first_written(
    sent: list[Sent], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("designer.replay.audit.MOST_DIVERGENCES", 3)
    nudged = simulate(NETWORK, steps=STEPS, nudge=(3, "n1", 1e-3))
    output = tmp_path / "audit.mcap"
    found = audited(write(tmp_path, nudged), output)
    assert len(told(found, "divergence")) == 3
    with output.open("rb") as file:
        (facts,) = [record.metadata for record in make_reader(file).iter_metadata()]
    assert int(facts["divergences"]) > 3
    assert facts["agrees"] == "false"


# the command
def test_the_command_writes_it_whatever_the_verdict(sent: list[Sent], tmp_path: Path) -> None:
    nudged = simulate(NETWORK, steps=STEPS, nudge=(3, "n1", 1e-3))
    path, output = write(tmp_path, nudged), tmp_path / "audit.mcap"
    done = here("replay", path, "--write", output)
    assert done.returncode == 1
    assert f"layer      {output}" in done.stdout
    assert read(output)["audit/step"]
    before = output.read_bytes()
    again = here("replay", path, "--write", output)
    assert (again.returncode, again.stdout) == (2, "")
    assert "exists already" in again.stderr
    assert output.read_bytes() == before
    assert json.loads(here("replay", path, "--write", output, "--force", "--json").stdout)["written"] == str(output)
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["audit.mcap", "run.mcap"]


def test_merged_with_it_the_recording_is_what_it_was(sent: list[Sent], tmp_path: Path) -> None:
    """As the field's tools merge: messages by time, everything else of both."""
    path, output = write(tmp_path, sent), tmp_path / "audit.mcap"
    written(path, output)
    both = merged([rewriting.read(path), rewriting.read(output)], random.Random(1))
    verdict = replay(rewriting.write(tmp_path / "both.mcap", both))
    assert (verdict.agrees, verdict.exit_code, verdict.missing.total) == (True, 0, 0)
    assert [proof.holds for proof in verdict.proofs] == [proof.holds for proof in replay(path).proofs]


def test_a_layer_is_no_recording(sent: list[Sent], tmp_path: Path) -> None:
    output = tmp_path / "audit.mcap"
    written(write(tmp_path, sent), output)
    done = here("replay", output)
    assert (done.returncode, done.stdout) == (2, "")
    assert "not a recording" in done.stderr
    assert judge(logs.load(tmp_path / "run.mcap")).agrees
