"""The main thread's queue: one word after the other, in the order in which they came."""

from __future__ import annotations

import math
import time

import pytest

from agent.contract.errors import RunBroken
from agent.contract.messages import Ready
from agent.network.words import Incoming, Peer, Replayed, Words

READY = Ready(who="plant", session="a", gains="b")


def filled(*given: Incoming | None) -> Words:
    words = Words("recorder")
    for word in given:
        words.put(lambda word=word: word)
    return words


def test_words_come_in_order_and_none_where_a_duty_leaves_none() -> None:
    words = filled(READY, None, Replayed("plant"))
    assert [words.next(math.inf) for _ in range(3)] == [READY, None, Replayed("plant")]
    assert words.next(time.monotonic()) is None


def test_what_a_duty_raises_is_raised_where_it_is_taken() -> None:
    def fail() -> Incoming:
        raise RunBroken("a foreign word")

    words = Words("recorder")
    words.put(fail)
    with pytest.raises(RunBroken, match="a foreign word"):
        words.take(math.inf)


def test_what_was_set_aside_comes_first_or_when_its_kind_is_asked_for() -> None:
    words = filled(Replayed("node-1"))
    come, gone = Peer("plant", present=True), Peer("plant", present=False)
    for word in (come, READY, gone):
        words.set_aside(word)
    assert words.early(Ready) is READY
    assert words.early(Ready) is None
    assert [words.next(math.inf) for _ in range(3)] == [come, gone, Replayed("node-1")]


def test_who_is_present_follows_the_tokens() -> None:
    """One's own token is no company."""
    words = filled(Peer("recorder", present=True), Peer("plant", present=True), Peer("plant", present=False))
    alone, present = [], []
    for _ in range(3):
        words.take(math.inf)
        alone.append(words.alone)
        present.append(set(words.present))
    assert alone == [True, False, False]
    assert present == [{"recorder"}, {"recorder", "plant"}, {"recorder"}]
