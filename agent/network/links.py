"""Who has a link with whom in a run on one machine: those between whom messages flow, and nobody else.

A complete mesh of n nodes has n (n - 1) / 2 links, most of them for nothing. Coordinator, plant and recorder deal with
everybody; a node deals with those, with the nodes that it hears in some mode and with those that hear it.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from agent.contract.keys import COORDINATOR, PLANT, RECORDER, node_who, participants
from agent.contract.problem import Problem

HUBS = (COORDINATOR, RECORDER, PLANT)


@dataclass(frozen=True)
class Sockets:
    """The Unix sockets of a run on one machine, as addresses: where we are reached, and those that we connect to."""

    listen: str
    connect: tuple[str, ...]


def linked(problem: Problem, who: str) -> set[str]:
    """With whom participant `who` exchanges messages."""
    everybody = set(participants(problem))
    if who in HUBS:
        return everybody - {who}
    nodes = [node_who(name) for name in problem.node_names]
    i, hears = nodes.index(who), np.any([topology.adjacency > 0.0 for topology in problem.topologies], axis=0)
    return {*HUBS, *(nodes[j] for j in np.flatnonzero(hears[i] | hears[:, i]))} - {who}


def sockets(problem: Problem, who: str, folder: Path) -> Sockets:
    """Those of `who`, in a folder of the run: of two that have a link, the later one in the order connects."""
    order = [*HUBS, *map(node_who, problem.node_names)]
    near = linked(problem, who)
    addresses = {other: f"unixsock-stream/{folder / str(place)}" for place, other in enumerate(order)}
    return Sockets(addresses[who], tuple(addresses[other] for other in order[: order.index(who)] if other in near))
