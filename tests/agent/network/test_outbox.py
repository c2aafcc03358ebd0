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


def test_numbers_go_on_where_everything_was_acknowledged() -> None:
    outbox = Outbox("plant")
    outbox.add("plant/state", b"")
    outbox.forget(1)
    assert outbox.add("plant/state", b"").stamp.number == 1
