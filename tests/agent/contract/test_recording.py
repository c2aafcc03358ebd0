"""A recording gives back what was written, or says that it does not; it never invents, and never fails oddly."""

from __future__ import annotations

import json
import os
import random
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from made_recordings import random_gains, random_problem, simulate
from mcap.reader import make_reader
from mcap.writer import Writer

from agent.contract.errors import InputError
from agent.contract.files import canonical
from agent.contract.gains import Gains
from agent.contract.recording import Logged
from agent.contract.recording.reader import RecordingReader
from agent.contract.recording.writer import RecordingWriter

GAINS = random_gains(random_problem(1, ny=(1,), modes=1))
MESSAGES = [
    Logged(sent.topic, canonical(sent.document), sent.number, 10**18 + time, 10**18 - time)
    for time, sent in enumerate(simulate(GAINS, steps=2))
]
RUN = {"run": "test", "gains": GAINS.digest(), "note": "ü"}
END = {"status": "finished", "steps": "3"}


class Read(NamedTuple):
    """Everything that a reader says of a file."""

    messages: list[Logged]
    run: dict[str, str]
    gains: Gains
    end: dict[str, str] | None
    damage: str
    notes: list[str]


def write(path: Path, messages: list[Logged] = MESSAGES, *, end: dict[str, str] | None = END) -> Path:
    """Write a recording; returns where it is: its .part where it has no end."""
    with RecordingWriter(path, run=RUN, gains=GAINS) as writer:
        for message in messages:
            writer.add(message)
        if end is not None:
            writer.finish(end)
    return path if end is not None else path.with_name(path.name + ".part")


def read(path: Path) -> Read:
    with RecordingReader(path) as reader:
        messages = list(reader.messages())
        return Read(messages, reader.run, reader.gains, reader.end, reader.damage, reader.notes)


def read_bytes(folder: Path, data: bytes) -> Read:
    path = folder / "changed.mcap"
    path.write_bytes(data)
    return read(path)


def refusal(path: Path) -> str:
    with pytest.raises(InputError) as caught:
        read(path)
    sentence = str(caught.value)
    assert sentence.startswith(str(path))
    assert "\n" not in sentence
    return sentence.removeprefix(str(path))


# what was written is read
def test_everything_comes_back_exactly(tmp_path: Path) -> None:
    truth = Read(MESSAGES, {"format": "peakmesh-recording", "version": "1", "part": "1", **RUN}, GAINS, END, "", [])
    assert read(write(tmp_path / "run.mcap")) == truth
    assert not (tmp_path / "run.mcap.part").exists()


def test_extreme_numbers_times_and_payloads_come_back(tmp_path: Path) -> None:
    extreme = [
        Logged("event", b"", 2**32 - 1, 2**63 - 1, 0),
        Logged("event", bytes(range(256)), 0, 0, 2**63 - 1),
        Logged("node/a-b_c/estimate", b"x" * 600_000, 7, 1, 2),
        Logged("event", b"{}", 7, 1, 2),
    ]
    assert read(write(tmp_path / "run.mcap", extreme)).messages == extreme


def test_a_run_without_messages_is_a_recording(tmp_path: Path) -> None:
    assert read(write(tmp_path / "run.mcap", []))[0::3] == ([], END)


def test_problem_gains_and_layout_are_attached(tmp_path: Path) -> None:
    """Any MCAP tool can take them out again."""
    with write(tmp_path / "run.mcap").open("rb") as file:
        attached = {record.name: record.data for record in make_reader(file).iter_attachments()}
    assert set(attached) == {"problem.json", "gains.json", "layout.json"}
    assert attached["problem.json"] == GAINS.problem.canonical()
    assert attached["gains.json"] == GAINS.canonical()
    assert set(json.loads(attached["layout.json"])) >= {"configById", "layout"}


def test_other_readers_find_every_message_by_its_index(tmp_path: Path) -> None:
    with write(tmp_path / "run.mcap").open("rb") as file:
        found = [
            Logged(channel.topic, message.data, message.sequence, message.log_time, message.publish_time)
            for schema, channel, message in make_reader(file).iter_messages()
            if schema is not None and schema.encoding == "jsonschema" and channel.message_encoding == "json"
        ]
    assert found == MESSAGES


# cut
def test_a_part_without_an_end_is_readable_and_says_so(tmp_path: Path) -> None:
    said = read(write(tmp_path / "run.mcap", end=None))
    assert said.messages == MESSAGES
    assert said.end is None
    assert said.damage == "it is cut or damaged: the file ends in the middle of a record"


def test_a_file_cut_at_any_byte_gives_a_prefix_or_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Messages that remain are the first ones; where the end can be read, all of them are there."""
    monkeypatch.setattr(Gains, "from_bytes", lambda data, source: GAINS)  # thousands of times the same
    path = tmp_path / "run.mcap"
    with RecordingWriter(path, run=RUN, gains=GAINS) as writer:
        for number, message in enumerate(MESSAGES):
            writer.add(message)
            if number % 4 == 0:
                writer._part._writer.flush()  # so that there are several chunks
        writer.finish(END)
    lengths, refused = set(), False
    for cut in reversed(range(path.stat().st_size)):
        os.truncate(path, cut)
        try:
            said = read(path)
        except InputError:
            refused = True
            continue
        assert not refused
        lengths.add(len(said.messages))
        assert said.messages == MESSAGES[: len(said.messages)]
        assert said.damage
        assert said.end is None or (said.end == END and said.messages == MESSAGES)
    assert lengths == {0, 1, 5, 9, len(MESSAGES)}


# damaged
def test_no_flipped_bit_is_silent(tmp_path: Path) -> None:
    """It is refused, or named, or lies where only an index is: then all that is read is true."""
    data = write(tmp_path / "run.mcap").read_bytes()
    truth, chance = read_bytes(tmp_path, data), random.Random(1)
    refused = named = harmless = 0
    for _ in range(800):
        changed = bytearray(data)
        changed[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
        try:
            said = read_bytes(tmp_path, bytes(changed))
        except InputError:
            refused += 1
            continue
        named += bool(said.damage)
        harmless += not said.damage
        assert set(said.messages) <= set(MESSAGES)
        assert said.damage or said[:-1] == truth[:-1]
    assert min(refused, named, harmless) > 50


@pytest.mark.parametrize("byte", [0x40, 0x80])
def test_a_length_beyond_memory_is_damage(tmp_path: Path, byte: int) -> None:
    """The last byte of an attachment's length: more than a machine can count."""
    data = bytearray(write(tmp_path / "run.mcap").read_bytes())
    start = data.index(GAINS.canonical())
    data[start - 1] ^= byte
    sentence = refusal_of(tmp_path, bytes(data))
    assert re.match(
        r" has no attachment gains\.json: \d+ bytes from byte \d+ on are no records; give the gains", sentence
    )
    GAINS.save(tmp_path / "gains.json")
    with RecordingReader(tmp_path / "changed.mcap", gains=tmp_path / "gains.json") as reader:
        assert list(reader.messages()) == MESSAGES


def refusal_of(folder: Path, data: bytes) -> str:
    path = folder / "changed.mcap"
    path.write_bytes(data)
    return refusal(path)


def test_files_joined_are_named(tmp_path: Path) -> None:
    data = write(tmp_path / "run.mcap").read_bytes()
    said = read_bytes(tmp_path, data + data)
    assert (said.messages, said.end, said.damage) == (2 * MESSAGES, END, "")
    assert said.notes == [f"another MCAP file begins at byte {len(data)}, after the end of the one before it"]
    cut = data[:-400]
    said = read_bytes(tmp_path, cut + data)
    assert said.messages == 2 * MESSAGES
    assert said.damage.endswith(f"another MCAP file begins at byte {len(cut)}, before the end of the one before it")


@pytest.mark.parametrize(("tail", "kind"), [(b"\n", "line ends"), (bytes(5000), "zeros"), (b"?", "something else")])
def test_what_stands_after_the_end_is_left_alone(tmp_path: Path, tail: bytes, kind: str) -> None:
    said = read_bytes(tmp_path, write(tmp_path / "run.mcap").read_bytes() + tail)
    assert (said.messages, said.end, said.damage) == (MESSAGES, END, "")
    size = "1 byte" if len(tail) == 1 else f"{len(tail)} bytes"
    assert said.notes == [f"after its end it goes on for {size} ({kind}), which are left alone"]


def test_a_second_run_in_a_file_is_named(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with RecordingWriter(path, run=RUN, gains=GAINS) as writer:
        writer._part._writer.add_metadata(
            "run", {"format": "peakmesh-recording", "version": "1", "run": "b", "seed": "4"}
        )
        writer.finish(END)
    assert refusal(path) == ' holds 2 runs, "test" (seed ?) and "b" (seed 4); choose one by --run NAME'


# foreign
@pytest.mark.parametrize(
    ("data", "sentence"),
    [
        (b"", " is empty; a recording was expected there"),
        (b"step,x\n0,1.0\n", " is not a recording: it is not an MCAP file"),
        (b"\x00" * 100, " is not a recording: it is not an MCAP file"),
    ],
)
def test_what_is_no_mcap_is_refused(tmp_path: Path, data: bytes, sentence: str) -> None:
    assert refusal_of(tmp_path, data) == sentence


def foreign(path: Path, fill: Callable[[Writer], Any]) -> Path:
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        fill(writer)
        writer.finish()
    return path


def test_a_foreign_mcap_is_refused(tmp_path: Path) -> None:
    def fill(writer: Writer) -> None:
        channel = writer.register_channel("imu", "json", writer.register_schema("imu", "jsonschema", b"{}"))
        writer.add_message(channel, 1, b"{}", 1)

    expected = " is an MCAP file, but not a recording of peakmesh: it has no run metadata"
    assert refusal(foreign(tmp_path / "imu.mcap", fill)) == f'{expected}; its topics are "imu"'
    assert refusal(foreign(tmp_path / "empty.mcap", lambda writer: None)) == expected


def test_another_format_is_refused(tmp_path: Path) -> None:
    path = foreign(
        tmp_path / "new.mcap",
        lambda writer: writer.add_metadata("run", {"format": "peakmesh-recording", "version": "2"}),
    )
    expected = " has recording format peakmesh-recording 2; this peakmesh reads peakmesh-recording 1"
    assert refusal(path) == expected


def test_a_recording_without_gains_is_refused(tmp_path: Path) -> None:
    path = foreign(
        tmp_path / "new.mcap",
        lambda writer: writer.add_metadata("run", {"format": "peakmesh-recording", "version": "1"}),
    )
    assert refusal(path).startswith(
        " has no gains: its attachment gains.json is missing, a filter may have left it out"
    )


def test_a_folder_and_nothing_are_refused(tmp_path: Path) -> None:
    assert refusal(tmp_path) == " could not be read as a recording: Is a directory"
    assert refusal(tmp_path / "none.mcap") == " does not exist; a recording was expected there"
