"""Nothing that was published is forgotten before the recorder has it, and nothing is kept any longer."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from agent.network.outbox import Outbox


@given(published=st.integers(0, 20), received=st.lists(st.integers(0, 25), max_size=4), first=st.integers(0, 25))
def test_a_replay_has_what_was_not_acknowledged_from_a_number_on(
    published: int, received: list[int], first: int
) -> None:
    """Acknowledgements may repeat, go back, or count more than there is."""
    outbox = Outbox("plant")
    sent = [outbox.add("plant/state", b"%d" % number) for number in range(published)]
    assert [(each.stamp.number, each.stamp.sender) for each in sent] == [(k, "plant") for k in range(published)]
    for count in received:
        outbox.forget(count)
    kept = sent[max(received, default=0) :]
    assert len(outbox) == len(kept)
    assert list(outbox.since(first)) == [each for each in kept if each.stamp.number >= first]


@given(sizes=st.lists(st.integers(0, 4000), min_size=1, max_size=30), most=st.integers(1000, 20000))
def test_no_more_is_kept_than_was_agreed_on(sizes: list[int], most: int) -> None:
    """The newest stay; what goes is counted; and one message is kept whatever its size."""
    outbox = Outbox("plant")
    outbox.most = most
    for size in sizes:
        outbox.add("plant/state", bytes(size))
    kept = list(outbox.since(0))
    assert [each.stamp.number for each in kept] == list(range(outbox.dropped, len(sizes)))
    assert len(kept) == 1 or sum(len(each.payload) for each in kept) <= most
    one_more = sum(size + 320 for size in sizes[max(0, outbox.dropped - 1) :])
    assert not outbox.dropped or one_more > most
    outbox.forget(len(sizes))
    outbox.most = 1000
    outbox.add("plant/state", bytes(600))
    assert len(outbox) == 1


def test_numbers_go_on_where_everything_was_acknowledged() -> None:
    outbox = Outbox("plant")
    outbox.add("plant/state", b"")
    outbox.forget(1)
    assert outbox.add("plant/state", b"").stamp.number == 1
