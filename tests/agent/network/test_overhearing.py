"""Whoever overhears a run hears what was published, and holds up nobody."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing

import pytest

from agent.contract.keys import MODE, PLANT_STATE
from agent.contract.messages import Stamp
from agent.network.configuration import Network
from agent.network.outbox import Sent
from agent.network.session import Session

PATIENCE = 60.0
LISTENER = """
import sys
from agent.network.configuration import Network
from agent.network.session import Session
session = Session(Network(connect=(sys.argv[1],)), run="test", who="viewer", hand_over=lambda duty: None)
overheard = session.overhear()
while True:
    sample = overheard.next()
    print(sample.topic, sample.payload.decode(), flush=True)
"""


@pytest.fixture
def publisher() -> Iterator[Session]:
    with closing(Session(Network(), run="test", who="plant", hand_over=lambda duty: None)) as session:
        for topic in (MODE, PLANT_STATE):
            session.advertise(topic, express=False)
        yield session


@pytest.fixture
def listener(publisher: Session) -> Iterator[subprocess.Popen[str]]:
    """A process of its own that overhears, and is known to the publisher."""
    words = [sys.executable, "-c", LISTENER, publisher.locators()[0]]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as process:
        try:
            deadline = time.monotonic() + PATIENCE
            while not all(publisher._watched.values()):
                assert time.monotonic() < deadline
                time.sleep(0.01)
            yield process
        finally:
            process.kill()


def publish(session: Session, topic: str, payload: bytes) -> None:
    session.publish(Sent(topic, payload, Stamp(0, 0, "test")))


def test_it_hears_every_topic_from_when_it_is_there(publisher: Session, listener: subprocess.Popen[str]) -> None:
    publish(publisher, MODE, b"one")
    publish(publisher, PLANT_STATE, b"two")
    assert listener.stdout is not None
    assert sorted(listener.stdout.readline() for _ in range(2)) == [f"{MODE} one\n", f"{PLANT_STATE} two\n"]


def test_one_that_stands_still_holds_up_nobody(publisher: Session, listener: subprocess.Popen[str]) -> None:
    """With more than all buffers between hold: a publisher that waits for its listeners would wait 5 s."""
    os.kill(listener.pid, signal.SIGSTOP)
    began = time.monotonic()
    for _ in range(4000):
        publish(publisher, MODE, bytes(4000))
    assert time.monotonic() - began < 2.5


def test_nothing_is_sent_to_nobody(publisher: Session) -> None:
    assert not any(publisher._watched.values())
    with closing(
        Session(Network(connect=(publisher.locators()[0],)), run="test", who="viewer", hand_over=lambda duty: None)
    ) as other:
        taken = other.channel(MODE)
        deadline = time.monotonic() + PATIENCE
        while (heard := taken.take()) is None:  # until the subscription has reached the publisher
            assert time.monotonic() < deadline
            publish(publisher, MODE, b"to a node")
            time.sleep(0.01)
    assert heard.payload == b"to a node"
    assert not any(publisher._watched.values())
