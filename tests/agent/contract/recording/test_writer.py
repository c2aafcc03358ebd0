"""What is written stays: split, killed, cut, on a full disk; and what could not be written is said."""

from __future__ import annotations

import os
import random
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from disks import disk_of
from made_recordings import random_gains, random_problem, record, simulate
from places import ROOT
from runs import alone

from agent.contract.errors import InputError, RecordingFailed, RunBroken
from agent.contract.files import canonical
from agent.contract.recording import Logged
from agent.contract.recording import writer as recording
from agent.contract.recording.parts import files_of, part_path, refuse_recording, unfinished
from agent.contract.recording.reader import RecordingReader
from agent.contract.recording.writer import FLUSH_SECONDS, RecordingWriter, Split

GAINS = random_gains(random_problem(1, ny=(1,), modes=1))
MESSAGES = [
    Logged(sent.topic, canonical(sent.document), sent.number, 10**18 + time, 10**18 - time)
    for time, sent in enumerate(simulate(GAINS, steps=2))
]
RUN = {"run": "test", "gains": GAINS.digest(), "note": "ü"}
END = {"status": "finished", "steps": "3"}


def messages_of(path: Path) -> list[Logged]:
    """What is in this file."""
    with RecordingReader(alone(path)) as reader:
        return list(reader.messages())


def end_of(path: Path) -> dict[str, str] | None:
    with RecordingReader(alone(path)) as reader:
        list(reader.messages())
        assert reader.damage == ""
        return reader.end


def write(path: Path, messages: list[Logged] = MESSAGES, *, end: dict[str, str] | None = END) -> Path:
    """Write a recording; returns where it is: its .part where it has no end."""
    with RecordingWriter(path, run=RUN, gains=GAINS) as writer:
        for message in messages:
            writer.add(message)
        if end is not None:
            writer.finish(end)
    return path if end is not None else unfinished(path)


# what may be written
BAD: dict[str, dict[str, Any]] = {
    "number too large": {"number": 2**32},
    "negative number": {"number": -1},
    "broken number": {"number": 1.5},
    "negative time": {"log_time": -1},
    "broken time": {"log_time": 1.0},
    "time too large": {"log_time": 2**63},
    "negative publish time": {"publish_time": -1},
    "no publish time": {"publish_time": None},
    "text": {"payload": "{}"},
    "object": {"payload": {"step": 0}},
    "unknown topic": {"topic": "weather"},
}


@pytest.mark.parametrize("fault", BAD.values(), ids=BAD.keys())
def test_a_bad_message_is_refused_before_it_is_written(tmp_path: Path, fault: dict[str, Any]) -> None:
    """And the file stays whole: everything else is in it."""
    path = tmp_path / "run.mcap"
    with RecordingWriter(path, run=RUN, gains=GAINS) as writer:
        writer.add(MESSAGES[0])
        with pytest.raises(
            RunBroken, match=r"^run\.mcap: (a message on .* cannot be recorded|there is no topic weather)"
        ):
            writer.add(MESSAGES[1]._replace(**fault))
        writer.add(MESSAGES[1])
        writer.finish(END)
    assert messages_of(path) == MESSAGES[:2]
    assert end_of(path) == END


def test_a_recording_is_not_overwritten_without_force(tmp_path: Path) -> None:
    path = write(tmp_path / "run.mcap")
    before = path.read_bytes()
    with pytest.raises(InputError, match=r"run\.mcap exists already"):
        RecordingWriter(path, run=RUN, gains=GAINS)
    assert path.read_bytes() == before
    with RecordingWriter(path, run=RUN, gains=GAINS, force=True) as writer:
        assert path.read_bytes() == before  # the old one is there until the new one has its end
        writer.finish(END)
    assert messages_of(path) == []


def test_what_is_left_of_a_killed_run_is_not_overwritten_without_force(tmp_path: Path) -> None:
    part = write(tmp_path / "run.mcap", end=None)
    with pytest.raises(InputError, match=r"run\.mcap\.part exists already"):
        RecordingWriter(tmp_path / "run.mcap", run=RUN, gains=GAINS)
    assert messages_of(part) == MESSAGES


def test_a_folder_that_does_not_exist_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"the folder .*/new does not exist; create it first$"):
        RecordingWriter(tmp_path / "new" / "run.mcap", run=RUN, gains=GAINS)


def test_a_file_that_cannot_be_written_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "open", refuse)
    with pytest.raises(RecordingFailed, match=r"run\.mcap could not be written: Permission denied$"):
        RecordingWriter(tmp_path / "run.mcap", run=RUN, gains=GAINS)


def test_a_failing_disk_breaks_the_run_and_leaves_what_it_took(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(_: int) -> None:
        raise OSError(5, "Input/output error")

    with RecordingWriter(tmp_path / "run.mcap", run=RUN, gains=GAINS) as writer:
        writer.add(MESSAGES[0])
        monkeypatch.setattr(recording.os, "fsync", fail)
        with pytest.raises(RunBroken, match=r"run\.mcap could not be written: Input/output error$"):
            writer.finish(END)
    assert not (tmp_path / "run.mcap").exists()
    assert messages_of(tmp_path / "run.mcap.part") == MESSAGES[:1]


def test_others_can_read_what_is_older_than_the_promise(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Within FLUSH_SECONDS a message may be in memory only; then the file has it, while it is still written to."""
    now = 100.0
    monkeypatch.setattr(recording.time, "monotonic", lambda: now)
    part = tmp_path / "run.mcap.part"
    with RecordingWriter(tmp_path / "run.mcap", run=RUN, gains=GAINS) as writer:
        assert messages_of(part) == []
        writer.add(MESSAGES[0])
        now += 0.4 * FLUSH_SECONDS
        writer.flush_when_due()
        assert messages_of(part) == []
        now += 0.6 * FLUSH_SECONDS + 1e-6
        writer.flush_when_due()
        assert messages_of(part) == MESSAGES[:1]
        writer.add(MESSAGES[1])
        now += 10.0 * FLUSH_SECONDS
        writer.flush_when_due()
        assert messages_of(part) == MESSAGES[:2]
        writer.finish(END)
    assert messages_of(tmp_path / "run.mcap") == MESSAGES[:2]


def test_the_disk_is_synced_as_often_as_promised(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now, synced = 100.0, []
    monkeypatch.setattr(recording.time, "monotonic", lambda: now)
    with RecordingWriter(tmp_path / "run.mcap", run=RUN, gains=GAINS) as writer:
        monkeypatch.setattr(recording.os, "fsync", lambda _: synced.append(now))
        for tick in range(1, 31):
            now = 100.0 + 0.1 * tick
            writer.flush_when_due()
    gaps = [later - earlier for earlier, later in zip([100.0, *synced], synced, strict=False)]
    assert len(synced) >= 2
    assert max(gaps) <= recording.SYNC_SECONDS + FLUSH_SECONDS + 0.1


def test_a_closed_recording_can_be_closed_again(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "run.mcap", run=RUN, gains=GAINS) as writer:
        writer.finish(END)
        writer.close()
    assert end_of(tmp_path / "run.mcap") == END


def test_helpers_of_other_tests_write_whole_recordings(tmp_path: Path) -> None:
    path = record(tmp_path / "run.mcap", GAINS, simulate(GAINS, steps=2), steps=2, evidence=False)
    assert [message.payload for message in messages_of(path)] == [message.payload for message in MESSAGES]


# parts
def split_recording(path: Path, split: Split, *, repeat: int = 40, force: bool = False) -> int:
    """The messages over and over, flushed each time, in parts; how many parts."""
    parts = 1
    with RecordingWriter(path, run=RUN, gains=GAINS, split=split, force=force) as writer:
        for _ in range(repeat):
            for message in MESSAGES:
                writer.add(message)
            writer.flush_when_due()
            if writer.part_is_full:
                writer.next_part({"steps": str(parts)})
                parts += 1
        writer.finish(END)
    return parts


@pytest.fixture
def always(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every flush is due."""
    monkeypatch.setattr(recording, "FLUSH_SECONDS", 0.0)


@pytest.mark.usefixtures("always")
def test_a_long_recording_is_split_and_loses_nothing(tmp_path: Path) -> None:
    parts = split_recording(tmp_path / "run.mcap", Split(size=4000))
    files = files_of(tmp_path / "run.mcap")
    assert parts > 3
    assert files == [part_path(tmp_path / "run.mcap", number) for number in range(1, parts + 1)]
    assert sorted(tmp_path.iterdir()) == sorted(files)
    assert [message for file in files for message in messages_of(file)] == MESSAGES * 40


@pytest.mark.usefixtures("always")
def test_every_part_is_a_whole_recording_and_says_which_it_is(tmp_path: Path) -> None:
    """The facts of the run are the same in all, but for the number; each but the last says what it is continued by."""
    parts = split_recording(tmp_path / "run.mcap", Split(size=4000))
    for number, file in enumerate(files_of(tmp_path / "run.mcap"), start=1):
        with RecordingReader(alone(file)) as reader:
            assert reader.gains == GAINS
            assert reader.run["part"] == str(number)
            assert {key: value for key, value in reader.run.items() if key in RUN} == RUN
        following = {"status": "continues", "reason": "", "steps": str(number), "next": f"run.part{number + 1}.mcap"}
        assert end_of(file) == (END if number == parts else following)


@pytest.mark.usefixtures("always")
def test_parts_are_about_as_long_as_asked(tmp_path: Path) -> None:
    split_recording(tmp_path / "run.mcap", Split(size=20_000))
    whole = (write(tmp_path / "one.mcap", [])).stat().st_size
    *full, last = (file.stat().st_size for file in files_of(tmp_path / "run.mcap"))
    assert full
    assert all(20_000 <= size - whole < 31_000 for size in full)  # schemas and an index come on top
    assert last - whole < 30_000


@pytest.mark.usefixtures("always")
def test_parts_end_when_it_is_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now = 100.0
    monkeypatch.setattr(recording.time, "monotonic", lambda: now)
    with RecordingWriter(tmp_path / "run.mcap", run=RUN, gains=GAINS, split=Split(seconds=60.0)) as writer:
        now += 61.0
        assert not writer.part_is_full  # nothing is in it
        writer.add(MESSAGES[0])
        assert writer.part_is_full
        writer.next_part({})
        writer.add(MESSAGES[1])
        now += 59.0
        assert not writer.part_is_full
        writer.finish(END)
    assert [messages_of(file) for file in files_of(tmp_path / "run.mcap")] == [MESSAGES[:1], MESSAGES[1:2]]


def test_parts_that_end_in_the_same_step_are_read_one_after_the_other(tmp_path: Path) -> None:
    """As they are where recorders are killed soon after each other; the tenth comes after the ninth."""
    path = tmp_path / "run.mcap"
    with RecordingWriter(path, run=RUN, gains=GAINS) as writer:
        for _ in range(11):
            writer.add(MESSAGES[0])
            writer.next_part({"steps": "1"})
        writer.add(MESSAGES[0])
        writer.finish(END)
    with RecordingReader(path) as reader:
        assert len(list(reader.messages())) == 12
        assert reader.end == END


def test_a_recording_that_is_not_split_is_part_1(tmp_path: Path) -> None:
    with RecordingReader(write(tmp_path / "run.mcap")) as reader:
        assert reader.run["part"] == "1"


@pytest.mark.usefixtures("always")
def test_parts_of_an_older_recording_are_not_mixed_with_a_new_one(tmp_path: Path) -> None:
    """Without --force nothing is begun; with it the old ones are there until the new one has its first part."""
    path = tmp_path / "run.mcap"
    assert split_recording(path, Split(size=2000)) > 4
    (tmp_path / "run.part99.mcap.part").touch()
    (tmp_path / "runs.part3.mcap").touch()
    path.unlink()
    with pytest.raises(InputError, match=r"run\.part\d+\.mcap(\.part)? exists already"):
        refuse_recording(path, force=False)
    before = sorted(tmp_path.iterdir())
    with RecordingWriter(path, run=RUN, gains=GAINS, force=True) as writer:
        assert sorted(tmp_path.iterdir()) == sorted([*before, unfinished(path)])
        writer.finish(END)
    assert sorted(tmp_path.iterdir()) == [path, tmp_path / "runs.part3.mcap"]


# where writing fails
def fill(path: Path, *, size: int, every: int, split: Split | None = None) -> tuple[int, str]:
    """Write until the disk is full; how many messages the writer says to hold, and what it says."""
    random_payloads = random.Random(size)
    held = added = 0
    with disk_of(size), RecordingWriter(path, run=RUN, gains=GAINS, split=split) as writer:
        try:
            while added < 5000:
                added += 1
                writer.add(Logged("event", random_payloads.randbytes(300), added - 1, added, added))
                if added % every == 0:
                    writer.flush_when_due()
                held = added if writer.is_flushed else held
        except RecordingFailed as error:
            return (added if writer.is_flushed else held), str(error)
    raise AssertionError("the disk was never full")


@pytest.mark.usefixtures("always")
def test_on_a_full_disk_everything_that_was_held_is_readable_and_nothing_else(tmp_path: Path) -> None:
    empty = write(tmp_path / "empty.mcap", [], end=None).stat().st_size
    held_before = -1
    for extra in [*range(0, 3000, 487), 4096, 20_000, 40_003]:
        path = tmp_path / f"run-{extra}.mcap"
        held, said = fill(path, size=empty + 400 + extra, every=7)
        assert said == f"{path} could not be written: File too large"
        assert not path.exists()
        assert [message.number for message in messages_of(unfinished(path))] == list(range(held))
        assert held >= held_before
        held_before = held
    assert held_before > 80


@pytest.mark.usefixtures("always")
def test_a_disk_that_is_full_before_the_first_message_is_named(tmp_path: Path) -> None:
    for size in (0, 10, 2000):
        path = tmp_path / f"run-{size}.mcap"
        with disk_of(size), pytest.raises(RecordingFailed, match=r"could not be written: File too large$"):
            RecordingWriter(path, run=RUN, gains=GAINS)


@pytest.mark.usefixtures("always")
def test_a_part_that_cannot_be_finished_leaves_those_before_it_whole(tmp_path: Path) -> None:
    """Each has the same limit here: the second part's is a byte too short."""
    path = tmp_path / "run.mcap"
    with RecordingWriter(path, run=RUN, gains=GAINS) as writer:
        writer.add(MESSAGES[0])
        writer.next_part({})
        writer.add(MESSAGES[1])
        writer.flush_when_due()
        size = unfinished(part_path(path, 2)).stat().st_size
        with disk_of(size + 1), pytest.raises(RecordingFailed, match=r"run\.part2\.mcap could not be written"):
            writer.finish(END)
        assert writer.is_flushed
    assert files_of(path) == [path, unfinished(part_path(path, 2))]
    assert [messages_of(file) for file in files_of(path)] == [MESSAGES[:1], MESSAGES[1:2]]


def test_a_removed_folder_is_noticed_within_a_second(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now = 100.0
    monkeypatch.setattr(recording.time, "monotonic", lambda: now)
    folder = tmp_path / "new"
    folder.mkdir()
    with RecordingWriter(folder / "run.mcap", run=RUN, gains=GAINS) as writer:
        writer.add(MESSAGES[0])
        shutil.rmtree(folder)
        now += recording.SYNC_SECONDS
        with pytest.raises(RecordingFailed, match=r"run\.mcap could not be written: its folder was removed$") as caught:
            writer.flush_when_due()
    assert caught.value.gone


@pytest.mark.parametrize("replaced", [False, True])
def test_a_file_that_was_taken_away_is_not_called_a_recording(tmp_path: Path, replaced: bool) -> None:
    part = tmp_path / "run.mcap.part"
    with RecordingWriter(tmp_path / "run.mcap", run=RUN, gains=GAINS) as writer:
        part.unlink()
        if replaced:
            part.write_text("mine")
        why = "another file was put in the place of" if replaced else ""
        with pytest.raises(RecordingFailed, match=rf"could not be written: {why}.*run\.mcap\.part") as caught:
            writer.finish(END)
    assert caught.value.gone
    assert [(file.name, file.read_text()) for file in tmp_path.iterdir()] == [("run.mcap.part", "mine")] * replaced


def test_a_file_that_took_the_name_meanwhile_is_not_replaced(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with RecordingWriter(path, run=RUN, gains=GAINS) as writer:
        writer.add(MESSAGES[0])
        path.write_text("mine")
        with pytest.raises(
            RecordingFailed, match=r"something else has this name by now; see run\.mcap\.part$"
        ) as caught:
            writer.finish(END)
        assert writer.is_flushed
    assert not caught.value.gone
    assert path.read_text() == "mine"
    assert (messages_of(unfinished(path)), end_of(unfinished(path))) == (MESSAGES[:1], END)


def test_what_is_no_regular_file_is_never_replaced(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    for path in (pipe, Path("/dev/null")):
        with pytest.raises(InputError, match="is not a regular file and will not be replaced"):
            RecordingWriter(path, run=RUN, gains=GAINS, force=True)


@pytest.mark.parametrize("there", [True, False])
def test_a_link_is_never_replaced(tmp_path: Path, there: bool) -> None:
    """Nor what it leads to, be it there or not."""
    link, target = tmp_path / "run.mcap", tmp_path / "other.mcap"
    link.symlink_to(target)
    if there:
        target.write_text("mine")
    for force in (False, True):
        with pytest.raises(InputError, match=r"run\.mcap is a symbolic link and will not be replaced"):
            RecordingWriter(link, run=RUN, gains=GAINS, force=force)
    assert link.is_symlink()
    assert target.exists() == there


def test_a_folder_that_may_not_be_written_to_is_named_before_anything_starts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(**_: Any) -> None:
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr("agent.contract.recording.parts.tempfile.TemporaryFile", refuse)
    with pytest.raises(InputError, match=r"run\.mcap could not be written: Read-only file system$"):
        refuse_recording(tmp_path / "run.mcap", force=False)


# killed
def test_a_writer_killed_at_any_moment_leaves_all_that_was_flushed(tmp_path: Path) -> None:
    """Kill -9 of 40 writers, also while a part ends and the next begins: what is there is the first messages.

    Every part with its name is whole; the last may be cut, or not have begun. Nothing that was flushed is lost.
    """
    command = [sys.executable, ROOT / "tests" / "support" / "killed_writers.py", tmp_path, "40"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True, env=_with_path())
    flushed = [int(line) for line in done.stdout.split()]
    assert len(flushed) == 40
    unfinished_parts = 0
    for number, least in enumerate(flushed):
        path = tmp_path / f"run-{number}.mcap"
        found: list[int] = []
        for file in files_of(path):
            whole = file.suffix == ".mcap"
            unfinished_parts += not whole
            try:
                with RecordingReader(alone(file)) as reader:
                    found += [message.number for message in reader.messages()]
                    assert (reader.end is not None and reader.damage == "") or not whole
            except InputError:  # its head is not there yet
                assert not whole
        assert found == list(range(len(found)))
        assert len(found) >= least
    assert unfinished_parts > 20
    assert len(list(tmp_path.iterdir())) > 60  # there were parts


def _with_path() -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests" / "support")])}
