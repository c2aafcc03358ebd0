"""`replay`, `show` and `recover` of what tools made of the golden recording: outcome, exit code, and a sentence."""

from __future__ import annotations

import json
import random
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import rewriting
from made_recordings import random_gains, random_problem, record, simulate
from places import ROOT
from rewriting import Contents, Style, read, rewritten, write
from runs import PATIENCE

from designer.cli import main

GOLDEN = ROOT / "recordings" / "golden" / "zhu2020-lossy.mcap"
GAINS = GOLDEN.with_suffix(".gains.json")


class Answer:
    """What a command said."""

    def __init__(self, code: int, out: str, err: str) -> None:
        self.code, self.out, self.err = code, out, err
        assert "Traceback" not in err

    @property
    def facts(self) -> dict[str, Any]:
        return dict(json.loads(self.out))


Call = Callable[..., Answer]


@pytest.fixture
def call(capsys: pytest.CaptureFixture[str]) -> Call:
    def peakmesh(*arguments: object) -> Answer:
        code = main([str(argument) for argument in arguments])
        return Answer(code, *capsys.readouterr())

    return peakmesh


@pytest.fixture(scope="module")
def golden() -> Contents:
    return read(GOLDEN)


def many(contents: Contents) -> int:
    """How many messages of the run; evidence is the recorder's."""
    return sum(item.topic != "evidence" for item in contents.items)


# what a file holds, in whatever order
ORDERS = [
    ("run", "end", "items", "attachments"),  # sort, filter, compress, merge of one tool
    ("attachments", "run", "end", "items"),  # sort of another
    ("run", "end", "attachments", "items"),
    ("items", "run", "end", "attachments"),  # filter and compress of older ones
]


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("chunk_size", [4096, None])
def test_records_may_stand_in_any_order_and_outside_chunks(
    tmp_path: Path, call: Call, golden: Contents, order: tuple[str, ...], chunk_size: int | None
) -> None:
    path = write(tmp_path / "run.mcap", golden, Style(order=order, chunk_size=chunk_size, data_crcs=False))
    answer = call("replay", path, "--json")
    assert (answer.code, answer.facts["outcome"], answer.facts["messages"]) == (0, "agrees", many(golden))
    assert all(proof["holds"] for proof in answer.facts["proofs"])
    assert ("no checksum covers the messages" in str(answer.facts["notes"])) == (chunk_size is None)
    shown = call("show", path, "--json")
    assert (shown.code, sum(shown.facts["messages"].values()), shown.facts["status"]) == (0, many(golden), "finished")


def test_others_in_the_file_are_named_and_left_alone(tmp_path: Path, call: Call, golden: Contents) -> None:
    path = write(tmp_path / "run.mcap", rewriting.with_strangers(golden, random.Random(1)))
    answer = call("replay", path)
    assert answer.code == 0
    assert "note: 10 messages on 2 topics are not of this run, and are left alone: /camera/mode, /imu" in answer.out
    named = "metadata and attachments of others are left alone: run, rosbag2, photo.jpg, gains.json"
    assert named in answer.out
    shown = call("show", path, "--json")
    assert set(shown.facts["others"]) == {"/camera/mode", "/imu", "run", "rosbag2", "photo.jpg", "gains.json"}


def test_a_file_of_somebody_else_is_refused_with_its_topics(tmp_path: Path, call: Call, golden: Contents) -> None:
    strangers = [item for item in rewriting.with_strangers(golden, random.Random(1)).items if item.encoding == "cdr"]
    for metadata in ((), (("run", {"experiment": "17"}),)):
        path = write(tmp_path / "imu.mcap", Contents(metadata, (), tuple(strangers)))
        for command in (["replay"], ["show"], ["recover", "-o", tmp_path / "new.mcap"]):
            answer = call(*command, path)
            assert (answer.code, answer.out) == (2, "")
            assert "not a recording of peakmesh: it" in answer.err
            assert 'its topics are "/camera/mode" and "/imu"' in answer.err
            assert "None" not in answer.err
    bare = write(tmp_path / "bare.mcap", rewriting.replace(golden, metadata=()))
    answer = call("replay", bare)
    assert answer.code == 2
    assert (
        "they look like those of a run, so a tool may have left the metadata out; copy it with metadata" in answer.err
    )


def test_gains_that_were_left_out_can_be_given(tmp_path: Path, call: Call, golden: Contents) -> None:
    path = write(tmp_path / "run.mcap", rewriting.replace(golden, attachments=()))
    answer = call("replay", path)
    assert answer.code == 2
    digest = json.loads(call("show", GAINS, "--json").out)["digest"]
    assert "its attachment gains.json is missing, a filter may have left it out; give the gains" in answer.err
    assert f"with --gains FILE (digest {digest[:12]}...)" in answer.err
    assert call("replay", path, "--gains", GAINS).code == 0
    assert call("recover", path, "-o", tmp_path / "new.mcap", "--gains", GAINS).code == 0
    assert call("replay", tmp_path / "new.mcap").code == 0
    other = tmp_path / "other.gains.json"
    random_gains(random_problem(1)).save(other)
    answer = call("replay", path, "--gains", other)
    assert answer.code == 2
    assert f"but the run was made with {digest[:12]}...; give its own" in answer.err
    shown = call("show", path, "--json")
    assert (shown.code, shown.facts["gains"]) == (0, digest)
    assert "holds" not in shown.facts
    assert "gains.json is missing" in shown.facts["notes"][0]


# parts
def test_a_file_that_was_cut_before_its_first_message_says_nothing(tmp_path: Path, call: Call) -> None:
    data = GOLDEN.read_bytes()
    path = tmp_path / "run.mcap.part"
    path.write_bytes(data[: data.index(b"layout.json") + 100])
    answer = call("replay", path)
    assert (answer.code, answer.err) == (3, "")
    assert answer.out.splitlines()[0] == f"{path}: nothing can be said: it holds nothing to compare"
    assert call("recover", path, "-o", tmp_path / "new.mcap").code == 0
    assert call("replay", tmp_path / "new.mcap").code == 3


def test_a_part_of_a_run_is_judged_for_what_is_there(tmp_path: Path, call: Call, golden: Contents) -> None:
    items = sorted(golden.items, key=lambda item: item.log_time)[: many(golden) * 85 // 100]
    part = golden.with_items(items)
    answer = call("replay", write(tmp_path / "a.mcap", part))
    assert answer.code == 3
    assert "agrees for what is there, but is not whole" in answer.out
    assert f"left out of this file: {many(golden) - many(part)} messages (1 event; the end of " in answer.out
    assert " topics from step " in answer.out
    path = write(tmp_path / "b.mcap", rewriting.without_events(golden, random.Random(1)))
    answer = call("replay", path)
    assert answer.code == 3
    assert "left out of this file: 2 messages (topic event)" in answer.out


def test_two_runs_in_one_file_are_named_and_one_can_be_chosen(tmp_path: Path, call: Call, golden: Contents) -> None:
    run = dict(golden.metadata)["run"]
    later = 3600 * 10**9
    other = rewriting.replace(
        golden.with_items(item._replace(log_time=item.log_time + later) for item in golden.items),
        metadata=(
            ("run", run | {"run": "second", "started": "2099-01-01T00:00:00+00:00"}),
            ("end", {"status": "finished", "steps": "60"}),
        ),
    )
    path = write(tmp_path / "both.mcap", rewriting.merged([golden, other], random.Random(1)))
    for command in ("replay", "show"):
        answer = call(command, path)
        assert (answer.code, answer.out) == (2, "")
        assert f'holds 2 runs, "{run["run"]}" (seed 2020, started 20' in answer.err
        assert 'and "second" (seed 2020, started 2099-01-01T00:00:00+00:00); choose one by --run NAME' in answer.err
    answer = call("replay", path, "--run", "second")
    assert "nothing can be said" in answer.out, "its messages are older than it"
    assert call("replay", path, "--run", "third").code == 2


def test_several_logs_make_a_table(tmp_path: Path, call: Call, golden: Contents) -> None:
    moved = rewriting.moved(golden, node="1", step=20)
    wrong = write(tmp_path / "wrong.mcap", moved)
    parts = [write(tmp_path / f"part{at}.mcap", part) for at, part in enumerate(rewriting.split_by_time(golden, 2))]
    answer = call("replay", *parts)
    assert answer.code == 0, "parts of one run are one run"
    assert "five proofs" not in answer.out
    gains = random_gains(random_problem(1))
    good = record(tmp_path / "good.mcap", gains, simulate(gains, steps=9), steps=9)
    note = tmp_path / "note.txt"
    note.write_text("hello")
    answer = call("replay", *parts, good, note)
    assert answer.code == 2
    heads, *lines = answer.out.splitlines()
    assert heads.split() == [
        "recording",
        "outcome",
        "run",
        "seed",
        "steps",
        "messages",
        "largest",
        "gap",
        "of",
        "tolerance",
    ]
    assert [line.split("  ")[0] for line in lines] == [f"{parts[0]} and 1 more", str(good), str(note)]
    assert "not an MCAP file" in lines[2]
    answer = call("replay", good, wrong, "--json")
    assert answer.code == 1, "one of them diverges"
    assert [entry["outcome"] for entry in answer.facts["recordings"]] == ["agrees", "diverges"]


# what is judged
def test_steps_and_nodes_can_be_judged_alone(tmp_path: Path, call: Call, golden: Contents) -> None:
    path = write(tmp_path / "wrong.mcap", rewriting.moved(golden, node="2", step=30))
    everything = call("replay", path, "--json")
    assert everything.code == 1
    first = everything.facts["first_divergence"]
    assert (first["step"], first["node"], first["field"]) == (30, "2", "x_hat[0]")
    assert first["ulps"] > 1000
    assert sum(everything.facts["later_divergences"].values()) > 0
    text = call("replay", path).out
    assert 'first divergence, step 30: x_hat[0] of node "2" is ' in text
    assert "units in the last place apart" in text
    assert "\nthen " in text
    for options, code in (
        (["--to", 29], 0),
        (["--from", 32], 0),
        (["--from", 30, "--to", 30], 1),
        (["--node", "2"], 1),
        (["--node", "4", "--to", 29], 0),
        (["--node", "2", "--to", 20], 0),
    ):
        answer = call("replay", path, *options)
        assert answer.code == code, (options, answer.out)
        assert "judged: steps " in answer.out
    assert call("replay", path, "--from", 9, "--to", 3).code == 2
    assert 'node "7" does not exist' in call("replay", path, "--node", 7).err


# from a pipe
@pytest.mark.parametrize("order", [ORDERS[0], ORDERS[3]])
def test_a_pipe_is_read_once(tmp_path: Path, golden: Contents, order: tuple[str, ...]) -> None:
    path = write(tmp_path / "run.mcap", golden, Style(order=order))
    for command, words in (("show", "finished"), ("replay", "/dev/stdin: agrees")):
        done = subprocess.run(
            f"cat {path} | {sys.executable} -m designer {command} /dev/stdin",
            shell=True, capture_output=True, text=True, timeout=PATIENCE, check=False, cwd=ROOT,
        )  # fmt: skip
        assert (done.returncode, done.stderr) == (0, "")
        assert words in done.stdout


# what cannot be read
def test_what_cannot_be_read_gets_one_sentence(tmp_path: Path, call: Call, golden: Contents) -> None:
    whole = write(tmp_path / "run.mcap", golden).read_bytes()
    for name, data, words in (
        ("empty.mcap", b"", "is empty"),
        ("text.mcap", b"step,x\n", "is not an MCAP file"),
        ("next.mcap", whole[:5] + b"1" + whole[6:], "is an MCAP file of version 1; this peakmesh reads version 0"),
    ):
        path = tmp_path / name
        path.write_bytes(data)
        for command in (["replay"], ["recover", "-o", tmp_path / "new.mcap"]):
            answer = call(*command, path)
            assert (answer.code, answer.out) == (2, "")
            assert words in answer.err
            assert answer.err.count("\n") == 1
    assert call("replay", tmp_path).code == 2
    assert call("replay", tmp_path / "none.mcap").code == 2
    assert sorted(path.name for path in tmp_path.iterdir() if "new" in path.name) == [], "nothing half-written"


def test_recover_replaces_nothing_unasked(tmp_path: Path, call: Call, golden: Contents) -> None:
    path = write(tmp_path / "run.mcap", golden)
    (tmp_path / "new.mcap").write_text("mine")
    answer = call("recover", path, "-o", tmp_path / "new.mcap")
    assert answer.code == 2
    assert "exists already" in answer.err
    assert (tmp_path / "new.mcap").read_text() == "mine"
    answer = call("recover", path, "-o", tmp_path / "new.mcap", "--force", "--json")
    assert (answer.code, answer.facts["messages"], answer.facts["steps"]) == (0, many(golden), 60)
    assert rewritten(read(tmp_path / "new.mcap"), [rewriting.by_topic], random.Random(1)).items == (
        rewritten(golden, [rewriting.by_topic], random.Random(1)).items
    )
