"""Networks that are too large for a search at once: a short descent for each of many windows, which overlap.

A window is a network of its own: its core, and nodes around that. Nobody outside is heard, and of the gains that are
found only those of the core are kept. A node hears few others, so most of what its gains can do they do near it; and
the cost of all windows together grows as the number of nodes.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agent.contract.problem import Problem
from designer.gain.exact import Operator, lyapunov
from designer.gain.products import banded_order
from designer.model.error_model import Indices, StackedGains, error_model, measurement_slices
from designer.patience import Budget, TimeIsUp, looking
from designer.search.descent import follow
from designer.search.starts import least_variance_gains
from designer.workers import each

_CORE = 20  # nodes
_NODES = 40  # of a window: as many rings of neighbours around the core as come to it
_MOST = 100  # of the largest window: where nodes hear many others, windows are no small networks
WEIGHT = 9e-3  # mu; for less the nodes outside count
_HALVES = 3


class Window(NamedTuple):
    """Nodes by their numbers, ascending."""

    core: Indices
    nodes: Indices  # the core, all whom it hears, and more


class Windowed(NamedTuple):
    """What the windows led to; `ended` tells why not all of them did: "interrupted" or "out of time"."""

    gains: StackedGains
    ended: str | None


def windows(problem: Problem) -> list[Window]:
    """Every node is in one core. Empty where a window would have more than 100 nodes."""
    linked = np.asarray(sum(t.adjacency + t.adjacency.T for t in problem.topologies) != 0.0)
    order, found = banded_order(linked), []
    for first in range(0, problem.n, _CORE):
        core = np.sort(order[first : first + _CORE])
        nodes, before = _with_neighbours(linked, core), core
        while len(before) < len(nodes) < _NODES:
            nodes, before = _with_neighbours(linked, nodes), nodes
        found.append(Window(core, nodes))
    return found if max(len(window.nodes) for window in found) <= _MOST else []


def _with_neighbours(linked: NDArray[np.bool_], nodes: Indices) -> Indices:
    inside = np.asarray(linked[nodes].any(axis=0))
    inside[nodes] = True
    return np.flatnonzero(inside)


def window_gains(
    problem: Problem,
    gains: StackedGains,
    *,
    budget: Budget,
    dask: str | None = None,
    report: Callable[[int, int], None] = lambda done, of: None,
) -> Windowed:
    """The given gains, and in their place, for every core, those of its window, where that has stable ones.

    On the processes of `designer.workers.each`; the numbers do not depend on who computes them. KeyboardInterrupt and
    the end of the budget leave the rest as it is. Where the errors then grow, the way back is gone by
    halves, and at last to its beginning. `report` gets how many are done, of how many.
    """
    found, ended = windows(problem), None
    K_bar, H_bar = (part.copy() for part in gains)
    columns, nx = measurement_slices(problem), problem.nx
    try:
        with looking(budget.check):
            results = each(_descended, _parts(problem, found), dask=dask)
            for done, ((core, nodes), result) in enumerate(zip(found, results, strict=True), 1):
                if result is not None:
                    rows = _entries(core, nx)
                    own = np.isin(_entries(nodes, nx), rows)
                    measured = np.concatenate([np.arange(columns[j].start, columns[j].stop) for j in nodes])
                    K_bar[:, rows[:, None], _entries(nodes, nx)] = result[0][:, own]
                    H_bar[:, rows[:, None], measured] = result[1][:, own]
                report(done, len(found))
                budget.check()
    except KeyboardInterrupt:
        ended = "interrupted"
    except TimeIsUp:
        ended = "out of time"
    for _ in range(_HALVES):
        if lyapunov(Operator(error_model(problem, K_bar, H_bar)))[0] is not None:
            return Windowed((K_bar, H_bar), ended)
        K_bar, H_bar = (K_bar + gains[0]) / 2.0, (H_bar + gains[1]) / 2.0
    return Windowed(gains, ended)


def _entries(nodes: Indices, nx: int) -> Indices:
    """Of the states of these nodes, one node after the other."""
    return np.asarray((nodes[:, None] * nx + np.arange(nx)).reshape(-1))


def _parts(problem: Problem, found: list[Window]) -> list[Problem]:
    """A problem for each window."""
    document = problem.document()
    adjacencies = [np.array(topology["adjacency"]) for topology in document["topology"]]
    parts = []
    for window in found:
        names = [problem.node_names[i] for i in window.nodes]
        topologies = [
            topology | {"adjacency": adjacency[np.ix_(window.nodes, window.nodes)].tolist()}
            for topology, adjacency in zip(document["topology"], adjacencies, strict=True)
        ]
        links = [link for link in document.get("link", []) if {link["receiver"], link["sender"]} <= set(names)]
        part = document | {"node": [document["node"][i] for i in window.nodes], "topology": topologies, "link": links}
        parts.append(Problem.from_document({key: value for key, value in part.items() if value != []}))
    return parts


def _descended(part: Problem) -> StackedGains | None:
    """Gains of one window; None where none were found whose errors are mean-square stable."""
    return follow(part, least_variance_gains(part), (WEIGHT,))
