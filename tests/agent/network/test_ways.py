"""A message says where it spent its time, where it is asked to."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import closing

import pytest

from agent.contract.keys import COORDINATOR, MODE, PLANT
from agent.contract.messages import Stamp
from agent.network.arrivals import Arrival, Arrivals, way
from agent.network.configuration import Network
from agent.network.outbox import Sent
from agent.network.session import Session
from agent.network.words import Sample

PATIENCE = 60.0


@pytest.fixture
def sessions() -> Iterator[tuple[Session, Arrivals[Sample]]]:
    """A publisher, and what arrives elsewhere."""
    with closing(Session(Network(), run="test", who=COORDINATOR, hand_over=lambda duty: None)) as sender:
        sender.advertise(MODE, express=False)
        network = Network(connect=tuple(sender.locators()))
        with closing(Session(network, run="test", who=PLANT, hand_over=lambda duty: None)) as receiver:
            yield sender, Arrivals([receiver.channel(MODE).next])


def next_arrival(sender: Session, arrivals: Arrivals[Sample]) -> Arrival[Sample]:
    """What arrives first of what is sent again and again, until somebody listens."""
    deadline = time.monotonic() + PATIENCE
    while time.monotonic() < deadline:
        sender.publish(Sent(MODE, b"one", Stamp(0, 0, COORDINATOR)))
        for arrival in arrivals.until(time.monotonic() + 0.1):
            return arrival
    raise AssertionError("nothing arrived")


def test_a_traced_message_says_where_it_spent_its_time(sessions: tuple[Session, Arrivals[Sample]]) -> None:
    """All of it since it was sent, and no more: sender and receiver have one clock here."""
    sender, arrivals = sessions
    sender.traced = True
    began = time.monotonic()
    arrival = next_arrival(sender, arrivals)
    spent = way(*arrival)
    assert spent is not None
    assert all(seconds >= -0.001 for seconds in spent)  # the clock of a trace has microseconds
    assert sum(spent) <= arrival.at - began + 0.001


def test_one_that_is_not_traced_does_not(sessions: tuple[Session, Arrivals[Sample]]) -> None:
    assert way(*next_arrival(*sessions)) is None
