"""The recorder without a network: it records what comes, says what it has, and stays where it cannot record."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import pytest
from disks import disk_of
from made_recordings import random_gains, random_problem, simulate
from runs import alone, decoded

from agent.contract.files import canonical
from agent.contract.keys import EVENT, EVIDENCE, estimate, measurement
from agent.contract.messages import Acknowledged, BrokenOff, Control, Stamp, digest_of
from agent.contract.recording import Logged
from agent.contract.recording import writer as writer_module
from agent.contract.recording.evidence.examiner import Findings, examine
from agent.contract.recording.parts import files_of, part_path, unfinished
from agent.contract.recording.reader import RecordingReader
from agent.contract.recording.writer import Split
from agent.guard import FORGED, REPLAY, UNASKED, Counts, Guard
from agent.network.gate import Gate
from agent.network.words import RunClosed, Sample
from agent.roles.record import Record
from agent.roles.recorder import Recorder

GAINS = random_gains(random_problem(5, ny=(1, 2), modes=2))
STEPS = 120
TOPICS = 2 + 2 * len(GAINS.problem.nodes)  # of every step


def samples(*, bare: str = "") -> list[Sample]:
    """What is on the wire of a run; messages of the topic `bare` have no stamp."""
    return [
        Sample(
            sent.topic,
            payload := canonical(sent.document),
            None if sent.topic == bare else Stamp(sent.number, 5, sent.who, digest_of(sent.topic, payload)),
        )
        for sent in simulate(GAINS, steps=STEPS)
    ]


WIRE = samples()


class Network:
    """Bus and channels in one: brings a batch of messages whenever the recorder listens, then closes the run."""

    def __init__(self, batches: Iterable[list[Sample]], external: tuple[str, ...] = ()) -> None:
        self._batches = iter(batches)
        self._waiting: list[Sample] = []
        self.said: list[Acknowledged] = []
        self.guard = Guard()
        self.guard.know(GAINS.problem)
        self.guard.begin(steps=STEPS, external=external, paced=False)

    def receive(self, *, timeout: float) -> None:
        batch = next(self._batches, None)
        if batch is None:
            raise RunClosed(Control(order="close", steps=STEPS, seed=1, window=8, external=[], reason=""))
        self._waiting += batch

    def channel(self, topic: str) -> Gate:
        return Gate(Channel(self, topic), self.guard, for_record=True)  # type: ignore[arg-type]  # as much as it uses

    def taken(self, topic: str) -> Sample | None:
        """The first that waits of a topic."""
        sample = next((sample for sample in self._waiting if sample.topic == topic), None)
        if sample is not None:
            self._waiting.remove(sample)
        return sample

    def acknowledge(self, word: Acknowledged) -> None:
        self.said.append(word.model_copy(deep=True))

    def request_replay(self, who: str, *, first: int) -> None: ...

    def replayed(self, whos: Iterable[str]) -> Iterator[Sample]:
        yield from ()

    def wait_until_gone(self, whos: Iterable[str]) -> None: ...


class Channel:
    def __init__(self, network: Network, topic: str) -> None:
        self.topic, self._network = topic, network

    def take(self) -> Sample | None:
        return self._network.taken(self.topic)


def recorded(
    path: Path,
    wire: list[Sample],
    *,
    split: Split | None = None,
    goes_on: bool = False,
    said: list[BrokenOff] | None = None,
    meanwhile: Callable[[], object] = lambda: None,
    external: tuple[str, ...] = (),
    refused: Counts | None = None,
) -> list[Acknowledged]:
    """Record a run to its end; what the recorder told everybody. `meanwhile` is done when a third of it is recorded."""

    def batches(size: int = 20) -> Iterator[list[Sample]]:
        for start in range(0, len(wire), size):
            if start // size == len(wire) // (3 * size):
                meanwhile()
            yield wire[start : start + size]

    network = Network(batches(), external)
    topics = {EVENT, *(sample.topic for sample in WIRE)}
    run = {"run": "test", "steps": str(STEPS), "seed": "1", "external": ""}
    with Record(path, run=run, gains=GAINS, force=False, split=split or Split()) as record:
        recorder = Recorder(
            network,  # type: ignore[arg-type]  # as much of a bus as the recorder uses
            {topic: network.channel(topic) for topic in topics},
            record,
            window=8,
            goes_on=goes_on,
            report=[].append if said is None else said.append,
        )
        with pytest.raises(RunClosed):
            recorder.record()
        recorder.close(status="finished", reason="")
    assert network.guard.refused() == (refused or {})
    return network.said


def content(*files: Path) -> tuple[list[Logged], dict[str, str]]:
    """All messages of some files, and the last `end` among them."""
    messages, end = list[Logged](), dict[str, str]()
    for file in files:
        with RecordingReader(alone(file)) as reader:
            messages += reader.messages()
            end = reader.end or end
    return messages, end


def judged(messages: list[Logged], end: dict[str, str], **options: Any) -> Findings:
    return examine(((m, decoded(m).step) for m in messages), **{"external": (), "end": end, **options})


def of_the_wire(messages: list[Logged]) -> list[Logged]:
    return [message for message in messages if message.topic != EVIDENCE]


def complete_steps(messages: list[Logged]) -> int:
    """The steps of which every message is there, from the first on."""
    there = Counter(decoded(message).step for message in messages if message.topic not in (EVENT, EVIDENCE))
    return next(step for step in range(STEPS + 1) if there[step] < TOPICS)


@pytest.fixture(autouse=True)
def _always(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every flush is due."""
    monkeypatch.setattr(writer_module, "FLUSH_SECONDS", 0.0)


# a run that is recorded
def test_everything_is_recorded_with_evidence_for_it(tmp_path: Path) -> None:
    said = recorded(tmp_path / "run.mcap", WIRE)
    messages, end = content(tmp_path / "run.mcap")
    kept = {(m.topic, m.number, m.payload, m.publish_time) for m in of_the_wire(messages)}
    assert kept == {(s.topic, s.stamp.number, s.payload, s.stamp.time) for s in WIRE if s.stamp is not None}
    assert judged(messages, end) == Findings(len(WIRE), 0, (), (), ())
    assert (said[-1].closed, said[-1].broken_off, said[-1].steps, said[-1].messages) == (True, None, STEPS, len(WIRE))
    assert [word.closed for word in said[:-1]] == [False] * (len(said) - 1)


def test_a_message_that_was_changed_on_its_way_is_not_recorded(tmp_path: Path) -> None:
    """By what its sender says of it; it is missing, as long as its sender does not give it again."""
    wire = list(WIRE)
    place = next(i for i, sample in enumerate(wire) if sample.topic == estimate("n1") and decoded_step(sample) == 70)
    changed = wire[place]._replace(payload=wire[place].payload.replace(b'"step":70', b'"step": 70'))
    refused = {estimate("n1"): {FORGED: 1}}
    words = recorded(tmp_path / "changed.mcap", [*wire[:place], changed, *wire[place + 1 :]], refused=refused)
    assert (words[-1].steps, words[-1].missing) == (70, 1)
    assert changed.payload not in {message.payload for message in content(tmp_path / "changed.mcap")[0]}
    words = recorded(tmp_path / "again.mcap", [*wire[:place], changed, *wire[place:]], refused=refused)
    assert (words[-1].steps, words[-1].missing) == (STEPS, 0)
    assert judged(*content(tmp_path / "again.mcap")) == Findings(len(WIRE), 0, (), (), ())


def decoded_step(sample: Sample) -> int:
    return decoded(Logged(sample.topic, sample.payload, 0, 0, 0)).step


def test_messages_of_a_sensor_without_stamps_are_recorded_without_evidence(tmp_path: Path) -> None:
    wire = samples(bare=measurement("n0"))
    recorded(tmp_path / "run.mcap", wire, external=("n0",))
    messages, end = content(tmp_path / "run.mcap")
    assert sorted(m.payload for m in of_the_wire(messages)) == sorted(sample.payload for sample in wire)
    said = judged(messages, end, external=("n0",))
    assert (said.checked, said.total) == (len(WIRE) - STEPS, 0)
    assert said.unchecked == (f'there is no evidence for {STEPS} messages of sensor "n0"',)
    assert not any("sensor-n0" in key for key in end if key.startswith("head."))


def test_nobody_gives_evidence_on_the_wire(tmp_path: Path) -> None:
    """It is the recorder's own topic."""
    forged = Sample(EVIDENCE, b'{"step":0,"who":"plant","first":0,"digests":"00000000","head":"%032d"}' % 0, None)
    network = Network([])
    with Record(tmp_path / "run.mcap", run={}, gains=GAINS, force=False, split=Split()) as record:
        recorder = Recorder(network, {}, record, window=8, goes_on=False, report=lambda _: None)  # type: ignore[arg-type]
        recorder._take_replayed(forged)
    assert network.guard.refused() == {REPLAY: {UNASKED: 1}}
    assert content(tmp_path / "run.mcap.part")[0] == []


# parts
def test_parts_hold_the_run_together(tmp_path: Path) -> None:
    """No message is lost or doubled where a part ends, each counts from the beginning of the run, and the evidence
    goes through all of them."""
    recorded(tmp_path / "run.mcap", WIRE, split=Split(size=9000))
    files = files_of(tmp_path / "run.mcap")
    assert len(files) > 4
    messages, end = content(*files)
    assert len(of_the_wire(messages)) == len(WIRE)
    assert judged(messages, end) == Findings(len(WIRE), 0, (), (), ())
    for last in range(1, len(files)):
        some, end_so_far = content(*files[:last])
        assert end_so_far["status"] == "continues"
        assert int(end_so_far["steps"]) == complete_steps(some)
        received = sum(int(count) for key, count in end_so_far.items() if key.startswith("received."))
        assert received == len(of_the_wire(some))
        assert judged(some, end_so_far) == Findings(len(of_the_wire(some)), 0, (), (), ())
        alone, end_alone = content(files[last])
        assert judged(alone, end_alone) == Findings(len(of_the_wire(alone)), 0, (), (), ())


# a disk that is full
@pytest.mark.parametrize("goes_on", [False, True])
@pytest.mark.parametrize("size", [0, 5000, 20_000, 31_234])
def test_where_the_disk_is_full_everybody_is_told_once_and_nobody_has_to_keep_anything(
    tmp_path: Path, size: int, goes_on: bool
) -> None:
    """What is said to be there is there: the steps that are complete, and every message."""
    reported: list[BrokenOff] = []
    with disk_of(size):
        said = recorded(tmp_path / "run.mcap", WIRE, goes_on=goes_on, said=reported)
    (off,) = reported
    assert off.reason == f"{tmp_path / 'run.mcap'} could not be written: File too large"
    assert off.stop != goes_on
    assert str(off).endswith(f"File too large; there is no recording from step {off.steps} on")
    told = [word for word in said if word.broken_off is not None]
    assert said.index(told[0]) == len(said) - len(told)  # from then on in every word
    assert all(word.broken_off == off for word in told)
    assert told[0].received != told[-1].received  # what came afterwards is acknowledged too
    assert (told[-1].steps, told[-1].closed) == (STEPS, True)
    assert sum(told[-1].received.values()) == len(WIRE)
    messages = content(*files_of(tmp_path / "run.mcap"))[0] if size >= 20_000 else []
    assert {word.messages for word in told} == {len(of_the_wire(messages))}
    assert off.steps == complete_steps(messages)
    assert bool(messages) == (size >= 20_000)
    if messages:
        assert judged(messages, {}).total == 0


def test_a_disk_that_is_full_at_the_very_end_is_told_too(tmp_path: Path) -> None:
    """All steps are held, but the file has no end, and no name."""
    recorded(tmp_path / "whole.mcap", WIRE)
    size = (tmp_path / "whole.mcap").stat().st_size - 100
    reported: list[BrokenOff] = []
    with disk_of(size):
        said = recorded(tmp_path / "run.mcap", WIRE, said=reported)
    (off,) = reported
    assert off.steps == STEPS
    assert (said[-1].closed, said[-1].broken_off) == (True, off)
    (part,) = files_of(tmp_path / "run.mcap")
    assert part.name == "run.mcap.part"
    assert len(of_the_wire(content(part)[0])) == len(WIRE) == said[-1].messages


def test_where_a_part_cannot_be_begun_those_before_it_count(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    taken: list[Path] = []

    def take_a_name() -> None:
        taken.append(part_path(path, len(files_of(path)) + 1))
        unfinished(taken[0]).touch()

    reported: list[BrokenOff] = []
    said = recorded(path, WIRE, split=Split(size=9000), said=reported, meanwhile=take_a_name)
    (off,) = reported
    assert off.reason == f"{taken[0]} could not be written: File exists"
    *whole, last = files_of(path)
    assert (last, last.stat().st_size) == (unfinished(taken[0]), 0)
    messages, end = content(*whole)
    assert (off.steps, said[-1].messages) == (complete_steps(messages), len(of_the_wire(messages)))
    assert end["status"] == "continues"


@pytest.mark.parametrize("name", ["file", "folder"])
def test_what_was_taken_away_is_not_said_to_be_recorded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """A file alone: the parts before it are there. The folder: nothing is."""
    monkeypatch.setattr(writer_module, "SYNC_SECONDS", 0.0)
    path = tmp_path / "new" / "run.mcap"
    path.parent.mkdir()
    take_away = {"file": lambda: files_of(path)[-1].unlink(), "folder": lambda: shutil.rmtree(path.parent)}
    reported: list[BrokenOff] = []
    said = recorded(path, WIRE, split=Split(size=9000), said=reported, meanwhile=take_away[name])
    (off,) = reported
    assert off.reason.endswith("its folder was removed" if name == "folder" else ".mcap.part was removed")
    messages, _ = content(*files_of(path))
    assert (off.steps, said[-1].messages) == (complete_steps(messages), len(of_the_wire(messages)))
    assert bool(messages) == (name == "file")
