"""What happened in recorded runs, as counts: arrivals, deliveries, transitions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from designer.replay.log import Log
from designer.replay.topics import Numbers


class Count(NamedTuple):
    hits: int
    trials: int

    @property
    def share(self) -> float:
        return self.hits / self.trials


class Counts(NamedTuple):
    """Indices are those of nodes and modes."""

    arrivals: tuple[Count, ...]  # per node: measurements with the plant in them
    deliveries: Mapping[tuple[int, int], Count]  # (i, j): messages of j that i used, of those it was to use
    transitions: Numbers  # (modes, modes): from row to column


def counts_of(log: Log) -> Counts:
    """What a log tells; a message that it lacks tells nothing.

    Whether a measurement arrived is known of a simulated plant, and of a node that sees its losses. A message that
    was late counts as one that did not arrive: the node could not use it.
    """
    return Counts(tuple(_arrivals(log)), _deliveries(log), _transitions(log))


def total(counts: Sequence[Counts]) -> Counts:
    """Of several runs of one problem."""
    links = sorted({link for some in counts for link in some.deliveries})
    return Counts(
        arrivals=tuple(_sum(each) for each in zip(*(some.arrivals for some in counts), strict=True)),
        deliveries={link: _sum([some.deliveries.get(link, Count(0, 0)) for some in counts]) for link in links},
        transitions=np.asarray(sum(some.transitions for some in counts)),
    )


def _sum(counts: Sequence[Count]) -> Count:
    return Count(sum(count.hits for count in counts), sum(count.trials for count in counts))


def _arrivals(log: Log) -> list[Count]:
    found = []
    for i, node in enumerate(log.gains.problem.nodes):
        if not log.external[i]:
            arrived = log.theta[:, i]
        elif node.seen:
            arrived = log.measured[:, i]
        else:
            arrived = np.empty(0)  # a hidden loss is in no message of a real sensor
        known = arrived[np.isfinite(arrived)]
        found.append(Count(int(known.sum()), len(known)))
    return found


def _deliveries(log: Log) -> dict[tuple[int, int], Count]:
    """By `heard` of step k + 1, where the node went on from step k in the mode of that step."""
    problem, members = log.gains.problem, log.senders.members()
    hears = np.array([topology.adjacency > 0.0 for topology in problem.topologies])
    mode, found = log.mode[:-1], {}
    known = (mode >= 0) & (mode < len(hears))
    for i in range(problem.n):
        told = log.heard[1:, i]
        went_on = known & (told >= 0) & (log.used[1:, i] == mode)
        for j in problem.ever_heard(i):
            if j != i:
                asked = went_on & hears[np.where(known, mode, 0), i, j]
                found[i, j] = Count(int(members[told[asked], j].sum()), int(asked.sum()))
    return found


def _transitions(log: Log) -> Numbers:
    modes = len(log.gains.problem.mode_names)
    counts = np.zeros((modes, modes), dtype=np.int64)
    before, after = log.mode[:-1], log.mode[1:]
    known = (before >= 0) & (before < modes) & (after >= 0) & (after < modes)
    np.add.at(counts, (before[known], after[known]), 1)
    return counts
