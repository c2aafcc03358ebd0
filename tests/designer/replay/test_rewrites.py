"""A recording survives what tools do to it: no honest rewrite is accused, and no mutant hides behind one."""

from __future__ import annotations

import bz2
import gzip
import json
import lzma
import random
import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import lz4.frame
import pytest
import rewriting
import zstandard
from made_recordings import random_gains, random_problem, simulate, whole_run
from mcap.reader import make_reader
from rewriting import PARTIAL, WHOLE, Contents, Item, Rewrite, Style, any_style, drained, read, rewritten, write

from agent.contract.errors import InputError
from agent.contract.gains import Gains
from agent.contract.keys import EVIDENCE
from agent.contract.messages import Evidence, Stamp, digest_of
from agent.contract.recording import Logged
from agent.contract.recording.evidence.chains import Chains
from agent.contract.recording.recover import recover
from agent.contract.recording.writer import RecordingWriter
from designer.replay import replay
from designer.replay.verdict import Verdict

STEPS = 24
GAINS = random_gains(random_problem(5, ny=(1, 2, 1), modes=2))
STARTED = "2026-01-02T03:04:05+00:00"


def recorded(path: Path, *, gains: Gains = GAINS, seed: int = 1, name: str = "honest", started: str = STARTED) -> Path:
    """A recording as the recorder writes it, with evidence in many small blocks."""
    run = {"run": name, "seed": str(seed), "steps": str(STEPS), "gains": gains.digest(), "external": ""}
    run |= {"problem_digest": gains.problem.digest(), "window": "8", "started": started}
    begun = rewriting.nanoseconds(started)
    end = {"status": "finished", "reason": "", "steps": str(STEPS)}
    end |= {f"received.{who}": str(count) for who, count in whole_run(gains.problem, STEPS).items()}
    chains, time = Chains(), 0
    with RecordingWriter(path, run=run, gains=gains) as writer:

        def tell(blocks: Iterable[Evidence]) -> None:
            for block in blocks:
                writer.add(Logged(EVIDENCE, block.encode(), 0, begun + time, begun + time))

        for place, (message, time) in enumerate(drained(simulate(gains, steps=STEPS, seed=seed))):
            payload, number = json.dumps(message.document).encode(), message.number
            writer.add(Logged(message.topic, payload, number, begun + time, begun + time - 500))
            stamp = Stamp(number, 0, message.who, digest_of(message.topic, payload))
            chains.add(stamp, message.document["step"])
            tell(chains.rest() if place % 40 == 39 else ())
        tell(chains.rest(last=True))
        writer.finish(end | {f"head.{who}": head for who, head in chains.heads().items()})
    return path


def bare(contents: Contents) -> Contents:
    """Without evidence, as it was recorded before there was any."""
    metadata = ((name, {key: text for key, text in facts.items() if not key.startswith("head.")})
                for name, facts in contents.metadata)  # fmt: skip
    items = (item for item in contents.items if item.topic != EVIDENCE)
    return rewriting.replace(contents, metadata=tuple(metadata), items=tuple(items))


@pytest.fixture(scope="module")
def honest(tmp_path_factory: pytest.TempPathFactory) -> Contents:
    return read(recorded(tmp_path_factory.mktemp("honest") / "run.mcap"))


def messages_of(contents: Contents) -> set[tuple[str, bytes]]:
    """The run's messages in a file, each once."""
    return {(item.topic, item.payload) for item in ours(contents) if item.topic != EVIDENCE}


def assert_not_accused(verdict: Verdict, contents: Contents, honest: Contents) -> None:
    there, all_of_it = messages_of(contents), messages_of(honest)
    said = verdict.text()
    assert verdict.agrees, said
    assert (verdict.missing.total, verdict.evidence.total) == (0, 0), said
    assert verdict.messages == len(there), said
    if there == all_of_it and ("end" in {name for name, _ in contents.metadata}):
        assert (verdict.outcome, verdict.exit_code, verdict.lacking.total) == ("agrees", 0, 0), said
    else:
        assert verdict.exit_code == 3, said
        assert verdict.lacking.total == len(all_of_it) - len(there) or verdict.status == "cut", said


def some(chance: random.Random, rewrites: tuple[Rewrite, ...]) -> list[Rewrite]:
    return chance.sample(rewrites, chance.randint(1, 3))


@pytest.mark.parametrize("seed", range(120))
def test_a_rewrite_that_keeps_everything_agrees(tmp_path: Path, honest: Contents, seed: int) -> None:
    chance = random.Random(seed)
    contents = rewritten(honest if seed % 3 else bare(honest), some(chance, WHOLE), chance)
    verdict = replay(write(tmp_path / "run.mcap", contents, any_style(chance)))
    assert_not_accused(verdict, contents, honest)
    assert verdict.exit_code == 0


@pytest.mark.parametrize("seed", range(160))
def test_a_rewrite_that_leaves_something_out_is_judged_for_what_is_there(
    tmp_path: Path, honest: Contents, seed: int
) -> None:
    chance = random.Random(1000 + seed)
    rewrites = [*some(chance, PARTIAL), *some(chance, WHOLE)]
    chance.shuffle(rewrites)
    contents = rewritten(honest if seed % 3 else bare(honest), rewrites, chance)
    verdict = replay(write(tmp_path / "run.mcap", contents, any_style(chance)))
    assert_not_accused(verdict, contents, honest)


# parts and runs
@pytest.mark.parametrize("seed", range(8))
def test_parts_that_are_given_together_are_one_run(tmp_path: Path, honest: Contents, seed: int) -> None:
    chance = random.Random(seed)
    parts = rewriting.split_by_time(honest, 3)
    paths = [write(tmp_path / f"{at}.mcap", part, any_style(chance)) for at, part in enumerate(parts)]
    chance.shuffle(paths)
    verdict = replay(paths)
    assert_not_accused(verdict, honest, honest)
    for some_of_them in (paths[:1], paths[:2]):
        verdict = replay(some_of_them)
        assert (verdict.outcome, verdict.missing.total) == ("agrees for what is there", 0), verdict.text()


def parts_of_a_recorder(contents: Contents, number: int) -> list[Contents]:
    """As a recorder writes parts: only the last says how the run ended."""
    parts = rewriting.split_by_time(contents, number)
    for at, part in enumerate(parts):
        metadata = []
        for name, facts in part.metadata:
            continues = {"status": "continues", "steps": str(at), "next": f"run.part{at + 2}.mcap"}
            changed = {"part": str(at + 1)} if name == "run" else continues if at + 1 < number else {}
            metadata.append((name, facts | changed))
        parts[at] = rewriting.replace(part, metadata=tuple(metadata))
    return parts


def test_parts_of_a_recorder_are_one_run(tmp_path: Path, honest: Contents) -> None:
    parts = parts_of_a_recorder(honest, 3)
    paths = [write(tmp_path / f"{at}.mcap", part) for at, part in enumerate(parts)]
    assert replay([paths[2], paths[0], paths[1]]).exit_code == 0
    joined = write(tmp_path / "joined.mcap", rewriting.merged(parts, random.Random(0)))
    assert replay(joined).exit_code == 0
    verdict = replay(paths[0])
    assert (verdict.exit_code, verdict.status, verdict.agrees) == (3, "continues", True)
    verdict = replay([paths[0], paths[2]])
    assert (verdict.exit_code, verdict.missing.total) == (3, 0), verdict.text()


def two_runs(folder: Path) -> tuple[Contents, Contents]:
    other = recorded(folder / "b.mcap", seed=9, name="other", started="2026-01-02T03:14:05+00:00")
    return read(recorded(folder / "a.mcap")), read(other)


@pytest.mark.parametrize("seed", range(6))
def test_two_runs_in_a_file_are_named_and_each_can_be_chosen(tmp_path: Path, seed: int) -> None:
    chance = random.Random(seed)
    contents = rewriting.merged(chance.sample(two_runs(tmp_path), 2), chance)
    path = write(tmp_path / "both.mcap", contents, any_style(chance))
    with pytest.raises(InputError, match=r'holds 2 runs, "[a-z]+" \(seed \d, .*; choose one by --run NAME$'):
        replay(path)
    with pytest.raises(InputError, match='has no run "third"; it has "'):
        replay(path, run="third")
    for name, run_seed in (("honest", 1), ("other", 9)):
        verdict = replay(path, run=name)
        assert (verdict.exit_code, verdict.seed) == (0, run_seed), verdict.text()
        assert re.search(r"\d+ messages of other runs are left alone", verdict.text())


# mutants
Mutant = Callable[[list[Item], random.Random], list[Item]]


def inner(items: list[Item], chance: random.Random, kind: str = "estimate") -> int:
    """The place of a message in the midst of the run."""
    fitting = [at for at, item in enumerate(items) if item.topic.endswith(kind) and 3 < step_of(item) < STEPS - 3]
    return chance.choice(fitting)


def step_of(item: Item) -> int:
    return int(json.loads(item.payload)["step"])


def altered(item: Item, field: str, value: Any) -> Item:
    document = json.loads(item.payload)
    assert document[field] != value
    return item._replace(payload=json.dumps(document | {field: value}).encode())


def deleted(items: list[Item], chance: random.Random) -> list[Item]:
    at = inner(items, chance, chance.choice(["estimate", "measurement", "mode", "state"]))
    return [item for item in items if (item.topic, item.payload) != (items[at].topic, items[at].payload)]


def shifted(items: list[Item], chance: random.Random) -> list[Item]:
    """A millionth more in one entry."""
    at = inner(items, chance)
    x_hat = json.loads(items[at].payload)["x_hat"]
    return in_all_copies(items, at, altered(items[at], "x_hat", [x_hat[0] + 1e-6, x_hat[1]]))


def doubled(items: list[Item], chance: random.Random) -> list[Item]:
    """Again, with another content."""
    at = inner(items, chance, "measurement")
    return [*items, altered(items[at], "y", [0.5] * len(json.loads(items[at].payload)["y"]))]


def exchanged(items: list[Item], chance: random.Random) -> list[Item]:
    """The contents of two steps."""
    one = inner(items, chance)
    step = step_of(items[one])
    two = next(at for at, item in enumerate(items) if item.topic == items[one].topic and step_of(item) == step + 1)
    first, second = items[one], items[two]
    items = in_all_copies(items, one, second._replace(payload=renamed(second.payload, step)))
    return in_all_copies(items, two, first._replace(payload=renamed(first.payload, step + 1)))


def renamed(payload: bytes, step: int) -> bytes:
    return json.dumps(json.loads(payload) | {"step": step}).encode()


def in_other_mode(items: list[Item], chance: random.Random) -> list[Item]:
    at = inner(items, chance, "mode")
    mode = json.loads(items[at].payload)["mode"]
    other = next(name for name in GAINS.problem.mode_names if name != mode)
    return in_all_copies(items, at, altered(items[at], "mode", other))


def in_all_copies(items: list[Item], at: int, new: Item) -> list[Item]:
    """With the message at `at` exchanged, wherever it stands."""
    old = items[at]
    return [
        item._replace(payload=new.payload) if (item.topic, item.payload) == (old.topic, old.payload) else item
        for item in items
    ]


MUTANTS: dict[Mutant, str] = {
    deleted: "missing: 1 (",
    shifted: "first divergence, step",
    doubled: "double: 1 (",
    exchanged: "first divergence, step",
    in_other_mode: "first divergence, step",
}


@pytest.mark.parametrize("seed", range(16))
@pytest.mark.parametrize("mutant", MUTANTS)
def test_no_mutant_hides_behind_a_rewrite(tmp_path: Path, honest: Contents, mutant: Mutant, seed: int) -> None:
    chance = random.Random(2000 + seed)
    base = honest if seed % 2 else bare(honest)
    mutated = base.with_items(mutant(list(base.items), chance))
    contents = rewritten(mutated, some(chance, WHOLE), chance)
    verdict = replay(write(tmp_path / "run.mcap", contents, any_style(chance)))
    assert (verdict.exit_code, verdict.outcome) == (1, "diverges"), verdict.text()
    assert MUTANTS[mutant] in verdict.text()


@pytest.mark.parametrize("seed", range(12))
def test_no_altered_number_hides_behind_a_filter(tmp_path: Path, honest: Contents, seed: int) -> None:
    """Filtered by time or topic around it."""
    chance = random.Random(3000 + seed)
    mutated = honest.with_items(shifted(list(honest.items), chance))
    contents = rewritten(mutated, [rewriting.without_events, chance.choice(WHOLE)], chance)
    verdict = replay(write(tmp_path / "run.mcap", contents, any_style(chance)))
    assert (verdict.exit_code, verdict.outcome) == (1, "diverges"), verdict.text()


def test_a_message_that_is_deleted_from_a_part_is_named(tmp_path: Path, honest: Contents) -> None:
    """Whether a tool or somebody took it, nobody can say: it is no good run in either case."""
    contents = rewriting.without_events(honest, random.Random(0))
    at = inner(list(contents.items), random.Random(1), "measurement")
    gone = contents.items[at]
    path = write(tmp_path / "run.mcap", contents.with_items(item for item in contents.items if item != gone))
    verdict = replay(path)
    assert verdict.exit_code == 3
    assert f"step {step_of(gone)} of {gone.topic}" in verdict.text()


def test_other_facts_of_the_run_are_found(tmp_path: Path, honest: Contents) -> None:
    def changed(**facts: str) -> Contents:
        metadata = tuple((name, told | (facts if name == "run" else {})) for name, told in honest.metadata)
        return rewriting.replace(honest, metadata=metadata)

    assert replay(write(tmp_path / "seed.mcap", changed(seed="2"))).exit_code == 1
    assert replay(write(tmp_path / "steps.mcap", changed(steps=str(STEPS - 1)))).exit_code == 1
    assert replay(write(tmp_path / "more.mcap", changed(steps=str(STEPS + 1)))).exit_code == 1
    with pytest.raises(InputError, match="recording format peakmesh-recording 2; this peakmesh reads"):
        replay(write(tmp_path / "version.mcap", changed(version="2")))


def test_altered_attachments_are_named(tmp_path: Path, honest: Contents) -> None:
    def attached(name: str, change: Callable[[bytes], bytes]) -> Contents:
        kept = [(other, change(data) if other == name else data) for other, data in honest.attachments]
        return rewriting.replace(honest, attachments=tuple(kept))

    spaced = attached("problem.json", lambda data: json.dumps(json.loads(data), indent=2).encode())
    assert replay(write(tmp_path / "spaced.mcap", spaced)).exit_code == 0
    verdict = replay(write(tmp_path / "p.mcap", attached("problem.json", lambda data: data.replace(b"0.8", b"0.9"))))
    assert verdict.exit_code == 1
    assert "the attachment problem.json was altered or exchanged: its digest is" in verdict.text()
    with pytest.raises(InputError, match=r"gains\.json was altered or exchanged: its digest is .*--gains"):
        replay(
            write(tmp_path / "g.mcap", attached("gains.json", lambda data: data.replace(b'd":"random', b'd":"better')))
        )
    with pytest.raises(InputError, match=r"gains\.json is not a gains file"):
        replay(write(tmp_path / "x.mcap", attached("gains.json", lambda data: b"?" + data)))


# recovering
def same(verdict: Verdict) -> dict[str, Any]:
    """What a verdict says of the run, not of the file: one that holds a message twice may have it altered twice."""
    of_file = ("recording", "notes", "copies", "damage", "status", "reason", "altered_first", "proofs")
    facts = {key: fact for key, fact in verdict.document().items() if key not in of_file}
    return facts | {"altered": facts["altered"] > 0, "holds": [proof.holds for proof in verdict.proofs]}


@pytest.mark.parametrize("seed", range(16))
def test_a_recovered_recording_has_the_verdict_of_the_old_one(tmp_path: Path, honest: Contents, seed: int) -> None:
    chance = random.Random(4000 + seed)
    contents = rewritten(honest, [*some(chance, PARTIAL), *some(chance, WHOLE)], chance)
    if seed % 4 == 0:
        mutant = chance.choice(list(MUTANTS))
        contents = rewritten(honest.with_items(mutant(list(honest.items), chance)), some(chance, WHOLE), chance)
    old, new = write(tmp_path / "old.mcap", contents, any_style(chance)), tmp_path / "new.mcap"
    found = recover([old], new)
    assert same(replay(new)) == same(replay(old))
    assert found.foreign == len(contents.items) - len(ours(contents))
    assert found.messages == len({(item.topic, item.payload) for item in ours(contents) if item.topic != EVIDENCE})
    again = read(new)
    assert {(item.topic, item.payload, item.sequence) for item in again.items} <= {
        (item.topic, item.payload, item.sequence) for item in contents.items
    }
    steps = [step_of(item) for item in again.items]
    assert steps == sorted(steps)


def ours(contents: Contents) -> list[Item]:
    return [item for item in contents.items if not item.topic.startswith("/")]


def test_parts_are_recovered_into_one(tmp_path: Path, honest: Contents) -> None:
    parts = parts_of_a_recorder(honest, 3)
    paths = [write(tmp_path / f"{at}.mcap", part) for at, part in enumerate(parts)]
    assert recover(paths, tmp_path / "whole.mcap").steps == STEPS
    assert replay(tmp_path / "whole.mcap").exit_code == 0


# damage
@pytest.mark.parametrize("seed", range(120))
def test_a_flipped_bit_is_neither_silent_nor_an_accusation(tmp_path: Path, honest: Contents, seed: int) -> None:
    """Where a checksum covers everything; in the index a bit does no harm."""
    chance = random.Random(5000 + seed)
    style = rewriting.replace(any_style(chance), data_crcs=True)
    path = write(tmp_path / "run.mcap", honest, style)
    data, good = bytearray(path.read_bytes()), same(replay(path))
    data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
    path.write_bytes(data)
    verdict = judged(path)
    if verdict is None:
        return
    assert verdict.outcome != "diverges", verdict.text()
    assert verdict.exit_code == 3 or same(verdict) == good, verdict.text()


@pytest.mark.parametrize("compression", rewriting.COMPRESSIONS)
@pytest.mark.parametrize("data_crcs", [True, False])
def test_a_bad_chunk_in_the_middle_costs_that_chunk_alone(
    tmp_path: Path, honest: Contents, compression: Any, data_crcs: bool
) -> None:
    style = Style(chunk_size=1500, compression=compression, data_crcs=data_crcs)
    path = write(tmp_path / "run.mcap", honest, style)
    data, chunks = bytearray(path.read_bytes()), chunks_of(path)
    start, size = chunks[len(chunks) // 2]
    data[start + size // 2] ^= 4
    path.write_bytes(data)
    verdict = replay(path)
    assert (verdict.outcome, verdict.missing.total) == ("agrees for what is there", 0), verdict.text()
    assert 0 < verdict.lacking.total < 3 * len(honest.items) / len(chunks)
    assert f"chunk {len(chunks) // 2 + 1} of {len(chunks)} " in verdict.damage
    assert "its messages are lost" in verdict.damage
    assert re.search(r"not in this file: \d+ messages \(.*steps? \d+", verdict.text())


@pytest.mark.parametrize("compression", rewriting.COMPRESSIONS)
@pytest.mark.parametrize("length", [0, 3, 2**20, 2**62, 2**64 - 1])
def test_a_wrong_length_costs_that_chunk_alone(tmp_path: Path, honest: Contents, compression: Any, length: int) -> None:
    """Of the record, or what it says of its size unpacked: neither is believed."""
    path = write(tmp_path / "run.mcap", honest, Style(chunk_size=1500, compression=compression, data_crcs=False))
    chunks, whole = chunks_of(path), path.read_bytes()
    start, _ = chunks[len(chunks) // 2]
    for place in (start - 8, start + 16):
        data = bytearray(whole)
        data[place : place + 8] = length.to_bytes(8, "little")
        path.write_bytes(data)
        verdict = replay(path)
        assert (verdict.outcome, verdict.missing.total) == ("agrees for what is there", 0), verdict.text()
        assert 0 < verdict.lacking.total < 4 * len(honest.items) / len(chunks)
        assert verdict.damage


def chunks_of(path: Path) -> list[tuple[int, int]]:
    """Where the bodies of the chunks begin, and how long they are."""
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    return [(index.chunk_start_offset + 9, index.chunk_length - 9) for index in summary.chunk_indexes]


@pytest.mark.parametrize("chunk_size", [None, 2000])
@pytest.mark.parametrize("share", [0.3, 0.6, 0.95])
def test_a_cut_file_with_a_tail_of_zeros_is_read_up_to_there(
    tmp_path: Path, honest: Contents, chunk_size: int | None, share: float
) -> None:
    path = write(tmp_path / "run.mcap", honest, Style(chunk_size=chunk_size))
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))] + bytes(4096))
    verdict = replay(path)
    assert verdict.agrees, verdict.text()
    if re.search(r"bytes from byte \d+ on are (zeros|no records)", verdict.damage):
        assert (verdict.exit_code, verdict.missing.total) == (3, 0)
    else:
        assert "its index is damaged" in verdict.text()
        assert verdict.messages == len(messages_of(honest))


@pytest.mark.parametrize(
    ("name", "pack"),
    [
        ("gzip", gzip.compress),
        ("zstd", zstandard.compress),
        ("lz4", lz4.frame.compress),
        ("xz", lzma.compress),
        ("bzip2", bz2.compress),
    ],
)
def test_a_packed_recording_is_read_through(
    tmp_path: Path, honest: Contents, name: str, pack: Callable[[bytes], bytes]
) -> None:
    path = write(tmp_path / "run.mcap", honest)
    packed = pack(path.read_bytes())
    path.write_bytes(packed)
    verdict = replay(path)
    assert verdict.exit_code == 0
    assert f"note: it is packed by {name}, and was read through that" in verdict.text()
    path.write_bytes(packed[: len(packed) // 2])
    part = judged(path)
    assert part is None or (part.exit_code == 3 and f"the {name} around it is cut or damaged" in part.damage)


def judged(path: Path) -> Verdict | None:
    """The verdict, or None where the file is refused, in one sentence."""
    try:
        return replay(path)
    except InputError as error:
        sentence = str(error)
    assert sentence.startswith(str(path))
    assert "\n" not in sentence
    return None


def test_the_next_parts_beside_a_recording_are_read_with_it(tmp_path: Path, honest: Contents) -> None:
    """By the names that the recorder gives them, the last one unfinished or not."""
    parts = parts_of_a_recorder(honest, 3)
    for name, part in zip(("run.mcap", "run.part2.mcap", "run.part3.mcap"), parts, strict=True):
        write(tmp_path / name, part)
    verdict = replay(tmp_path / "run.mcap")
    assert verdict.exit_code == 0, verdict.text()
    assert "note: it goes on in run.part2.mcap, run.part3.mcap, which was read with it" in verdict.text()
    data = (tmp_path / "run.part3.mcap").read_bytes()
    (tmp_path / "run.part3.mcap").unlink()
    for share, left in ((0.5, 3), (0.001, 2)):  # killed while it was written, or before it had a head
        (tmp_path / "run.part3.mcap.part").write_bytes(data[: int(share * len(data))])
        verdict = replay(tmp_path / "run.mcap")
        assert (verdict.outcome, verdict.status, verdict.missing.total) == ("agrees for what is there", "continues", 0)
        assert verdict.text().count("mcap.part,") == left - 2
    write(tmp_path / "run.part2.mcap", read(recorded(tmp_path / "other.mcap", seed=9, name="other")))
    assert replay(tmp_path / "run.mcap").messages == len(messages_of(parts[0]))
