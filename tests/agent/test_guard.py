"""What may come in, and each way in which a message may not fit; and a guard that lets one of them pass is found."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from itertools import chain
from typing import Any, NamedTuple

import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_recordings import observer_gains, random_gains, random_problem, real_problem, simulate

from agent.contract.files import canonical
from agent.contract.keys import ACCOUNT, COORDINATOR, EVENT, MODE, PLANT, PLANT_STATE, RECORDER, estimate, measurement
from agent.contract.messages import Acknowledged, Control, Stamp, Word, digest_of, tag_of
from agent.guard import (
    AHEAD,
    FLOOD,
    FORGED,
    INFINITE,
    KINDS,
    MISNUMBERED,
    MISSHAPEN,
    OVERSIZED,
    REPEATED,
    UNASKED,
    UNREADABLE,
    UNTIMELY,
    WINDOW,
    Guard,
    Unfit,
    in_words,
)
from agent.network.gate import Gate, admit
from agent.network.session import CAPACITY
from agent.network.words import Sample

GAINS = random_gains(random_problem(5, ny=(1, 2, 1), modes=2))
STEPS = 40
NOW = 10
WHO = (COORDINATOR, PLANT, "node-n0", "node-n1", "node-n2")


class Letter(NamedTuple):
    """A message on its way; `payload` as sent, or as a document."""

    topic: str
    payload: Any
    sender: str
    number: int = 10
    session: str = "own"  # of the sender; the true one is "session of <sender>"
    time: int = 5

    @property
    def sample(self) -> Sample:
        payload = self.payload if isinstance(self.payload, bytes) else json.dumps(self.payload).encode()
        if not self.sender:
            return Sample(self.topic, payload, None)
        session = f"session of {self.sender}" if self.session == "own" else self.session
        stamp = Stamp(self.number, self.time, self.sender, digest_of(self.topic, payload), tag_of(session))
        return Sample(self.topic, payload, stamp)


def guard(*, external: tuple[str, ...] = (), paced: bool = False) -> Guard:
    """Of somebody who is at step NOW of a run in which everybody is there."""
    made = Guard()
    made.know(GAINS.problem)
    for who in WHO:
        made.came(who, f"session of {who}")
    made.begin(steps=STEPS, external=external, paced=paced)
    made.now = NOW
    return made


def kind_of(made: Guard, letter: Letter, *, for_record: bool = False) -> str:
    """Why a message does not come in; "" where it does."""
    try:
        admit(made, letter.sample, for_record=for_record)
    except Unfit as unfit:
        return unfit.kind
    return ""


# messages that fit, one of each topic
ESTIMATE = {"step": 11, "x_hat": [0.1, 0.2], "innovation": [0.3], "z_hat": [0.4], "mode": "mode-0", "heard": ["n1"]}
STATE = {"step": 11, "x": [0.1, 0.2], "z": [0.1], "w": [0.1] * GAINS.problem.nw, "arrived": [1, 0, 1]}
TIMES = {f"to_{what}_{which}": 0.1 for what in ("estimate", "step") for which in ("median", "p99", "max")}
COUNTS = dict.fromkeys(("steps", "pairs", "pairs_substituted", "measurements_substituted", "late"), 1)
RIGHT = {
    "mode": Letter(MODE, {"step": 11, "mode": "mode-1", "index": 1}, COORDINATOR),
    "state": Letter(PLANT_STATE, STATE, PLANT),
    "y": Letter(measurement("n0"), {"step": 11, "y": [0.5]}, PLANT),
    "estimate": Letter(estimate("n0"), ESTIMATE, "node-n0"),
    "event": Letter(EVENT, {"step": 11, "kind": "stop", "who": COORDINATOR, "detail": ""}, COORDINATOR),
    "of another": Letter(EVENT, {"step": 11, "kind": "unrecorded", "who": RECORDER, "detail": ""}, COORDINATOR),
    "of a node": Letter(EVENT, {"step": 11, "kind": "late", "who": "node-n1", "detail": ""}, "node-n1"),
    "account": Letter(ACCOUNT, {"step": 11, "who": "node-n0"} | COUNTS | TIMES, "node-n0"),
}


def change(name: str, **changes: Any) -> Letter:
    return RIGHT[name]._replace(payload=RIGHT[name].payload | changes)


def sent(name: str, **changes: Any) -> Letter:
    return RIGHT[name]._replace(**changes)


NAN = float("nan")
LAWS: dict[str, tuple[str, Letter]] = {
    # not from who sends there
    "nobody's message": (FORGED, sent("estimate", sender="")),
    "a stranger's name": (FORGED, sent("estimate", sender="ghost")),
    "another node's name": (FORGED, sent("estimate", sender="node-n1")),
    "a sensor's name where there is none": (FORGED, sent("y", sender="sensor-n0")),
    "a measurement that nobody stamps where there is no sensor": (FORGED, sent("y", sender="")),
    "the right name and no session": (FORGED, sent("estimate", session="")),
    "the right name and a stranger's session": (FORGED, sent("mode", session="stranger")),
    "a node that speaks for another": (FORGED, sent("of a node", sender="node-n2")),
    "a node that speaks for the coordinator": (FORGED, sent("event", sender="node-n2")),
    "the coordinator that speaks for a node": (FORGED, sent("of a node", sender=COORDINATOR)),
    "an account of another node": (FORGED, sent("account", sender="node-n1")),
    # no message of the topic
    "nothing": (UNREADABLE, sent("estimate", payload=b"")),
    "garbage": (UNREADABLE, sent("mode", payload=b"\xff\x00garbage{")),
    "brackets": (UNREADABLE, sent("event", payload=b"[" * 5000)),
    "a message of another topic": (UNREADABLE, sent("y", payload=RIGHT["mode"].payload)),
    "a field that is missing": (UNREADABLE, sent("mode", payload={"step": 11})),
    "a number in quotes": (UNREADABLE, change("y", y=["0.5"])),
    "null": (UNREADABLE, change("y", y=[None])),
    "true for a number": (UNREADABLE, change("y", y=[True])),
    "a step that is no whole number": (UNREADABLE, change("y", step=11.5)),
    "a step before the first": (UNREADABLE, change("y", step=-1)),
    "a step beyond 63 bits": (UNREADABLE, change("mode", step=2**63)),
    # too long
    "a long mode": (OVERSIZED, change("mode", mode="m" * 1000)),
    "2 million numbers": (OVERSIZED, sent("y", payload=b'{"step":11,"y":[%s]}' % (b"0.1," * 2_000_000))),
    "a novel for an event": (OVERSIZED, change("event", detail="x" * 100_000)),
    "one more field, and a long one": (OVERSIZED, change("estimate", more="x" * 2000)),
    # other lengths, other names
    "two numbers for one": (MISSHAPEN, change("y", y=[0.1, 0.2])),
    "no number where losses are hidden": (MISSHAPEN, change("y", y=[])),
    "three states for two": (MISSHAPEN, change("estimate", x_hat=[0.1, 0.2, 0.3])),
    "two innovations for one": (MISSHAPEN, change("estimate", innovation=[0.1, 0.2])),
    "no output": (MISSHAPEN, change("estimate", z_hat=[])),
    "a node that does not exist": (MISSHAPEN, change("estimate", heard=["n9"])),
    "a node that is heard ten times": (MISSHAPEN, change("estimate", heard=["n1"] * 10)),
    "an origin that does not exist": (MISSHAPEN, change("estimate", origin="n9")),
    "a mode that made it that does not exist": (MISSHAPEN, change("estimate", mode="m")),
    "an unknown mode": (MISSHAPEN, change("mode", mode="evil", index=-1)),
    "a mode in another's place": (MISSHAPEN, change("mode", index=0)),
    "a state of another plant": (MISSHAPEN, change("state", x=[0.1])),
    "a measurement that half arrived": (MISSHAPEN, change("state", arrived=[1, 0, 2])),
    # not finite
    "NaN": (INFINITE, change("y", y=[NAN])),
    "infinity": (INFINITE, change("estimate", innovation=[float("inf")])),
    "1e999": (INFINITE, sent("y", payload=b'{"step":11,"y":[1e999]}')),
    "1e308": (INFINITE, change("y", y=[1e308])),
    "-1e141": (INFINITE, change("state", w=[-1e141, *STATE["w"][1:]])),  # type: ignore[index]
    # of a step that is not due
    "the step after the last": (UNTIMELY, change("y", step=STEPS)),
    "a step of another age": (UNTIMELY, change("estimate", step=2**63 - 1)),
    # numbers that cannot be
    "a number beyond all": (MISNUMBERED, sent("estimate", number=2**40)),
    "a number beyond 63 bits": (MISNUMBERED, sent("event", number=2**63)),
    "a time after all": (MISNUMBERED, sent("event", time=2**64 - 1)),
    # what nobody waits for
    "another topic": (UNASKED, Letter("foo", {}, PLANT)),
    "evidence": (UNASKED, Letter("evidence", {}, RECORDER)),
    "a node's topic that does not exist": (UNASKED, Letter(estimate("n9"), ESTIMATE, "node-n9")),
}


@pytest.mark.parametrize("letter", RIGHT.values(), ids=RIGHT)
@pytest.mark.parametrize("for_record", [False, True])
def test_what_fits_comes_in(letter: Letter, for_record: bool) -> None:
    assert kind_of(guard(), letter, for_record=for_record) == ""


@pytest.mark.parametrize(("kind", "letter"), LAWS.values(), ids=LAWS)
@pytest.mark.parametrize("for_record", [False, True])
def test_what_does_not_fit_is_refused(kind: str, letter: Letter, for_record: bool) -> None:
    """By nodes and the recorder alike, for the reason that is its own."""
    assert kind_of(guard(), letter, for_record=for_record) == kind


def test_every_message_of_a_run_fits_a_single_time() -> None:
    """Of networks of the paper and of others; whatever the guard holds against messages, honest ones do not have."""
    for gains in (GAINS, observer_gains(real_problem(5, ny=(1, 2, 1)))):
        made = Guard()
        made.know(gains.problem)
        made.begin(steps=STEPS, external=(), paced=False)
        for message in simulate(gains, steps=STEPS):
            made.came(message.who, f"session of {message.who}")
            made.now = message.document["step"]
            letter = Letter(message.topic, canonical(message.document), message.who, message.number)
            assert (kind_of(made, letter), kind_of(made, letter, for_record=True)) == ("", ""), letter
            assert kind_of(made, letter) == REPEATED


def test_what_is_far_ahead_is_refused_in_lock_step_alone() -> None:
    """There everybody is within the window; against the clock, somebody may have slept."""
    made = guard()
    for paced, kind in ((False, UNTIMELY), (True, "")):
        made.begin(steps=10**6, external=(), paced=paced)
        assert kind_of(made, change("y", step=NOW + AHEAD)._replace(number=1 + paced)) == ""
        assert kind_of(made, change("y", step=NOW + AHEAD + 1)._replace(number=3 + paced)) == kind


def test_a_sensor_may_measure_ahead_to_the_end_of_the_run() -> None:
    made = guard(external=("n0",))
    made.begin(steps=10**6, external=("n0",), paced=False)
    readings = [change("y", step=step)._replace(sender="") for step in (NOW + AHEAD + 1, 10**6 - 1, 10**6)]
    assert [kind_of(made, reading) for reading in readings] == ["", "", UNTIMELY]


def test_a_sensor_need_not_stamp_what_it_sends_but_says_it_once() -> None:
    """Two readings of a step, or two sensors of a node: the first one counts. The plant has nothing to say there."""
    for for_record in (False, True):
        made = guard(external=("n0",))
        readings = (change("y", step=step)._replace(sender="") for step in (12, 11, 12))
        assert [kind_of(made, letter, for_record=for_record) for letter in readings] == ["", "", REPEATED]
        assert kind_of(made, sent("y"), for_record=for_record) == FORGED
        assert kind_of(made, change("y", step=14)._replace(sender="sensor-n0", session="any")) == ""


def test_an_empty_measurement_is_a_loss_where_losses_are_seen() -> None:
    gains = observer_gains(real_problem(5, ny=(1, 2, 1)))
    made = Guard()
    made.know(gains.problem)
    for node in gains.problem.nodes:
        letter = Letter(measurement(node.name), {"step": 3, "y": []}, PLANT)
        assert kind_of(made, letter) == ("" if node.seen else MISSHAPEN)


def test_what_was_changed_on_its_way_is_not_recorded() -> None:
    """A replay would hold it against its sender, by the sender's digest."""
    sample = RIGHT["y"].sample
    changed = sample._replace(payload=sample.payload.replace(b"0.5", b"0.6"))
    with pytest.raises(Unfit, match=FORGED):
        admit(guard(), changed, for_record=True)


# numbers
def test_the_recorder_may_ask_for_what_it_has_already() -> None:
    assert [kind_of(guard(), RIGHT["estimate"], for_record=True) for _ in range(3)] == [""] * 3


@given(st.lists(st.integers(0, 3 * WINDOW), max_size=50), st.data())
def test_a_number_comes_in_once_in_any_order(numbers: list[int], data: Any) -> None:
    """Within the window; what is older than that may have been there."""
    made = guard()
    there: set[int] = set()
    for number in numbers:
        comes_in = kind_of(made, sent("estimate", number=number)) == ""
        assert comes_in == (number not in there and number > max(there, default=-1) - WINDOW)
        there |= {number}


def test_whoever_begins_again_may_use_numbers_again() -> None:
    """The recorder did not get the last ones of a process that was killed; its successor's session is another."""
    made = guard()
    assert kind_of(made, sent("estimate", number=30)) == ""
    made.went("node-n0", "session of node-n0")
    made.came("node-n0", "a new one")
    assert kind_of(made, sent("estimate", number=30, session="a new one")) == ""
    assert kind_of(made, sent("estimate", number=31)) == ""  # of the old one, on its way before it went
    assert kind_of(made, sent("estimate", number=31)) == REPEATED


# sessions
def test_of_two_sessions_the_first_one_counts_as_long_as_it_is_there() -> None:
    made = guard()
    assert not made.came(PLANT, "stranger")
    assert (kind_of(made, sent("y", session="stranger")), kind_of(made, RIGHT["y"])) == (FORGED, "")
    assert made.is_first(PLANT, f"session of {PLANT}")
    assert made.is_there(PLANT, "stranger")
    assert made.went(PLANT, "stranger") is None  # and nobody thinks that the plant has gone
    assert not made.came(PLANT, "stranger")
    assert not made.is_first(PLANT, "stranger")
    assert made.went(PLANT, f"session of {PLANT}") is False
    assert made.is_first(PLANT, "stranger")
    assert kind_of(made, sent("y", session="stranger", number=11)) == ""
    assert made.went(PLANT, "stranger")
    assert made.came(PLANT, "a third")


def test_whom_the_coordinator_has_begun_with_comes_first() -> None:
    """And whoever is not there is not believed for that."""
    made = guard()
    made.came(PLANT, "second")
    made.prefer({PLANT: "second", RECORDER: "a recorder that nobody has seen"})
    assert made.cast([PLANT, RECORDER]) == {PLANT: "second"}
    assert kind_of(made, sent("y", session="second")) == ""
    assert kind_of(made, RIGHT["y"]) == ""  # what it sent before still counts


STOP = Control(order="stop", steps=1, seed=0, window=1, external=[], reason="enough")


def word_kind(made: Guard, who: str, word: Word) -> str:
    try:
        made.admit_word(who, "control", word)
    except Unfit as unfit:
        return unfit.kind
    return ""


def test_a_word_is_from_its_sender_and_said_once() -> None:
    made = guard()
    own = f"session of {COORDINATOR}"
    for session, number, kind in (
        ("", 0, FORGED), ("stranger", 0, FORGED), (f"session of {PLANT}", 0, FORGED), (own, 3, ""), (own, 3, REPEATED),
        (own, 2, REPEATED), (own, 4, ""),
    ):  # fmt: skip
        word = STOP.model_copy(update={"session": session, "number": number})
        assert word_kind(made, COORDINATOR, word) == kind
    everything = Acknowledged(steps=1, messages=1, missing=0, received={}, reached={}, lacking=[], closed=True)
    assert word_kind(made, RECORDER, everything) == FORGED  # it has not shown its token
    assert word_kind(made, "ghost", everything) == FORGED


def test_a_stranger_among_the_cast_is_nobody() -> None:
    made = guard()
    assert (made.takes_part("ghost"), made.takes_part("sensor-n0"), made.takes_part("node-n2")) == (False, True, True)


# memory
class Full:
    """A channel with more in it than anybody wants."""

    def __init__(self, topic: str, samples: Iterator[Sample]) -> None:
        self.topic, self._samples = topic, samples

    def take(self) -> Sample | None:
        return next(self._samples, None)

    def next(self) -> Sample:
        return next(self._samples)


@pytest.mark.parametrize("session", ["stranger", "own"])
def test_a_flood_takes_no_more_memory_than_a_channel_has(session: str) -> None:
    """What is from nobody is not kept at all; of what is from its sender, no more than a channel holds."""
    made, total = guard(), 4 * CAPACITY
    flood = (change("estimate", step=k % STEPS)._replace(number=k, session=session).sample for k in range(total))
    gate = Gate(Full(estimate("n0"), flood), made, for_record=False)  # type: ignore[arg-type]  # as much as it uses
    while gate.relieve():
        pass
    kept = 0 if session == "stranger" else CAPACITY
    assert len(gate._kept) == kept
    assert made.refused() == {estimate("n0"): {FORGED if session == "stranger" else FLOOD: total - kept}}
    came = gate.waiting(2 * total)
    assert [each.stamp.number for each in came if each.stamp is not None] == list(range(kept))
    assert len(made._seen) == (session == "own")


def lost_of(made: Guard, *letters: Letter) -> tuple[str, int] | None:
    """What is lost for good where these come at a gate that is full."""
    before = (change("y", step=0)._replace(sender="").sample for _ in range(CAPACITY))
    channel = Full(measurement("n0"), chain(before, (letter.sample for letter in letters)))
    gate = Gate(channel, made, for_record=False)  # type: ignore[arg-type]  # as much as it uses
    while gate.relieve():
        pass
    return made.lost()


def reading(step: int, **changes: Any) -> Letter:
    """What a sensor sends."""
    return change("y", step=step, **changes)._replace(sender="")


def test_a_reading_that_finds_no_room_is_lost_where_the_run_needs_it() -> None:
    """A sensor gives it once; who is told of the first one knows which."""
    of_n0 = measurement("n0")
    assert lost_of(guard(external=("n0",)), reading(NOW + 7), reading(NOW + 6), reading(NOW + 8)) == (of_n0, NOW + 6)
    assert lost_of(guard(external=("n0",)), reading(STEPS - 1)) == (of_n0, STEPS - 1)
    assert lost_of(guard(external=("n0",)), reading(STEPS), reading(NOW - 1), reading(NOW, y=[1.0, 2.0])) is None
    assert lost_of(guard(external=("n0",), paced=True), reading(NOW + 7)) is None
    assert lost_of(guard(), change("y", step=NOW + 7)) is None  # the plant keeps it


def test_what_found_no_room_before_the_run_is_known_to_be_lost_when_it_begins() -> None:
    for external, lost in (((), None), (("n0",), (measurement("n0"), 6))):
        made = Guard()
        made.know(GAINS.problem)
        assert lost_of(made, reading(7), reading(6)) is None
        made.begin(steps=6, external=external, paced=False)
        assert made.lost() is None
        made.begin(steps=7, external=external, paced=False)
        assert made.lost() == lost


def test_a_flood_of_topics_names_and_sessions_takes_no_memory() -> None:
    """Whatever a stranger makes up, there is one counter for all of it."""
    made = guard(external=("n1",))
    sizes = {name: len(kept) for name, kept in vars(made).items() if isinstance(kept, dict)}
    for k in range(2000):
        for letter in (
            Letter(f"topic-{k}", {}, f"who-{k}"),
            sent("event", sender=f"who-{k}"),
            sent("estimate", session=f"session-{k}"),
            sent(
                "y", topic=measurement("n1"), payload={"step": 11, "y": [0.1, 0.2]}, sender="sensor-n1", session=f"{k}"
            ),
        ):
            try:
                admit(made, letter.sample, for_record=True)
            except Unfit as unfit:
                made.refuse(letter.topic, unfit.kind)
            if letter.topic == measurement("n1"):
                made.first_time(letter.topic, 11, letter.sample.stamp)
        assert word_kind(made, COORDINATOR, STOP.model_copy(update={"session": f"session-{k}"})) == FORGED
    grown = {name: len(kept) - sizes[name] for name, kept in vars(made).items() if isinstance(kept, dict)}
    assert max(grown.values()) <= 3, grown
    assert made.refused()["other"] == {UNASKED: 2000}


# a guard that sleeps
Sleep = Callable[[pytest.MonkeyPatch], None]


def never(name: str, result: Any = None) -> Sleep:
    def put_to_sleep(monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(Guard, name, lambda *_, **__: result)

    return put_to_sleep


def passes(kind: str) -> Sleep:
    """It lets one kind pass: whoever raises Unfit for it goes on."""

    def put_to_sleep(monkeypatch: pytest.MonkeyPatch) -> None:
        real = admit.__globals__["admit"]

        def lax(made: Guard, sample: Sample, *, for_record: bool) -> Any:
            try:
                return real(made, sample, for_record=for_record)
            except Unfit as unfit:
                if unfit.kind != kind:
                    raise
            return None

        monkeypatch.setitem(globals(), "admit", lax)

    return put_to_sleep


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind not in (REPEATED, FLOOD)])
def test_a_guard_that_lets_one_kind_pass_is_found(monkeypatch: pytest.MonkeyPatch, kind: str) -> None:
    passes(kind)(monkeypatch)
    assert {wanted for wanted, letter in LAWS.values() if kind_of(guard(), letter) != wanted} == {kind}


@pytest.mark.parametrize(
    ("asleep", "kinds"),
    [
        (never("_fit"), {MISSHAPEN, INFINITE, FORGED}),
        (never("_read"), {MISSHAPEN, FORGED}),
    ],
)
def test_a_guard_that_does_not_look_is_found(monkeypatch: pytest.MonkeyPatch, asleep: Sleep, kinds: set[str]) -> None:
    asleep(monkeypatch)
    missed = {wanted for wanted, letter in LAWS.values() if kind_of(guard(), letter) != wanted}
    assert missed == kinds


def test_what_was_refused_is_said_in_the_order_of_the_kinds() -> None:
    assert in_words({REPEATED: 1, FORGED: 3}) == "3 forged, 1 repeated"
