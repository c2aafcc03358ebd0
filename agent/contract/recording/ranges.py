"""Sets of numbers as a text of ranges, "8-15 24", in the metadata of a recording."""

from __future__ import annotations

import re
from collections.abc import Iterable


def in_ranges(numbers: Iterable[int]) -> str:
    """The text of a set of numbers."""
    ranges: list[list[int]] = []
    for number in sorted(set(numbers)):
        if ranges and number == ranges[-1][1] + 1:
            ranges[-1][1] = number
        else:
            ranges.append([number, number])
    return " ".join(f"{first}-{last}" if last > first else str(first) for first, last in ranges)


def ranges_of(text: str) -> list[range]:
    """The ranges that a text names; what is none, as a tool may have written it, is left out."""
    found = (re.fullmatch(r"(\d{1,18})(?:-(\d{1,18}))?", word) for word in text.split(" "))
    return [range(int(match[1]), int(match[2] or match[1]) + 1) for match in found if match]
