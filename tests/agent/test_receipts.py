"""The ledger's account depends on what came, not on when; what is missing is counted and named."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_recordings import random_gains, random_problem, simulate

from agent.contract.messages import Stamp
from agent.receipts import Ledger

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


def filled(entries: list[Entry]) -> Ledger:
    ledger = Ledger(PROBLEM)
    for entry in entries:
        ledger.take(*entry)
    return ledger


def account(ledger: Ledger) -> tuple[object, ...]:
    missing = {sender: ledger.missing(sender) for sender in SENDERS}
    return (
        ledger.complete,
        ledger.messages,
        {sender: count for sender, count in ledger.received.items() if count},
        ledger.reached,
        missing,
        ledger.lacking(),
    )


def test_a_whole_run_is_complete() -> None:
    ledger = filled(ENTRIES)
    assert ledger.complete == STEPS
    assert ledger.received == SENDERS
    assert ledger.reached == dict.fromkeys(SENDERS, STEPS - 1)
    assert ledger.messages == len(ENTRIES)
    assert all(ledger.missing(sender) == 0 for sender in SENDERS)


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
    ledger, there = filled(entries), set(entries)
    whole = [all(entry in there for entry in ENTRIES if entry[1] == k and entry[0] != "event") for k in range(STEPS)]
    assert ledger.complete == [*whole, False].index(False)
    for sender in SENDERS:
        numbers = {stamp.number for _, _, stamp in there if stamp.sender == sender}
        prefix = next(number for number in range(len(ENTRIES)) if number not in numbers)
        assert ledger.received.get(sender, 0) == prefix
        assert ledger.missing(sender) == (max(numbers) + 1 - len(numbers) if numbers else 0)
        steps = [step for _, step, stamp in there if stamp.sender == sender]
        assert ledger.reached.get(sender) == max(steps, default=None)
    has = {topic for topic, step, _ in there if step == ledger.complete}
    assert set(ledger.lacking()) == {topic for topic, _, _ in ENTRIES if topic != "event"} - has


def test_a_duplicate_is_not_recorded_again() -> None:
    ledger = Ledger(PROBLEM)
    assert [ledger.take(*ENTRIES[0]) for _ in range(3)] == [True, False, False]
    assert ledger.messages == 1


def test_a_duplicate_of_what_came_early_is_not_recorded_again() -> None:
    ledger = Ledger(PROBLEM)
    early = ("mode", 4, Stamp(4, 0, "coordinator"))
    assert [ledger.take(*early) for _ in range(2)] == [True, False]


@pytest.mark.parametrize("number", [0, 2, 5])
def test_a_gap_is_found_and_filled(number: int) -> None:
    whole = [entry for entry in ENTRIES if entry[2].sender == "node-n1"]
    ledger = filled([entry for entry in whole if entry[2].number != number])
    last = number == len(whole) - 1
    assert ledger.missing("node-n1") == (0 if last else 1)  # the end of a sender's messages is not known
    assert ledger.received.get("node-n1", 0) == number
    ledger.take(*whole[number])
    assert ledger.missing("node-n1") == 0
    assert ledger.received["node-n1"] == len(whole)


def test_lacking_names_what_keeps_the_step_incomplete_in_the_order_in_which_it_comes_about() -> None:
    order = [
        "mode",
        "plant/state",
        "node/n0/measurement",
        "node/n1/measurement",
        "node/n0/estimate",
        "node/n1/estimate",
    ]
    assert Ledger(PROBLEM).lacking() == order
    ledger = filled([entry for entry in ENTRIES if entry[:2] not in {("node/n1/estimate", 2), ("node/n0/estimate", 4)}])
    assert ledger.complete == 2
    assert ledger.lacking() == ["node/n1/estimate"]


def test_a_sensor_without_stamps_counts_for_its_steps() -> None:
    """It has no numbers, so its gaps show by the steps alone."""
    ledger = Ledger(PROBLEM)
    for topic, step, stamp in ENTRIES:
        ledger.take(topic, step, None if topic == "node/n1/measurement" else stamp)
    assert ledger.complete == STEPS
    assert ledger.reached["sensor of node/n1/measurement"] == STEPS - 1
    assert ledger.messages == len(ENTRIES)


def test_events_complete_no_step() -> None:
    ledger = filled([("event", 0, Stamp(number, 0, "coordinator")) for number in range(10)])
    assert ledger.complete == 0
    assert ledger.messages == 10
