"""Two recordings are the same run where every value is, bit for bit; one bit in one number is found, and named."""

from __future__ import annotations

import copy
import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from here import here
from hypothesis import given
from hypothesis import strategies as st
from made_recordings import Sent, random_gains, random_problem, real_problem, record, simulate
from places import GOLDEN
from runs import end_of, logged

from agent.contract.arrays import ulps
from agent.contract.gains import Gains
from agent.contract.recording.reader import RecordingReader
from agent.contract.recording.writer import RecordingWriter
from designer.compare import compare

STEPS = 6
FLOATS = st.floats(allow_nan=False)


@pytest.fixture(scope="module")
def sent(gains: Gains) -> list[Sent]:
    return simulate(gains, steps=STEPS)


def write(path: Path, gains: Gains, sent: list[Sent], **facts: Any) -> Path:
    return record(path, gains, sent, steps=STEPS, **facts)


def flipped(value: float, bit: int = 0) -> float:
    """With one bit changed."""
    return float(
        struct.unpack("<d", struct.pack("<Q", struct.unpack("<Q", struct.pack("<d", value))[0] ^ (1 << bit)))[0]
    )


# distances
@given(FLOATS)
def test_neighbours_are_one_ulp_apart(value: float) -> None:
    assert ulps(value, value) == 0
    assert ulps(value, flipped(value)) == 1


@given(FLOATS, FLOATS, FLOATS)
def test_ulps_are_a_distance(a: float, b: float, c: float) -> None:
    assert ulps(a, b) == ulps(b, a)
    assert ulps(a, c) <= ulps(a, b) + ulps(b, c)


def test_zeros_of_both_signs_are_told_apart() -> None:
    assert (ulps(0.0, -0.0), ulps(5e-324, -5e-324), ulps(1.0, 1.0 + 2.0**-52)) == (1, 3, 1)


# the same run
def test_a_run_is_the_same_as_itself(gains: Gains, sent: list[Sent], tmp_path: Path) -> None:
    """In whatever order its messages stand, whatever it is called, and with another numbering."""
    a = write(tmp_path / "a.mcap", gains, sent)
    renumbered = [message._replace(number=0) for message in reversed(sent)]
    found = compare(a, write(tmp_path / "b.mcap", gains, renumbered, run="another"))
    assert (found.identical, found.exit_code, found.first) == (True, 0, None)
    assert found.messages == len(sent) - 2  # the two events
    assert set(found.draws().values()) == {True}
    assert all(gap.compared == STEPS for gap in found.gaps.values())


def test_values_written_otherwise_are_the_same(gains: Gains, sent: list[Sent], tmp_path: Path) -> None:
    """With white space here."""
    a, b = write(tmp_path / "a.mcap", gains, sent), tmp_path / "b.mcap"
    with RecordingReader(a) as reader, RecordingWriter(b, run=reader.run, gains=gains) as writer:
        for message in reader.messages():
            writer.add(message._replace(payload=json.dumps(json.loads(message.payload), indent=1).encode()))
        writer.finish(reader.end or {})
    found = compare(a, b)
    assert found.identical
    assert found.rewritten == len(sent) - 2
    assert "same values in other bytes" in found.text()


def test_a_run_without_the_index_of_modes_is_the_same(gains: Gains, sent: list[Sent], tmp_path: Path) -> None:
    """As older recordings are; it is said."""
    older = copy.deepcopy(sent)
    for message in older:
        message.document.pop("index", None)
    found = compare(write(tmp_path / "a.mcap", gains, older), write(tmp_path / "b.mcap", gains, sent))
    assert found.identical
    assert found.unsaid == {"index of mode"}


# one bit
def places(sent: list[Sent]) -> list[tuple[int, str, int | None]]:
    """Every value of every message of step 3: where it is, in the list of messages and in the message."""
    found: list[tuple[int, str, int | None]] = []
    for number, message in enumerate(sent):
        if message.document["step"] == 3 and message.topic != "event":
            for name, value in message.document.items():
                values = value.tolist() if hasattr(value, "tolist") else value
                found += [(number, name, i) for i in range(len(values))] if isinstance(values, list) else []
                found += [(number, name, None)] if name in {"mode", "index"} else []
    return found


def changed(value: Any) -> Any:
    match value:
        case float():
            return flipped(value)
        case int():
            return 1 - value
        case str():
            return {"m": "n"}.get(value, value + "x")
    raise AssertionError(value)


def test_one_bit_of_any_number_is_found_and_named(gains: Gains, sent: list[Sent], tmp_path: Path) -> None:
    """And one letter of any word, and every other whole number."""
    a = write(tmp_path / "a.mcap", gains, sent)
    cases = places(sent)
    assert len(cases) > 30
    for case, (number, name, place) in enumerate(cases):
        other = copy.deepcopy(sent)
        document = other[number].document
        before = document[name] if place is None else document[name][place]
        after = changed(before)
        if place is None:
            document[name] = after
        else:
            document[name][place] = after
        found = compare(a, write(tmp_path / f"{case}.mcap", gains, other))
        assert not found.identical
        assert found.first is not None
        assert (found.first.step, found.first.topic) == (3, other[number].topic)
        assert found.first.field == (name if place is None else f"{name}[{place}]")
        assert (found.first.a, found.first.b) == (before, after)
        assert found.first.ulp == (1 if isinstance(before, float) else None)
        differing = {at: gap.differ for at, gap in found.gaps.items() if gap.differ}
        assert differing == {(other[number].topic, name): 1}


def test_sizes_are_those_of_the_largest_gap(gains: Gains, sent: list[Sent], tmp_path: Path) -> None:
    other = copy.deepcopy(sent)
    at = [number for number, message in enumerate(sent) if message.topic == "plant/state"]
    for number, size in zip(at[1:], (1e-9, 1e-3, 1e-6), strict=False):
        other[number].document["x"][0] += size
    found = compare(write(tmp_path / "a.mcap", gains, sent), write(tmp_path / "b.mcap", gains, other))
    gap = found.gaps["plant/state", "x"]
    x = sent[at[2]].document["x"][0]
    assert (gap.compared, gap.differ) == (STEPS, 3)
    assert gap.absolute == pytest.approx(1e-3)
    assert gap.relative == max(
        abs(a.document["x"][0] - b.document["x"][0]) / max(abs(a.document["x"][0]), abs(b.document["x"][0]))
        for a, b in zip(sent, other, strict=True)
        if a.topic == "plant/state" and a.document["step"] in (1, 2, 3)
    )
    assert gap.ulp == max(
        ulps(a.document["x"][0], b.document["x"][0])
        for a, b in zip(sent, other, strict=True)
        if a.topic == "plant/state"
    )
    assert x != 0.0


# other runs
MUTANTS: dict[str, Callable[[list[Sent]], list[Sent]]] = {
    "one message is not there": lambda sent: [m for m in sent if (m.topic, m.document["step"]) != ("mode", 2)],
    "one more message": lambda sent: [*sent, sent[-2]._replace(document=sent[-2].document | {"step": STEPS})],
    "one message twice": lambda sent: [*sent, sent[5]],
    "a node is not there": lambda sent: [m for m in sent if not m.topic.startswith("node/n1/")],
    "one vector is longer": lambda sent: [
        m._replace(document=m.document | {"w": [*m.document["w"], 0.0]}) if m.topic == "plant/state" else m
        for m in sent
    ],
    "one message is unreadable": lambda sent: [*sent, sent[5]._replace(document={"step": "five"})],
    "a topic that there is not": lambda sent: [*sent[:-1], sent[5]._replace(document={"step": 2, "y": [0.0]})],
}


@pytest.mark.parametrize("what", MUTANTS)
def test_what_is_not_the_same_run_differs(what: str, gains: Gains, sent: list[Sent], tmp_path: Path) -> None:
    a, b = (
        write(tmp_path / "a.mcap", gains, sent),
        write(tmp_path / "b.mcap", gains, MUTANTS[what](copy.deepcopy(sent))),
    )
    for one, two in ((a, b), (b, a)):
        found = compare(one, two)
        assert (found.identical, found.exit_code) == (False, 1)
        json.dumps(found.document())
        found.text()


def test_what_is_missing_is_named(gains: Gains, sent: list[Sent], tmp_path: Path) -> None:
    fewer = [m for m in sent if (m.topic, m.document["step"]) not in {("mode", 2), ("node/n0/estimate", 4)}]
    a, b = write(tmp_path / "a.mcap", gains, sent), write(tmp_path / "b.mcap", gains, fewer)
    found = compare(a, b)
    assert found.only == ({"mode": 1, "node/n0/estimate": 1}, {})
    assert found.first is not None
    assert found.first.text() == "step 2, mode: not in the second"
    back = compare(b, a).first
    assert back is not None
    assert back.text() == "step 2, mode: not in the first"


def test_another_seed_and_other_gains_are_said(gains: Gains, sent: list[Sent], tmp_path: Path) -> None:
    a = write(tmp_path / "a.mcap", gains, sent)
    other = compare(a, write(tmp_path / "b.mcap", gains, simulate(gains, steps=STEPS, seed=2), seed=2))
    assert {name for name, (x, y) in other.facts.items() if x != y} == {"seed"}
    assert [other.draws()[name] for name in ("modes", "losses", "disturbance")] == [False] * 3
    tuned = random_gains(gains.problem, seed=4)
    other = compare(a, write(tmp_path / "c.mcap", tuned, simulate(tuned, steps=STEPS)))
    assert {name for name, (x, y) in other.facts.items() if x != y} == {"gains"}
    assert other.draws() == dict.fromkeys(("modes", "losses", "disturbance", "deliveries"), True)
    assert other.first is not None
    assert (other.first.step, other.first.field) == (1, "x_hat[0]")


def test_gains_alone_make_a_difference(gains: Gains, sent: list[Sent], tmp_path: Path) -> None:
    """Where all messages are the same."""
    tuned = random_gains(gains.problem, seed=4)
    found = compare(write(tmp_path / "a.mcap", gains, sent), write(tmp_path / "b.mcap", tuned, sent))
    assert (found.identical, found.first) == (False, None)


def test_a_cut_recording_differs_from_the_whole(gains: Gains, sent: list[Sent], tmp_path: Path) -> None:
    a = write(tmp_path / "a.mcap", gains, sent)
    b = write(tmp_path / "b.mcap", gains, sent[: len(sent) // 2], whole=False)
    found = compare(a, b)
    assert not found.identical
    assert found.facts["end"] == ("finished 6", "cut: it has no end")
    assert found.only[0].total() + found.messages == len(sent) - 2
    data = a.read_bytes()
    (tmp_path / "c.mcap").write_bytes(data[: 2 * len(data) // 3])
    assert not compare(a, tmp_path / "c.mcap").identical


def test_empty_measurements_are_compared(tmp_path: Path) -> None:
    """Of nodes that see their losses."""
    gains = random_gains(real_problem(2, unbiased=False))
    sent = simulate(gains, steps=STEPS)
    a = write(tmp_path / "a.mcap", gains, sent)
    assert compare(a, write(tmp_path / "b.mcap", gains, sent)).identical
    empty = next(m for m in sent if m.topic.endswith("measurement") and not len(m.document["y"]))
    other = [m._replace(document=m.document | {"y": [0.0]}) if m is empty else m for m in sent]
    first = compare(a, write(tmp_path / "c.mcap", gains, other)).first
    assert first is not None
    assert (first.field, first.a, first.b) == ("y", [], [0.0])


def test_networks_of_other_sizes_are_compared(gains: Gains, sent: list[Sent], tmp_path: Path) -> None:
    small = random_gains(random_problem(7, ny=(1, 1), nx=3))
    other = write(tmp_path / "b.mcap", small, simulate(small, steps=STEPS))
    found = compare(write(tmp_path / "a.mcap", gains, sent), other)
    assert not found.identical
    assert set(found.only[0]) == {"node/n2/measurement", "node/n2/estimate"}


# the command
def test_the_command_says_how_far_apart(gains: Gains, sent: list[Sent], tmp_path: Path) -> None:
    other = copy.deepcopy(sent)
    number, message = next(
        (i, m) for i, m in enumerate(sent) if m.topic == "node/n2/estimate" and m.document["step"] == 3
    )
    other[number].document["z_hat"][0] = flipped(message.document["z_hat"][0], 3)
    a, b = write(tmp_path / "a.mcap", gains, sent), write(tmp_path / "b.mcap", gains, other)
    done = here("compare", a, b)
    assert (done.returncode, done.stderr) == (1, "")
    assert done.stdout.startswith(f"{a} and {b}: they differ\n")
    assert "first difference: step 3, node/n2/estimate, z_hat[0]: " in done.stdout
    assert "8 ulp apart" in done.stdout
    same = here("compare", a, a, "--json")
    assert same.returncode == 0
    assert json.loads(same.stdout)["identical"] is True


def test_what_is_no_recording_is_refused(gains: Gains, sent: list[Sent], tmp_path: Path) -> None:
    a = write(tmp_path / "a.mcap", gains, sent)
    for other in (tmp_path / "none.mcap", GOLDEN / "zhu2020-lossy.gains.json", tmp_path):
        done = here("compare", a, other)
        assert (done.returncode, done.stdout) == (2, "")
        assert done.stderr.startswith("peakmesh: ")
        assert done.stderr.count("\n") == 1


def test_waiting_messages_are_let_go(gains: Gains, tmp_path: Path) -> None:
    """What waits for its partner does not grow with the run, nor what is remembered of it."""
    from designer.compare import _Pairs, _Seen
    from designer.compare.comparison import Comparison

    sent = simulate(gains, steps=50)
    a = record(tmp_path / "a.mcap", gains, sent, steps=50)
    assert end_of(a) is not None
    pairs = _Pairs(Comparison(("a", "b"), {}))
    pairs.read(iter(logged(a)), iter(logged(a)))
    assert [len(side) for side in pairs._waiting] == [0, 0]
    seen = _Seen()
    assert [seen.again(step) for step in (0, 1, 3, 1, 3, 2)] == [False, False, False, True, True, False]
    assert (seen._below, seen._beyond) == (4, set())
