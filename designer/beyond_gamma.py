"""What gamma alone does not say of gains: what noise leaves in the errors, and how far each node's own error may go.

Gamma is of the worst w and of all nodes together. Gains whose gamma is a little larger may let through half the noise.
"""

from __future__ import annotations

import math
from decimal import ROUND_CEILING, ROUND_FLOOR, Context
from typing import Any, NamedTuple

import numpy as np

from agent.contract.arrays import Array
from agent.contract.gains import LinkMatrices
from agent.contract.problem import Problem
from designer.gain.exact import node_gains
from designer.gain.noise import SteadyState, steady_state
from designer.model.error_model import model_of_gains
from designer.start import FromStart, from_start
from designer.start import told as from_there

_FEW_STATES, _MOST_OF_NODES = 40, 5e6  # n nx up to which, and work up to which the gain of each node is worth its time
_LONG = f"with more than {_FEW_STATES} states n nx, so many nodes and errors so slow it takes too long"
_MOST_OF_NOISE = 500  # n nx up to which the noise is worth its time, and the memory that its equation takes
_FEW = 8  # nodes that get a line each; of more, as many
_UP, _DOWN = (Context(prec=4, rounding=way) for way in (ROUND_CEILING, ROUND_FLOOR))  # a gain is known to a 10000th
_WIDE = 1e-3  # relative: where a search has not come to its end both ends are told


class BeyondGamma(NamedTuple):
    """Of gains whose errors are mean-square stable; None where it was not computed, or has not settled."""

    names: tuple[str, ...]
    weights: Array  # (n,)
    noise: SteadyState | None
    gains: list[tuple[float, float]] | None  # of every node's own error
    start: FromStart | None = None  # None: the problem has no initial error
    sought: bool = True  # the noise

    def document(self) -> dict[str, Any]:
        """For --json."""
        noise, gains = self.noise, self.gains  # of the nodes as they count; what is told is of z - z_hat_i itself
        return {
            "white_noise": None
            if noise is None
            else {
                "covariance": "identity",
                "mean_square": noise.total,
                "nodes": dict(zip(self.names, (noise.nodes / self.weights**2).tolist(), strict=True)),
                "relative_error": noise.error,
            },
            "white_noise_sought": self.sought,
            "start": None if self.start is None else self.start.document(),
            "node_gains": None
            if gains is None
            else dict(zip(self.names, (np.array(gains) / self.weights[:, None]).tolist(), strict=True)),
        }


def beyond_gamma(problem: Problem, K: LinkMatrices, H: LinkMatrices, P: Array | None = None) -> BeyondGamma:
    """For any gains, with the P that their certificate stores; nothing where they are not mean-square stable."""
    model = model_of_gains(problem, K, H)
    initial, states = problem.mode_index(problem.markov.initial), problem.n * problem.nx
    sought = states <= _MOST_OF_NOISE
    noise = steady_state(model, initial=initial) if sought else None
    gains = node_gains(model, most=math.inf if states <= _FEW_STATES else _MOST_OF_NODES)
    return BeyondGamma(problem.node_names, problem.weights, noise, gains, from_start(problem, K, H, P), sought)


def told(facts: dict[str, Any]) -> list[str]:
    """`BeyondGamma.document` for people: the noise, then a line for each node, of many for those that have most."""
    noise, gains = facts["white_noise"], facts["node_gains"] or {}
    if noise is None:
        why = (
            "was not found"
            if facts["white_noise_sought"]
            else f"is not sought of more than {_MOST_OF_NOISE} states n nx, nor is each node's gain"
        )
        return [f"noise      what white w leaves in the steady state {why}", *from_there(facts.get("start"))]
    found = [f"noise      E|z~|^2 = {noise['mean_square']:.6g} in the steady state under white w of unit covariance"]
    order = sorted(noise["nodes"], key=lambda name: -noise["nodes"][name])
    names = list(noise["nodes"]) if len(order) <= _FEW else order[:_FEW]
    width = max(map(len, names))
    for name in names:
        gain = f"exact gain {_known(*gains[name])}, " if name in gains else ""
        found.append(f"  node {name:{width}}  {gain}E|z - z^|^2 = {noise['nodes'][name]:.6g}; computed")
    if len(order) > _FEW:
        found.append(f"  and {len(order) - _FEW} nodes with less noise: --json has all")
    if not gains:
        found.append(f"  the exact gain of each node is not sought: {_LONG}")
    return found + from_there(facts.get("start"))


def _known(low: float, high: float) -> str:
    """A gain, with no more digits than are known of it."""
    up = f"{_UP.create_decimal_from_float(high):g}"
    return up if high <= low * (1.0 + _WIDE) else f"between {_DOWN.create_decimal_from_float(low):g} and {up}"
