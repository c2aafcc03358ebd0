"""What is left of a descent, from the evaluations of its rounds so far and from how fast its last steps fell.

It is counted in steps of the recursion, of which an evaluation over T steps takes T; a clock makes seconds of them. How
long the horizon will be is not known beforehand, so what is said holds for the T of now.
"""

from __future__ import annotations

import math

from designer.search.bfgs import PATIENCE

_USUAL = (22, 27, 34, 50, 62, 95, 90, 150)  # evaluations of each round, of networks with few nodes
_USUAL_OF_CENTRE = 120
_FEW, _GROWTH, _MORE = 6, 0.95, 2.0  # nodes; with more, more evaluations, at most so many times as many
_FIRM = 700.0  # evaluations that count as much as what is usual
_A_STEP = 1.4  # evaluations


def growth(nodes: int) -> float:
    """How many times as long a search takes as one of few nodes, an evaluation as long."""
    return math.pow(max(nodes / _FEW, 1.0), _GROWTH)


class Outlook:
    """The rounds of one descent of a network of so many nodes; the last is its centring."""

    def __init__(self, nodes: int) -> None:
        more = min(growth(nodes), _MORE)
        self._usual = tuple(more * evaluations for evaluations in (*_USUAL, _USUAL_OF_CENTRE))
        self._taken: dict[int, int] = {}  # evaluations of each round, the last time it was gone through
        self._round, self._enough = 0, 1.0
        self._values: list[float] = []
        self.steps = 0  # of the recursion, in all

    def begin(self, number: int, enough: float) -> None:
        """Of `bfgs.minimise`, which ends when ten steps gain less than `enough`."""
        self._round, self._enough, self._values = number, enough, []
        self._taken[number] = 0

    def evaluated(self, horizon: int) -> None:
        """Once over so many steps."""
        self._taken[self._round] += 1
        self.steps += horizon

    def fell(self, value: float) -> None:
        """A step of the descent led to this value."""
        self._values.append(value)

    @property
    def left(self) -> float:
        """Evaluations."""
        over = [k for k in self._taken if k < self._round]
        taken, usual = sum(self._taken[k] for k in over), sum(self._usual[k] for k in over)
        rate = (_FIRM + taken) / (_FIRM + usual)
        later = rate * sum(self._usual[self._round + 1 :])
        return later + self._left_of_round(rate * self._usual[self._round])

    def _left_of_round(self, usual: float) -> float:
        """As many as ten steps need to gain less than enough, at the rate at which their gain has fallen."""
        values, taken = self._values, self._taken[self._round]
        least = _A_STEP * max(PATIENCE - len(values), 1)
        if len(values) <= 2 * PATIENCE:
            return max(usual - taken, least)
        before, last = values[-1 - 2 * PATIENCE] - values[-1 - PATIENCE], values[-1 - PATIENCE] - values[-1]
        if not before > last > self._enough:
            return max(usual - taken, taken / 4.0, least)
        steps = PATIENCE * math.log(last / self._enough) / math.log(before / last)
        return max(min(steps * taken / len(values), taken), least)
