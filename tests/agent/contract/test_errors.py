"""Refusals are sentences that a person reads."""

from __future__ import annotations

import pytest

from agent.contract.errors import listed


@pytest.mark.parametrize(
    ("count", "text"), [(0, ""), (1, '"0"'), (3, '"0", "1" and "2"'), (9, '"0", "1", "2", "3", "4", "5", "6", ')]
)
def test_long_lists_of_names_are_cut(count: int, text: str) -> None:
    said = listed(str(i) for i in range(count))
    assert said == text if count < 9 else said == text + '... 1 more ... and "8"'
