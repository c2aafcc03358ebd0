"""The ledger of a run that is looked on at says at every step what a ledger says that knows all of it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_recordings import Sent, record
from paced_runs import PACE, SOON, PacedRun
from places import ROOT

from agent.contract import keys
from agent.contract.gains import Gains
from agent.contract.messages import Control, Estimate, Event, Message, Mode
from agent.contract.problem import Problem
from designer.ledger.deviation import Deviation
from designer.ledger.exact import Ledger
from designer.ledger.promise import Promise
from designer.replay import proofs
from designer.replay.central import Central
from designer.replay.coupling import Coupling
from designer.replay.inputs import draw, logged_inputs
from designer.replay.log import load
from designer.replay.promise import faults_of
from designer.watch import book as module
from designer.watch.book import LAG, Asked, Book

GAINS = Gains.load(ROOT / "recordings" / "golden" / "zhu2020-lossy.gains.json")
STEPS, SEED = 60, 1
NAMES = GAINS.problem.node_names


def facts(**more: Any) -> Control:
    """The order that a paced run starts by."""
    known = {"order": "start", "steps": STEPS, "seed": SEED, "window": 32, "external": [], "reason": ""}
    return Control(**(known | {"period": PACE.period, "measure_by": 0.4, "hear_by": 0.8} | more))


def read(sent: Sent) -> Message:
    model = keys.model_of(sent.topic)
    assert model is not None
    return model(**sent.document)


def told(
    messages: Iterable[Sent], start: Control | None = None, *, gains: Gains = GAINS
) -> tuple[Book, dict[int, Promise]]:
    """A book that has heard these messages, and what it said of each step that it settled."""
    start = start or facts()
    book = Book(gains, start, Asked(gains.problem, seed=start.seed))
    there, said = set(NAMES), dict[int, Promise]()
    for sent in messages:
        match message := read(sent):
            case Mode():
                book.mode(message.step, message.mode)
            case Estimate():
                there.add(sent.topic.split("/")[1])
                book.estimate(sent.topic.split("/")[1], message)
            case Event(kind="gone", who="coordinator", about=who):
                there.discard(who.partition("-")[2])
        settle_one_by_one(book, there, said)
    return book, said


def settle_one_by_one(book: Book, there: set[str], said: dict[int, Promise]) -> None:
    while True:
        before, enough = book._next, iter((False, True))  # one step is enough
        book.settle(there, enough.__next__)
        if book._next == before:
            return
        if book.promise is not None:
            said[book.at] = book.promise


def causal(failed: Any, asked: Any) -> Any:
    """A pair that nobody asked for is as when it was asked for last, before; what comes later is not known yet."""
    out, last = np.zeros_like(failed), np.zeros_like(failed[0])
    for k in range(len(failed)):
        last = np.where(asked[k], failed[k], last)
        out[k] = last
    return out


def faults(folder: Path, messages: list[Sent], monkeypatch: pytest.MonkeyPatch) -> dict[int, Deviation]:
    """What a replay of the same messages tells its ledger, but for what it knows only afterwards."""
    monkeypatch.setattr(import_module("designer.replay.promise"), "_filled", causal)
    log = load(record(folder / "run.mcap", GAINS, messages, steps=STEPS, period=str(PACE.period)))
    central = Central.of(GAINS)
    drawn = draw(log, central)
    hears = proofs.to_be_heard(log, central, drawn)
    return faults_of(Coupling.of(log, central, logged_inputs(log, central, drawn), drawn, hears), hears)


def late(receiver: str, topic: str, step: int) -> float:
    """Every seventh message of some topics comes too late to be used, or never."""
    if topic == "mode" or (int(receiver) + 3 * len(topic) + 2 * step) % 7:
        return SOON
    return math.inf if step % 2 else 0.05


RUNS: dict[str, dict[str, Any]] = {
    "nothing": {},
    "a node away": {"away": {"1": range(20, 27)}},
    "two nodes away": {"away": {"1": range(20, 27), "3": range(24, 30)}},
    "the plant away": {"away": {"plant": range(20, 24)}},
    "a node frozen": {"frozen": {"2": range(20, 26)}},
    "one link": {
        "delay": lambda receiver, topic, step: math.inf if (receiver, topic) == ("4", "node/2/estimate") else SOON
    },
    "late": {"delay": late},
}
BEYOND_GAMMA = ("a node away", "two nodes away", "the plant away", "late")


@pytest.mark.parametrize("what", RUNS)
def test_it_says_what_a_ledger_says_that_knows_the_whole_run(
    what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    messages = PacedRun(GAINS, steps=STEPS, seed=SEED, **RUNS[what]).messages
    book, said = told(messages)
    known, whole = faults(tmp_path, messages, monkeypatch), Ledger.of(GAINS)
    assert bool(known) == (what != "nothing")
    assert sorted(said) == list(range(STEPS - LAG))
    assert book.since == 0
    for k in range(STEPS - LAG):
        whole.tell(known.get(k, Deviation()))
        assert said[k] == whole.promise(), (what, k)
        whole.step()
    assert (max(promise.factor for promise in said.values()) > 1.01) == (what in BEYOND_GAMMA)


def test_who_comes_late_says_so_until_what_was_before_has_faded() -> None:
    messages = PacedRun(GAINS, steps=STEPS, seed=SEED).messages
    book, said = told(sent for sent in messages if sent.document["step"] >= 10)
    assert book.since == 10
    (owed,) = said[10].owed
    assert (owed.what, owed.is_unit) == ("what was there at step 10", True)
    assert said[10].status == "valid plus"
    assert said[10 + owed.within].status == said[STEPS - 1 - LAG].status == "valid"  # type: ignore[operator]
    assert [turn.promise.status for turn in book.turns] == ["valid plus", "valid"]


def test_what_was_there_before_is_bounded_by_its_term() -> None:
    """From any state at step 10, in the mean over what comes: here of the states that make most of each later step."""
    messages = PacedRun(GAINS, steps=STEPS, seed=SEED).messages
    _, said = told(sent for sent in messages if sent.document["step"] >= 10)
    ledger = Ledger.of(GAINS)
    model = ledger.models.designed
    names = GAINS.problem.mode_names
    mode = next(sent.document["mode"] for sent in messages if (sent.topic, sent.document["step"]) == ("mode", 10))
    Y = np.array(model.MM)
    for later in range(20):
        largest = math.sqrt(float(np.linalg.eigvalsh(Y[names.index(mode)]).max()))
        if said[10 + later].owed:
            assert largest <= said[10 + later].owed[0].size * (1.0 + 1e-9), later
        Y = model.corner(Y)


@pytest.mark.parametrize(
    "topic", ["mode", "node/2/estimate"], ids=["a mode", "an estimate"]
)  # of a node that has gone on: so this one was missed here
def test_after_a_message_that_was_not_heard_here_it_begins_anew(topic: str) -> None:
    messages = PacedRun(GAINS, steps=STEPS, seed=SEED).messages
    book, said = told(sent for sent in messages if (sent.topic, sent.document["step"]) != (topic, 30))
    assert book.since == 31
    assert sorted(said) == [k for k in range(STEPS - LAG) if k != 30]
    assert said[29].status == "valid"
    assert said[31].owed[0].what == "what was there at step 31"


def test_a_node_that_was_taken_to_be_absent_and_was_not_makes_it_begin_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    """It stood still for longer than anybody waits, and then made up for every step."""
    monkeypatch.setattr(module, "PATIENCE", 0.5)
    messages = PacedRun(GAINS, steps=STEPS, seed=SEED, frozen={"2": range(20, 40)}).messages
    book, said = told(messages)
    assert said[30].status in ("valid", "valid plus")  # without the node
    assert 35 <= book.since <= 41
    assert said[book.since].owed[0].what == f"what was there at step {book.since}"


@pytest.mark.parametrize("external", [["1"], list(NAMES)], ids=["a sensor", "no plant"])
def test_a_real_plant_began_anywhere(external: list[str]) -> None:
    _, said = told(PacedRun(GAINS, steps=STEPS, seed=SEED).messages, facts(external=external))
    assert said[0].owed[0].what == "the initial error, which is not known"
    assert said[STEPS - 1 - LAG].status == "valid"


def outside(messages: Iterable[Sent], step: int, mode: str) -> Iterator[Sent]:
    """With another mode at this step; and an estimate of later is missed, after which nobody knows any better."""
    for sent in messages:
        place = sent.topic, sent.document["step"]
        if place == ("mode", step):
            yield sent._replace(document=sent.document | {"mode": mode})
        elif place != ("node/2/estimate", 45):
            yield sent


def test_a_mode_outside_the_chain_makes_it_void_for_good() -> None:
    book, said = told(outside(PacedRun(GAINS, steps=STEPS, seed=SEED).messages, 30, "5"))
    assert said[29].status == "valid"
    assert (said[30].status, said[30].step, said[30].reason) == ("void", 30, 'mode "5" is none of the chain')
    assert book.promise == said[30]


def test_a_transition_that_the_chain_does_not_have_makes_it_void() -> None:
    messages = PacedRun(GAINS, steps=STEPS, seed=SEED).messages
    modes = {sent.document["step"]: sent.document["mode"] for sent in messages if sent.topic == "mode"}
    document = GAINS.problem.document()
    before, row = modes[29], int(modes[29]) - 1
    gone = {modes[k + 1] for k in range(29) if modes[k] == before}
    other = next(mode for mode in "1234" if mode not in gone | {before})
    chances = document["markov"]["transition"][row]
    chances[row] += chances[int(other) - 1]
    chances[int(other) - 1] = 0.0
    problem = Problem.from_document(document)
    gains = GAINS.model_copy(update={"problem": problem, "problem_digest": problem.digest()})
    _, said = told(outside(messages, 30, other), gains=gains)
    assert said[30].status == "void"
    assert said[30].reason == f'the chain never goes from mode "{before}" to "{other}"'


def full() -> Book:
    """One that has heard a whole run, and settled nothing."""
    book = Book(GAINS, facts(), Asked(GAINS.problem, seed=SEED))
    for sent in PacedRun(GAINS, steps=STEPS, seed=SEED).messages:
        message = read(sent)
        if isinstance(message, Mode):
            book.mode(message.step, message.mode)
        elif isinstance(message, Estimate):
            book.estimate(sent.topic.split("/")[1], message)
    return book


def test_it_stops_when_it_is_enough_and_goes_on_later() -> None:
    book = full()
    book.settle(NAMES, iter([False] * 5 + [True]).__next__)
    assert book.at == 4
    book.settle(NAMES)
    assert (book.at, book.since) == (STEPS - 1 - LAG, 0)


def test_what_it_is_too_slow_for_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """So what waits is bounded; and it says from where on it has seen all."""
    monkeypatch.setattr(module, "BACKLOG", 20)
    book = full()
    book.settle(NAMES, iter([False] * 5 + [True]).__next__)
    assert book.at == 4
    book.settle(NAMES, lambda: True)
    assert book.promise is None
    assert max(len(told) for told in book._told) <= LAG + 1
    book.settle(NAMES)
    assert book.since == book.at == STEPS - 1 - LAG


@pytest.mark.parametrize("heard_until", [0, 15], ids=["never", "no more"])
def test_what_waits_for_somebody_who_cannot_be_heard_is_bounded(
    monkeypatch: pytest.MonkeyPatch, heard_until: int
) -> None:
    """In lock-step nobody may be taken to be absent who is there."""
    monkeypatch.setattr(module, "MOST", 20)
    book = Book(GAINS, facts(period=0.0), Asked(GAINS.problem, seed=SEED))
    for sent in PacedRun(GAINS, steps=STEPS, seed=SEED).messages:
        message = read(sent)
        if isinstance(message, Mode):
            book.mode(message.step, message.mode)
        elif isinstance(message, Estimate) and (sent.topic != "node/4/estimate" or message.step < heard_until):
            book.estimate(sent.topic.split("/")[1], message)
        book.settle(NAMES)
        assert max(map(len, [book._modes, *book._told])) <= 20 + LAG
    assert book.promise is None


def test_a_gain_that_is_too_large_just_now_is_not_void_for_good(monkeypatch: pytest.MonkeyPatch) -> None:
    """Only what no model describes is."""
    messages = PacedRun(GAINS, steps=STEPS, seed=SEED, **RUNS["the plant away"]).messages
    largest = max(promise.factor for promise in told(messages)[1].values())
    monkeypatch.setattr("designer.ledger.exact.VOID_ABOVE", 1.0 + 0.5 * (largest - 1.0))
    _, said = told(messages)
    assert "void" in {promise.status for promise in said.values()}
    assert said[STEPS - 1 - LAG].status == "valid"
