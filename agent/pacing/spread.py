"""Durations, counted: their median, 99th percentile and maximum, in bounded memory. Pure."""

from __future__ import annotations

import math
from collections import Counter

FINENESS = 100.0  # counters for each factor of e: quantiles are within 1 %


class Spread:
    """How long something took, again and again."""

    def __init__(self) -> None:
        self._counts: Counter[int] = Counter()
        self.longest = 0.0

    def add(self, seconds: float) -> None:
        self._counts[math.ceil(FINENESS * math.log(max(seconds, 1e-7)))] += 1
        self.longest = max(self.longest, seconds)

    def quantile(self, part: float) -> float:
        """A duration that `part` of all are not above, 1 % too long at most; 0 where there are none."""
        left = math.ceil(part * self._counts.total())
        for place in sorted(self._counts):
            left -= self._counts[place]
            if left <= 0:
                return min(math.exp(place / FINENESS), self.longest)
        return 0.0
