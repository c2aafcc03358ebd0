"""Proof 4 names a message that is not what its sender sent; what lacks evidence is said, and accuses nobody."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

import pytest
from made_recordings import random_gains, random_problem, record, simulate
from rewriting import Item, read, write
from runs import alone

from agent.contract.files import canonical
from agent.contract.keys import EVIDENCE, PLANT_STATE, estimate, measurement
from agent.contract.messages import Stamp, digest_of
from agent.contract.recording import writer
from agent.contract.recording.parts import files_of
from agent.contract.recording.writer import Split
from agent.roles.record import Record
from designer.replay import replay
from designer.replay.part import Part

GAINS = random_gains(random_problem(5, ny=(1, 2), modes=2))
STEPS = 90
MESSAGES = STEPS * 6 + 2


@pytest.fixture
def honest(tmp_path: Path) -> Path:
    return record(tmp_path / "run.mcap", GAINS, simulate(GAINS, steps=STEPS), steps=STEPS)


def changed(path: Path, topic: str, step: int, by: Callable[[Item], list[Item]]) -> Path:
    """The file with another message, or none, in the place of one, as a tool writes it: every checksum fits."""
    contents = read(path)
    items: list[Item] = []
    for item in contents.items:
        ours = item.topic == topic and json.loads(item.payload)["step"] == step
        items += by(item) if ours else [item]
    return write(path.with_name("changed.mcap"), contents.with_items(items))


def next_to(item: Item) -> list[Item]:
    """The last number of the payload, by one unit in its last digit: far below every tolerance."""
    numbers = list(re.finditer(rb"\d+\.\d+", item.payload))
    start, end = numbers[-1].span()
    digits = numbers[-1][0]
    other = digits[:-1] + (b"1" if digits[-1:] != b"1" else b"2")
    return [item._replace(payload=item.payload[:start] + other + item.payload[end:])]


def test_a_run_with_nodes_of_a_later_version_is_what_was_sent(tmp_path: Path) -> None:
    """They say more than this version knows, and say that they are later."""
    first, second, third = version("peakmesh").split(".")
    more = {"reason": [0.5], "version": f"{first}.{second}.{int(third) + 1}"}
    sent = [
        message._replace(document=message.document | more) if message.topic.endswith("/estimate") else message
        for message in simulate(GAINS, steps=STEPS)
    ]
    verdict = replay(record(tmp_path / "run.mcap", GAINS, sent, steps=STEPS))
    assert (verdict.exit_code, verdict.evidence.checked, verdict.notes) == (0, MESSAGES, ())


def test_an_honest_run_is_what_was_sent(honest: Path) -> None:
    verdict = replay(honest)
    assert (verdict.exit_code, verdict.evidence.checked, verdict.notes) == (0, MESSAGES, ())
    assert f"({MESSAGES} messages; 0 missing, 0 double, 0 altered)" in verdict.text()
    assert verdict.document()["as_sent"] == MESSAGES


@pytest.mark.parametrize("topic", [PLANT_STATE, measurement("n1"), estimate("n0")])
def test_a_change_below_the_tolerance_is_named(honest: Path, topic: str) -> None:
    verdict = replay(changed(honest, topic, 41, next_to))
    assert verdict.first_divergence is None
    assert (verdict.exit_code, [proof.number for proof in verdict.proofs if proof.holds is False]) == (1, [4])
    (finding,) = verdict.evidence.wrong
    assert (finding.kind, finding.topic, finding.step) == ("altered", topic, 41)
    head, *_, last = verdict.text().splitlines()
    assert head.endswith("every number in it agrees, but 1 message is not what the senders say they sent")
    assert last == f"not as sent: {finding}"
    document = verdict.document()
    assert (document["altered"], document["altered_first"][0]["number"]) == (1, finding.number)


def test_a_message_put_in_and_one_taken_out_are_told(honest: Path) -> None:
    verdict = replay(changed(honest, estimate("n1"), 41, lambda item: [item, next_to(item)[0]]))
    assert [(f.kind, f.number, f.step) for f in verdict.evidence.wrong] == [("inserted", 41, 41)]
    verdict = replay(changed(honest, estimate("n1"), 41, lambda item: []))
    assert verdict.exit_code == 1
    assert (verdict.missing.total, verdict.evidence.total) == (1, 0)


def test_what_is_not_judged_is_not_accused(honest: Path) -> None:
    path = changed(honest, estimate("n0"), 41, next_to)
    for part, total in ((Part(0, 40), 0), (Part(42), 0), (Part(30, 50), 1), (Part(node="n1"), 0), (Part(node="n0"), 1)):
        assert replay(path, part=part).evidence.total == total, part


def test_a_recording_without_evidence_agrees_and_says_so(tmp_path: Path) -> None:
    path = record(tmp_path / "run.mcap", GAINS, simulate(GAINS, steps=STEPS), steps=STEPS, evidence=False)
    verdict = replay(path)
    assert verdict.exit_code == 0
    assert verdict.notes == ("no message is checked against its sender: the recording has no evidence",)
    assert "0 missing, 0 double)" in verdict.text()


def test_evidence_that_was_left_out_accuses_nobody(honest: Path) -> None:
    contents = read(honest)
    some = (item for at, item in enumerate(contents.items) if item.topic != EVIDENCE or at % 2)
    verdict = replay(write(honest.with_name("some.mcap"), contents.with_items(some)))
    assert (verdict.exit_code, verdict.evidence.total) == (0, 0)
    assert len(verdict.notes) == (verdict.evidence.checked < MESSAGES)


def test_parts_are_one_chain(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What the recorder writes in parts replays as one run; a message changed in one of them is named."""
    monkeypatch.setattr(writer, "FLUSH_SECONDS", 0.0)
    run = {"run": "test", "seed": "1", "steps": str(STEPS), "gains": GAINS.digest(), "external": ""}
    with Record(tmp_path / "run.mcap", run=run, gains=GAINS, force=False, split=Split(size=6500)) as kept:
        for sent in simulate(GAINS, steps=STEPS):
            payload = canonical(sent.document)
            stamp = Stamp(sent.number, 0, sent.who, digest_of(sent.topic, payload))
            kept.take(sent.topic, payload, stamp, sent.document["step"])
            kept.keep_up()
        kept.finish(status="finished", reason="")
    files = files_of(tmp_path / "run.mcap")
    assert len(files) > 3
    assert (replay(files).exit_code, replay(files[::-1]).evidence.checked) == (0, MESSAGES)
    assert replay(files[0]).evidence.checked == MESSAGES  # the others stand beside it
    (tmp_path / "elsewhere").mkdir()
    for at, file in enumerate(files):
        by_itself = replay(alone(file))
        assert (by_itself.exit_code, by_itself.evidence.total) == (3, 0)
        step = next(json.loads(item.payload)["step"] for item in read(file).items if item.topic == estimate("n1"))
        file.rename(tmp_path / "elsewhere" / file.name)
        mutant = changed(tmp_path / "elsewhere" / file.name, estimate("n1"), step, next_to)
        verdict = replay([*files[:at], mutant, *files[at + 1 :]])
        assert [(f.kind, f.number) for f in verdict.evidence.wrong] == [("altered", step)]
        (tmp_path / "elsewhere" / file.name).rename(file)
