"""What a row of Pi may be, by its corners."""

from __future__ import annotations

from fractions import Fraction

Row = tuple[Fraction, ...]


def row_corners(row: Row, distance: Fraction) -> tuple[Row, ...]:
    """The corners of {pi >= 0, sum pi = 1, sum |pi - row| / 2 <= distance}.

    A linear function of pi is largest where mass `distance` went to one entry, from the others in turn: each gives all
    that it has before the next gives any.
    """
    found: dict[Row, None] = {}

    def take(pi: Row, left: Fraction, t: int) -> None:
        givers = [s for s, mass in enumerate(pi) if s != t and mass > 0]
        if left == 0 or not givers:
            found[pi] = None
            return
        for s in givers:
            moved, following = min(left, pi[s]), list(pi)
            following[s] -= moved
            following[t] += moved
            take(tuple(following), left - moved, t)

    for t in range(len(row)):
        take(row, distance, t)
    return tuple(found)
