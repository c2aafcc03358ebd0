"""Sets of numbers as a text of ranges."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from agent.contract.recording.ranges import in_ranges, ranges_of


def test_a_set_is_as_few_ranges_as_can_be() -> None:
    assert in_ranges({24, 8, 9, 10, 12, 13}) == "8-10 12-13 24"
    assert in_ranges([]) == ""


@given(st.sets(st.integers(0, 10**9)))
def test_ranges_hold_the_set_and_nothing_else(numbers: set[int]) -> None:
    assert {number for some in ranges_of(in_ranges(numbers)) for number in some} == numbers


def test_what_is_no_range_is_left_out() -> None:
    assert ranges_of("3 x 5-4 -2 7- 8-9") == [range(3, 4), range(5, 5), range(8, 10)]
