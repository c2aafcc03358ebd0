"""Evidence names the message that was changed, whichever way; it accuses no honest rewrite, and says what it cannot."""

from __future__ import annotations

import json
import random
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import pytest
from made_recordings import random_gains, random_problem, simulate

from agent.contract.files import canonical
from agent.contract.keys import (
    EVIDENCE,
    MODE,
    PLANT_STATE,
    estimate,
    measurement,
    node_who,
    sender_of,
    sensor_who,
)
from agent.contract.messages import Evidence, Stamp, digest_of
from agent.contract.recording import Logged
from agent.contract.recording.evidence import BLOCK, FIRST_HEAD, NO_DIGEST, next_head
from agent.contract.recording.evidence import examiner as examiner_module
from agent.contract.recording.evidence.chains import Chains
from agent.contract.recording.evidence.examiner import Examiner, Findings, examine

GAINS = random_gains(random_problem(1, ny=(1, 2), modes=2))
STEPS = 150


class Run(NamedTuple):
    """What the recorder of a run wrote."""

    messages: list[Logged]
    end: dict[str, str]


def recorded(messages: Iterable[Logged], *, external: tuple[str, ...] = (), silent: tuple[str, ...] = ()) -> Run:
    """Messages with the evidence of their senders among them, as the recorder writes it; some give no digests."""
    chains, written = Chains(), list[Logged]()

    def write(evidence: Evidence) -> None:
        written.append(Logged(EVIDENCE, evidence.encode(), len(written), len(written), len(written)))

    for message in messages:
        who = sender_of(message.topic, external=external)
        written.append(message._replace(log_time=len(written)))
        digest = b"" if who in silent else digest_of(message.topic, message.payload)
        evidence = chains.add(Stamp(message.number, 0, who, digest), step_of(message))
        if evidence is not None:
            write(evidence)
    for evidence in chains.rest(last=True):
        write(evidence)
    return Run(written, {f"head.{who}": head for who, head in chains.heads().items()})


def step_of(message: Logged) -> int:
    """The step that a message says; -1 where it is none any more."""
    try:
        return int(json.loads(message.payload)["step"])
    except (ValueError, KeyError):
        return -1


def found(run: Run, *, external: tuple[str, ...] = ()) -> Findings:
    return examine(((message, step_of(message)) for message in run.messages), external=external, end=run.end)


def wire(*, external: tuple[str, ...] = ()) -> list[Logged]:
    """What was on the wire of a run."""
    real: dict[str, Any] = {name: [[0.5] * len(GAINS.problem.nodes[0].C)] * STEPS for name in external}
    return [
        Logged(sent.topic, canonical(sent.document), sent.number, 0, 0)
        for sent in simulate(GAINS, steps=STEPS, real_y=real)
    ]


RUN = recorded(wire())
WIRE = [message for message in RUN.messages if message.topic != EVIDENCE]


def place_of(topic: str, step: int) -> int:
    """Where the message of a topic and step stands in RUN."""
    return next(i for i, message in enumerate(RUN.messages) if (message.topic, step_of(message)) == (topic, step))


def changed(*places: int, by: Callable[[list[Logged]], list[Logged]]) -> Run:
    """RUN with what `by` makes of the messages at `places`, at these places."""
    messages = list[Logged | None](RUN.messages)
    for place, message in zip(places, by([RUN.messages[place] for place in places]), strict=True):
        messages[place] = message
    return RUN._replace(messages=[message for message in messages if message is not None])


def flipped(message: Logged) -> Logged:
    """The last digit is another."""
    payload = bytearray(message.payload)
    place = len(payload) - 1 - next(i for i, byte in enumerate(reversed(payload)) if chr(byte).isdigit())
    payload[place] ^= 1
    return message._replace(payload=bytes(payload))


# honest
def test_every_message_of_an_honest_run_is_checked() -> None:
    assert found(RUN) == Findings(len(WIRE), 0, (), (), ())


def test_evidence_is_small() -> None:
    """Under six bytes a message before anything is compressed to half of its hexadecimal digits."""
    evidence = [message for message in RUN.messages if message.topic == EVIDENCE]
    digits = sum(len(Evidence.decode(message.payload).digests) for message in evidence)
    assert digits == 8 * len(WIRE)
    assert len(evidence) <= len(WIRE) / BLOCK + len(RUN.end)


def test_heads_chain_the_digests_in_the_order_of_the_numbers() -> None:
    heads = dict.fromkeys(RUN.end, FIRST_HEAD)
    for message in sorted(WIRE, key=lambda message: message.number):
        key = f"head.{sender_of(message.topic)}"
        heads[key] = next_head(heads[key], digest_of(message.topic, message.payload))
    assert {key: head.hex() for key, head in heads.items()} == RUN.end
    assert set(RUN.end) == {f"head.{who}" for who in ("coordinator", "plant", "node-n0", "node-n1")}


# mutants
TOPICS = [MODE, PLANT_STATE, measurement("n1"), estimate("n0"), "event"]


@pytest.mark.parametrize(
    ("topic", "step"),
    [(topic, step) for topic in TOPICS for step in (0, 77, STEPS - 1) if (topic, step) != ("event", 77)],
)
def test_a_flipped_message_is_named(topic: str, step: int) -> None:
    place = place_of(topic, step)
    said = found(changed(place, by=lambda them: [flipped(them[0])]))
    assert [(finding.kind, finding.who, finding.number, finding.topic) for finding in said.wrong] == [
        ("altered", sender_of(topic), RUN.messages[place].number, topic)
    ]
    assert (said.total, said.checked, said.absent, said.unchecked) == (1, len(WIRE) - 1, (), ())


def test_every_bit_of_a_message_counts() -> None:
    place = place_of(estimate("n1"), 40)
    message = RUN.messages[place]
    for position in range(len(message.payload)):
        payload = bytearray(message.payload)
        payload[position] ^= 1 << (position % 8)
        run = changed(place, by=lambda them, new=bytes(payload): [them[0]._replace(payload=new)])
        said = examine(((m, 40) for m in run.messages), external=(), end=run.end)
        assert [(finding.kind, finding.number, finding.step) for finding in said.wrong] == [("altered", 40, 40)]


@pytest.mark.parametrize("topic", TOPICS)
def test_a_dropped_message_is_named_by_its_number(topic: str) -> None:
    place = place_of(topic, 0)
    said = found(changed(place, by=lambda _: [None]))
    assert said.total == 0  # a file may be a part of a recording: who expects the message says that it is missing
    (absent,) = said.absent
    assert (absent.who, absent.total, absent.first) == (sender_of(topic), 1, (RUN.messages[place].number,))
    assert absent.topic == (topic if topic == estimate("n0") else "")
    assert said.checked == len(WIRE) - 1


@pytest.mark.parametrize(("topic", "other"), [(MODE, MODE), (PLANT_STATE, measurement("n0")), (estimate("n0"),) * 2])
def test_exchanged_messages_are_named(topic: str, other: str) -> None:
    """Two messages of one sender under each other's numbers."""
    places = place_of(topic, 20), place_of(other, 90)
    numbers = [RUN.messages[place].number for place in places]
    said = found(
        changed(*places, by=lambda them: [a._replace(number=b.number) for a, b in zip(them, them[::-1], strict=True)])
    )
    assert sorted((finding.kind, finding.number) for finding in said.wrong) == sorted(
        [("exchanged", numbers[0]), ("exchanged", numbers[1])]
    )
    assert (said.total, said.checked) == (2, len(WIRE))


def test_payloads_exchanged_between_nodes_are_named() -> None:
    places = place_of(estimate("n0"), 20), place_of(estimate("n1"), 20)
    said = found(
        changed(*places, by=lambda them: [a._replace(payload=b.payload) for a, b in zip(them, them[::-1], strict=True)])
    )
    assert [(f.kind, f.who, f.number) for f in said.wrong] == [("altered", "node-n0", 20), ("altered", "node-n1", 20)]


@pytest.mark.parametrize("number", [33, STEPS, 5000])
def test_a_message_put_in_is_named(number: int) -> None:
    """Under a number that another message has, the next, or any."""
    place = place_of(estimate("n0"), 33)
    forged = flipped(RUN.messages[place])._replace(number=number)
    said = found(RUN._replace(messages=[*RUN.messages[:place], forged, *RUN.messages[place:]]))
    assert [(finding.kind, finding.who, finding.number, finding.step) for finding in said.wrong] == [
        ("inserted", "node-n0", number, step_of(forged))
    ]
    assert said.checked == len(WIRE)


def test_many_faults_are_each_named() -> None:
    """Also where several lie in one block; of very many the first are, and all are counted."""
    places = [place_of(estimate("n0"), step) for step in range(40, 40 + 60)]
    few, many = places[:7:2], places[::2]
    for chosen in (few, many):
        said = found(changed(*chosen, by=lambda them: [flipped(message) for message in them]))
        assert said.total == len(chosen)
        assert [finding.number for finding in said.wrong] == [RUN.messages[place].number for place in chosen][:20]


def test_a_message_made_to_fit_its_short_digest_is_found_by_the_chain(monkeypatch: pytest.MonkeyPatch) -> None:
    """Four bytes can be met by trying; the head is over all sixteen, and names the block."""
    place = place_of(estimate("n0"), 70)
    forged = flipped(RUN.messages[place])
    true = digest_of(forged.topic, RUN.messages[place].payload)
    monkeypatch.setattr(
        examiner_module,
        "digest_of",
        lambda topic, payload: true[:4] + bytes(12) if payload == forged.payload else digest_of(topic, payload),
    )
    said = found(changed(place, by=lambda _: [forged]))
    assert [(finding.kind, finding.who, finding.number) for finding in said.wrong] == [("chain", "node-n0", BLOCK)]


def test_who_computes_the_evidence_anew_is_not_found_but_by_the_heads() -> None:
    """Nothing is signed: only who wrote the heads down sees it."""
    place = place_of(estimate("n0"), 70)
    forged = recorded([flipped(message) if message is RUN.messages[place] else message for message in WIRE])
    assert found(forged) == Findings(len(WIRE), 0, (), (), ())
    assert [who for who in RUN.end if forged.end[who] != RUN.end[who]] == ["head.node-n0"]


def test_random_mutants_are_all_caught() -> None:
    chance = random.Random(2)
    for _ in range(60):
        place = chance.choice([i for i, message in enumerate(RUN.messages) if message.topic != EVIDENCE])
        message = RUN.messages[place]
        payload = bytearray(message.payload)
        payload[chance.randrange(len(payload))] ^= 1 << chance.randrange(8)
        forged = message._replace(payload=bytes(payload))
        said = found(changed(place, by=lambda _, forged=forged: [forged]))
        assert [(f.who, f.number, f.topic) for f in said.wrong] == [
            (sender_of(message.topic), message.number, message.topic)
        ]


# honest rewrites
def renumbered(key: Callable[[Logged], Any]) -> Run:
    """`sequence` counts anew, over all messages with the same key."""
    counts: dict[Any, int] = {}
    messages = []
    for message in RUN.messages:
        number = counts[key(message)] = counts.get(key(message), -1) + 1
        messages.append(message._replace(number=number))
    return RUN._replace(messages=messages)


REWRITES: dict[str, Run] = {
    "numbered over all": renumbered(lambda message: 0),
    "numbered by topic": renumbered(lambda message: message.topic),
    "numbered zero": RUN._replace(messages=[message._replace(number=0) for message in RUN.messages]),
    "sorted by topic": RUN._replace(messages=sorted(RUN.messages, key=lambda message: message.topic)),
    "evidence first": RUN._replace(messages=sorted(RUN.messages, key=lambda message: message.topic != EVIDENCE)),
    "shuffled": RUN._replace(messages=random.Random(3).sample(RUN.messages, len(RUN.messages))),
    "merged with itself": RUN._replace(messages=[message for message in RUN.messages for _ in range(2)]),
    "joined to itself": RUN._replace(messages=RUN.messages * 2),
    "joined to itself, numbered over all": RUN._replace(
        messages=[message._replace(number=place) for place, message in enumerate(RUN.messages * 2)]
    ),
}


@pytest.mark.parametrize("run", REWRITES.values(), ids=REWRITES.keys())
def test_rewritten_files_are_checked_in_full_and_accused_of_nothing(run: Run) -> None:
    said = found(run)
    assert (said.checked, said.total, said.absent) == (len(WIRE), 0, ())
    assert all("were rewritten" in sentence for sentence in said.unchecked)


HALF = len(RUN.messages) // 2
PIECES: dict[str, tuple[Run, str]] = {  # and what is said of each sender
    "first half": (Run(RUN.messages[:HALF], {}), "there is no evidence for"),
    "first half with the end": (Run(RUN.messages[:HALF], RUN.end), "there is no evidence for"),
    "first half, numbered by topic": (
        Run(renumbered(lambda m: m.topic).messages[:HALF], {}),
        "were rewritten",
    ),
    "second half": (Run(RUN.messages[HALF:], RUN.end), ""),
    "second half, numbered over all": (
        Run([message._replace(number=i) for i, message in enumerate(RUN.messages[HALF:])], RUN.end),
        "were rewritten",
    ),
    "without the plant": (Run([m for m in RUN.messages if m.topic != PLANT_STATE], RUN.end), ""),
    "one node alone": (Run([m for m in RUN.messages if m.topic in (estimate("n1"), EVIDENCE)], RUN.end), ""),
    "every third message": (Run(RUN.messages[::3], RUN.end), "there is no evidence for"),
    "without evidence": (Run(WIRE, RUN.end), "the recording has no evidence"),
    "evidence alone": (Run([m for m in RUN.messages if m.topic == EVIDENCE], RUN.end), ""),
    "nothing": (Run([], {}), "the recording has no evidence"),
}


@pytest.mark.parametrize(("run", "sentence"), PIECES.values(), ids=PIECES.keys())
def test_pieces_are_checked_as_far_as_their_evidence_goes_and_accused_of_nothing(run: Run, sentence: str) -> None:
    said = found(run)
    assert (said.total, said.wrong) == (0, ())
    there = [message for message in run.messages if message.topic != EVIDENCE]
    assert said.checked <= len(there)
    if sentence:
        assert said.unchecked
        assert any(sentence in words for words in said.unchecked)
    else:
        assert (said.checked, said.unchecked) == (len(there), ())


def test_a_flipped_message_is_found_in_rewritten_files_too() -> None:
    for name, run in REWRITES.items():
        messages = list(run.messages)
        place = next(
            i for i, message in enumerate(messages) if message.topic == estimate("n1") and step_of(message) == 9
        )
        messages[place] = flipped(messages[place])
        said = found(run._replace(messages=messages))
        assert [(f.kind, f.who, f.topic) for f in said.wrong] in (
            [("altered", "node-n1", estimate("n1"))],
            [("inserted", "node-n1", estimate("n1"))],  # where a true copy is there beside it
        ), name


def test_a_flipped_message_is_found_in_a_filtered_file_too() -> None:
    run = changed(place_of(measurement("n1"), 60), by=lambda them: [flipped(them[0])])
    said = found(run._replace(messages=[m for m in run.messages if m.topic not in (PLANT_STATE, measurement("n0"))]))
    assert [(f.kind, f.who, f.topic, f.step) for f in said.wrong] == [("altered", "plant", measurement("n1"), 60)]


def test_evidence_of_two_runs_accuses_nobody() -> None:
    other = recorded(flipped(message) for message in wire())
    said = found(Run([*RUN.messages, *other.messages], RUN.end))
    assert (said.total, said.checked) == (0, 0)
    assert said.unchecked == (f"the evidence is of two different runs for {2 * len(WIRE)} messages of 4 senders",)


def test_evidence_that_cannot_be_read_accuses_nobody() -> None:
    place = next(i for i, message in enumerate(RUN.messages) if message.topic == EVIDENCE)
    for payload in (b"", b"{}", RUN.messages[place].payload.replace(b'"digests":"', b'"digests":"z')):
        run = changed(place, by=lambda them, new=payload: [them[0]._replace(payload=new)])
        examiner = Examiner()
        for message in run.messages:
            examiner.take(message, 0)
        said = examiner.finish(run.end)
        assert said.total == 0
        assert said.unchecked[-1] == "1 message of evidence cannot be read"


# senders that give no digests
def test_a_sensor_without_digests_is_unchecked_and_said_to_be() -> None:
    run = recorded(wire(external=("n0",)), external=("n0",), silent=(sensor_who("n0"),))
    said = found(run, external=("n0",))
    assert said.total == 0
    assert said.unchecked == (f'there is no evidence for {STEPS} messages of sensor "n0"',)
    assert not any("sensor" in key for key in run.end)


def test_an_old_recording_has_no_evidence() -> None:
    said = found(Run(WIRE, {}))
    assert said == Findings(0, 0, (), (), ("no message is checked against its sender: the recording has no evidence",))


def test_very_long_recordings_without_evidence_need_no_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """And a sender without digests does not keep the others from being checked."""
    monkeypatch.setattr(examiner_module, "MOST", 340)
    monkeypatch.setattr(examiner_module, "OFTEN", 16)
    run = recorded(wire(external=("n0",)), external=("n0",), silent=(sensor_who("n0"),))
    examiner, most = Examiner(external=("n0",)), 0
    for message in run.messages:
        examiner.take(message, step_of(message))
        most = max(most, sum(sender.held for sender in examiner._senders.values()))
    said = examiner.finish(run.end)
    assert most <= 340 + 16
    evidence = sum(message.topic == EVIDENCE for message in run.messages)
    assert (said.checked, said.total) == (len(run.messages) - evidence - STEPS, 0)
    assert said.unchecked == (f'there is no evidence, or it stands too far away, for {STEPS} messages of sensor "n0"',)


# the recorder's side
def stamps(numbers: Iterable[int], who: str = "plant") -> list[Stamp]:
    return [Stamp(number, 0, who, digest_of("mode", b"%d" % number)) for number in numbers]


def blocks(chains: Chains, entered: Iterable[Stamp]) -> list[Evidence]:
    given = [chains.add(stamp, stamp.number) for stamp in entered]
    return [*filter(None, given), *chains.rest(last=True)]


def test_the_order_in_which_messages_come_changes_no_evidence() -> None:
    in_order = blocks(Chains(), stamps(range(200)))
    mixed = list(range(200))
    for start in range(0, 200, 10):
        mixed[start : start + 10] = random.Random(start).sample(mixed[start : start + 10], 10)
    assert "".join(e.digests for e in blocks(Chains(), stamps(mixed))) == "".join(e.digests for e in in_order)
    assert blocks(Chains(), stamps(mixed))[-1].head == in_order[-1].head


def test_a_gap_is_left_open() -> None:
    """A message that never came has no place in the evidence; what came after it has, at the end."""
    numbers = [*range(10), *range(12, 100), 2**62]
    given = blocks(Chains(), stamps(numbers))
    covered = [e.first + place for e in given for place in range(len(e.digests) // len(NO_DIGEST))]
    assert covered == numbers


def test_a_sender_that_gives_no_digests_has_no_evidence() -> None:
    bare = [stamp._replace(digest=b"") for stamp in stamps(range(200))]
    chains = Chains()
    assert blocks(chains, bare) == []
    assert chains.heads() == {}


def test_a_sender_that_gives_some_digests_has_evidence_for_these() -> None:
    given = blocks(Chains(), [s._replace(digest=b"") if s.number % 2 else s for s in stamps(range(4), node_who("a"))])
    assert len(given) == 1
    assert given[0].digests[8:16] == given[0].digests[24:] == NO_DIGEST
