"""The networks that a program which takes a node's place is tried in: everything that a problem can ask of a node.

Their gains are those of Kalman-consensus, which need no search; nothing is proved of them, for nobody measures here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

from agent.contract.gains import Certificate, Gains, Solver
from agent.contract.problem import Problem
from designer.model.error_model import link_gains
from designer.problems import find
from designer.search.starts import consensus_gains

Change = Callable[[dict[str, Any]], object]


@dataclass(frozen=True)
class Network:
    """A built-in problem, changed, and the node of it that a program is."""

    what: str
    problem: str
    node: str
    change: Change = lambda document: None

    @property
    def gains(self) -> Gains:
        return _gains_in(self)


@cache
def _gains_in(network: Network) -> Gains:
    document = find(network.problem).document()
    network.change(document)
    return _consensus(Problem.from_document(document))


def _see_losses(document: dict[str, Any]) -> None:
    for node in document["node"]:
        node["loss"] = "seen"


def _lose_messages(document: dict[str, Any]) -> None:
    """Everybody of everybody: more links than one count of Philox has numbers."""
    names = [node["name"] for node in document["node"]]
    pairs = [
        (receiver, sender)
        for i, receiver in enumerate(names)
        for j, sender in enumerate(names)
        if i != j and any(mode["adjacency"][i][j] for mode in document["topology"])
    ]
    document["link"] = [
        {"receiver": receiver, "sender": sender, "delivery_probability": 0.6 + 0.1 * (number % 3)}
        for number, (receiver, sender) in enumerate(pairs)
    ]


def _weigh(document: dict[str, Any]) -> None:
    """The built-in problems weigh everybody alike."""
    for mode in document["topology"]:
        mode["adjacency"] = [
            [a * (0.5 + 0.25 * ((i + 2 * j) % 4)) for j, a in enumerate(row)] for i, row in enumerate(mode["adjacency"])
        ]


def _consensus(problem: Problem) -> Gains:
    K, H = link_gains(problem, *consensus_gains(problem))
    nothing = Certificate(gamma=1.0, kind="lyapunov", form="full", holds=False, verified="nothing", margins={})
    solver = Solver(name="none", version="0", status="consensus gains", iterations=0, seconds=0.0)
    return Gains.of(problem, K, H, method="consensus", certificate=nothing, solver=solver)


NETWORKS = {  # from what the paper has to what real networks have; the last has all of it
    "ideal": Network("the ideal example", "zhu2020-ideal", "3"),
    "lossy": Network("the lossy example", "zhu2020-lossy", "3"),
    "seen": Network("losses that are seen", "zhu2020-lossy", "3", _see_losses),
    "links": Network("lossy links", "zhu2020-lossy", "3", _lose_messages),
    "unbiased": Network("unbiased gains", "zhu2020-lossy", "3", lambda document: document.update(unbiased=True)),
    "sizes": Network("different numbers of measurements", "quadruple-tank", "flows-left", _weigh),
    "all": Network("all of that", "inverted-pendulum", "camera", _weigh),
}
