"""The recorder's receipts depend on what came, not on when; what is missing is counted and named."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_recordings import random_gains, random_problem, simulate

from agent.contract.messages import Stamp
from agent.receipts import Receipts

STEPS = 6
PROBLEM = random_problem(3, ny=(1, 2), modes=2)
Entry = tuple[str, int, Stamp]
ENTRIES: list[Entry] = [
    (sent.topic, sent.document["step"], Stamp(sent.number, 0, sent.who))
    for sent in simulate(random_gains(PROBLEM), steps=STEPS)
]
SENDERS = {
    "coordinator": STEPS + 2,  # a mode for every step, two events
    "plant": 3 * STEPS,  # the state and two measurements
    "node-n0": STEPS,
    "node-n1": STEPS,
}


def filled(entries: list[Entry]) -> Receipts:
    receipts = Receipts(PROBLEM)
    for entry in entries:
        receipts.take(*entry)
    return receipts


def account(receipts: Receipts) -> tuple[object, ...]:
    missing = {sender: receipts.missing(sender) for sender in SENDERS}
    return (
        receipts.complete,
        receipts.messages,
        {sender: count for sender, count in receipts.received.items() if count},
        receipts.reached,
        missing,
        receipts.lacking(),
    )


def test_a_whole_run_is_complete() -> None:
    receipts = filled(ENTRIES)
    assert receipts.complete == STEPS
    assert receipts.received == SENDERS
    assert receipts.reached == dict.fromkeys(SENDERS, STEPS - 1)
    assert receipts.messages == len(ENTRIES)
    assert all(receipts.missing(sender) == 0 for sender in SENDERS)


@given(st.permutations(ENTRIES))
def test_any_order_of_arrival_gives_the_same_account(entries: list[Entry]) -> None:
    assert account(filled(entries)) == account(filled(ENTRIES))


@given(st.lists(st.sampled_from(ENTRIES), max_size=80))
def test_what_is_there_counts_once_whatever_the_order(entries: list[Entry]) -> None:
    """Any part of a run, in any order, with any duplicates: as its entries once, in the order of the run."""
    assert account(filled(entries)) == account(filled([entry for entry in ENTRIES if entry in entries]))


@given(st.lists(st.sampled_from(ENTRIES), max_size=80))
def test_the_account_is_true(entries: list[Entry]) -> None:
    """Against the plain definitions: prefixes without a gap, steps of which all is there, the first lack."""
    receipts, there = filled(entries), set(entries)
    whole = [all(entry in there for entry in ENTRIES if entry[1] == k and entry[0] != "event") for k in range(STEPS)]
    assert receipts.complete == [*whole, False].index(False)
    for sender in SENDERS:
        numbers = {stamp.number for _, _, stamp in there if stamp.sender == sender}
        prefix = next(number for number in range(len(ENTRIES)) if number not in numbers)
        assert receipts.received.get(sender, 0) == prefix
        assert receipts.missing(sender) == (max(numbers) + 1 - len(numbers) if numbers else 0)
        steps = [step for _, step, stamp in there if stamp.sender == sender]
        assert receipts.reached.get(sender) == max(steps, default=None)
    has = {topic for topic, step, _ in there if step == receipts.complete}
    assert set(receipts.lacking()) == {topic for topic, _, _ in ENTRIES if topic != "event"} - has


def test_a_duplicate_is_not_recorded_again() -> None:
    receipts = Receipts(PROBLEM)
    assert [receipts.take(*ENTRIES[0]) for _ in range(3)] == [True, False, False]
    assert receipts.messages == 1


def test_a_duplicate_of_what_came_early_is_not_recorded_again() -> None:
    receipts = Receipts(PROBLEM)
    early = ("mode", 4, Stamp(4, 0, "coordinator"))
    assert [receipts.take(*early) for _ in range(2)] == [True, False]


@pytest.mark.parametrize("number", [0, 2, 5])
def test_a_gap_is_found_and_filled(number: int) -> None:
    whole = [entry for entry in ENTRIES if entry[2].sender == "node-n1"]
    receipts = filled([entry for entry in whole if entry[2].number != number])
    last = number == len(whole) - 1
    assert receipts.missing("node-n1") == (0 if last else 1)  # the end of a sender's messages is not known
    assert receipts.received.get("node-n1", 0) == number
    receipts.take(*whole[number])
    assert receipts.missing("node-n1") == 0
    assert receipts.received["node-n1"] == len(whole)


def test_lacking_names_what_keeps_the_step_incomplete_in_the_order_in_which_it_comes_about() -> None:
    order = [
        "mode",
        "plant/state",
        "node/n0/measurement",
        "node/n1/measurement",
        "node/n0/estimate",
        "node/n1/estimate",
    ]
    assert Receipts(PROBLEM).lacking() == order
    receipts = filled(
        [entry for entry in ENTRIES if entry[:2] not in {("node/n1/estimate", 2), ("node/n0/estimate", 4)}]
    )
    assert receipts.complete == 2
    assert receipts.lacking() == ["node/n1/estimate"]


def test_a_sensor_without_stamps_counts_for_its_steps() -> None:
    """It has no numbers, so its gaps show by the steps alone."""
    receipts = Receipts(PROBLEM)
    for topic, step, stamp in ENTRIES:
        receipts.take(topic, step, None if topic == "node/n1/measurement" else stamp)
    assert receipts.complete == STEPS
    assert receipts.reached["sensor of node/n1/measurement"] == STEPS - 1
    assert receipts.messages == len(ENTRIES)


def test_events_complete_no_step() -> None:
    receipts = filled([("event", 0, Stamp(number, 0, "coordinator")) for number in range(10)])
    assert receipts.complete == 0
    assert receipts.messages == 10


def test_modes_that_are_given_again_are_not_missing() -> None:
    """They come under new numbers; one that was there after all is a copy, and its number stands for nothing."""

    def mode(number: int, step: int) -> bool:
        return receipts.take("mode", step, Stamp(number, 0, "coordinator"))

    receipts = Receipts(PROBLEM, paced=True)
    for number in (0, 1, 4):
        assert mode(number, number)
    receipts.close_gap("coordinator")
    assert (receipts.missing("coordinator"), receipts.void["coordinator"]) == (2, {2, 3})
    assert receipts.received["coordinator"] == 5
    for number, step in ((5, 2), (6, 3), (7, 4), (8, 5)):
        assert mode(number, step)
    assert (receipts.missing("coordinator"), receipts.void["coordinator"]) == (0, {2, 3, 7})
    assert receipts.complete == 6


def test_a_gap_that_is_closed_counts_once() -> None:
    receipts = Receipts(PROBLEM, paced=True)
    for number in (0, 2):
        receipts.take("event", 0, Stamp(number, 0, "node-n0"))
    receipts.close_gap("node-n0")
    receipts.take("event", 0, Stamp(5, 0, "node-n0"))
    receipts.close_gap("node-n0")
    assert receipts.missing("node-n0") == 3
    assert receipts.void["node-n0"] == {1, 3, 4}


def test_what_a_sender_could_not_keep_is_lost_and_nothing_after_it() -> None:
    """Its oldest message is number 5; of what came early from there on, what is missing is still on its way."""
    receipts = Receipts(PROBLEM, paced=True)
    for number in (0, 3, 6, 9):
        receipts.take("mode", number, Stamp(number, 0, "coordinator"))
    assert receipts.complete == 1
    receipts.close_gap("coordinator", below=5)
    assert receipts.void["coordinator"] == {1, 2, 4}
    assert (receipts.received["coordinator"], receipts.lost["coordinator"]) == (5, 3)
    assert receipts.missing("coordinator") == 3 + 3
    assert receipts.complete == 4  # modes before that, nobody gives again
    for number in (5, 7, 8):
        receipts.take("mode", number, Stamp(number, 0, "coordinator"))
    assert (receipts.missing("coordinator"), receipts.received["coordinator"]) == (3, 10)
    receipts.close_gap("coordinator", below=8)
    assert receipts.lost["coordinator"] == 3
