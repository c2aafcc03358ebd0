"""When the coordinator gives out each mode: t_k = t_0 + k period, without drift. Pure."""

from __future__ import annotations


class Beat:
    """The schedule from step `first` on, which is due at `begin`."""

    def __init__(self, *, period: float, begin: float, first: int = 0) -> None:
        self._period, self._begin, self._first = period, begin, first

    def due(self, step: int) -> float:
        """When the mode of `step` is to go out."""
        return self._begin + (step - self._first) * self._period

    def catch_up(self, step: int, now: float) -> float:
        """By how many seconds the schedule moves because `step` is more than a period late; 0 where it is not.

        A clock that stood still goes on from where it stood. Giving out all that was due at once would leave the
        nodes no time in any of these steps.
        """
        stood = now - self.due(step)
        if stood <= self._period:
            return 0.0
        self._begin += stood
        return stood
