"""A recording that was cut or damaged replays as far as it goes: no traceback, and no message that was not sent."""

from __future__ import annotations

import random
from collections import Counter
from pathlib import Path

import pytest
from made_recordings import random_gains, random_problem, simulate

from agent.contract.errors import PeakmeshError
from agent.contract.files import canonical
from agent.contract.keys import data_topics, decode
from agent.contract.messages import Stamp, digest_of
from agent.contract.recording import Logged
from agent.contract.recording.reader import RecordingReader
from agent.contract.recording.writer import Split
from agent.roles.record import Record
from designer.replay import replay

GAINS = random_gains(random_problem(5, ny=(1, 2), modes=2))
STEPS = 60
DATA = data_topics(GAINS.problem)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run as the recorder writes it, in several chunks."""
    path = tmp_path_factory.mktemp("runs") / "run.mcap"
    run = {"run": "test", "seed": "1", "steps": str(STEPS), "gains": GAINS.digest(), "external": ""}
    with Record(path, run=run, gains=GAINS, force=False, split=Split()) as record:
        for number, sent in enumerate(simulate(GAINS, steps=STEPS)):
            payload = canonical(sent.document)
            stamp = Stamp(sent.number, number, sent.who, digest_of(sent.topic, payload))
            record.take(sent.topic, payload, stamp, sent.document["step"])
            if number % 50 == 49:
                record._writer._part._flush()  # type: ignore[union-attr]
        record.finish(status="finished", reason="")
    assert replay(path).exit_code == 0
    return path


def said_of(path: Path, truth: set[Logged]) -> str:
    """Says agrees, named or refused; every message that is read is one that was sent, and none is called wrong."""
    try:
        verdict = replay(path)
        with RecordingReader(path) as reader:
            messages = list(reader.messages())
            damage = reader.damage
    except PeakmeshError as error:
        sentence = str(error)
        return "refused" if sentence.startswith(str(path)) and "\n" not in sentence else sentence
    assert set(messages) <= truth
    assert verdict.first_divergence is None
    if verdict.exit_code == 0:
        assert set(messages) == truth
        return "agrees"
    assert verdict.exit_code == 3
    assert damage
    assert damage in verdict.text()
    assert verdict.complete == complete(messages, truth)
    assert not verdict.complete or f"the last complete step is {verdict.complete - 1}" in verdict.text()
    return "named"


def complete(messages: list[Logged], truth: set[Logged]) -> int:
    """Steps from the beginning of which every message was read."""
    due, there = (Counter(step_of(logged) for logged in of if logged.topic in DATA) for of in (truth, messages))
    return next((step for step in range(STEPS) if there[step] < due[step]), STEPS)


def step_of(logged: Logged) -> int:
    return decode(logged.topic, logged.payload).step


def contents(recording: Path) -> tuple[bytes, set[Logged]]:
    with RecordingReader(recording) as reader:
        return recording.read_bytes(), set(reader.messages())


def test_a_recording_cut_at_every_997th_byte(recording: Path, tmp_path: Path) -> None:
    data, truth = contents(recording)
    cut = tmp_path / "cut.mcap"
    outcomes = Counter[str]()
    for length in range(0, len(data), 997):
        cut.write_bytes(data[:length])
        outcomes[said_of(cut, truth)] += 1
    assert outcomes["agrees"] == 0
    assert min(outcomes["named"], outcomes["refused"]) > 3


def test_a_recording_with_a_flipped_bit(recording: Path, tmp_path: Path) -> None:
    """400 times. What agrees has every message: the bit was in an index."""
    data, truth = contents(recording)
    flipped, chance = tmp_path / "flipped.mcap", random.Random(1)
    outcomes = Counter[str]()
    for _ in range(400):
        changed = bytearray(data)
        changed[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
        flipped.write_bytes(changed)
        outcomes[said_of(flipped, truth)] += 1
    assert min(outcomes["named"], outcomes["refused"]) > 20
