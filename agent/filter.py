"""One node's step: eqs. (4) and (5) of Zhu et al. 2020. Pure numpy; no clock, no chance, no network.

Not in the paper: a node that sees its losses, messages that do not arrive, and gains that are imposed to be unbiased.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from agent.contract.arrays import Array
from agent.contract.gains import NodeGains
from agent.product import product


class Pair(NamedTuple):
    """What a node tells the others at step k."""

    x_hat: Array  # x_hat_j(k), (nx,)
    innovation: Array  # nu_j(k), (ny_j,)


Step = Callable[[NodeGains, str, Mapping[str, Pair]], Array]  # what `step` is


def innovation(gains: NodeGains, y: Array, x_hat: Array) -> Array:
    """nu_i(k), (ny_i,): the bracket of eq. (4), y_i(k) - beta_i C_i x_hat_i(k).

    A node that sees its losses knows whether the plant is in y_i(k): nu_i(k) = y_i(k) - C_i x_hat_i(k), and 0 where
    nothing arrived, which is an empty `y`.
    """
    if not gains.seen:
        return y - gains.arrival_probability * product(gains.C, x_hat)
    return y - product(gains.C, x_hat) if len(y) else np.zeros(len(gains.C))


def step(gains: NodeGains, mode: str, heard: Mapping[str, Pair]) -> Array:
    """Eqs. (4)(5): x_hat_i(k+1) = sum over j in N_i of a_ij (K_ij x_hat_j(k) + H_ij nu_j(k)), (nx,).

    `heard` holds the pairs that arrived, the node's own among them. For a neighbour j in `mode` whose pair did not,
    x_hat_i(k) stands in for x_hat_j(k), and 0 for nu_j(k), so that the sum of the weights of estimates stays the same.
    All links are one product, of which every row is summed from left to right.

    Unbiased gains, sum over j of a_ij K_ij = A: the step is the same, with a_ii K_ii taken from that equation,
    x_hat_i(k+1) = A x_hat_i(k) + sum over j heard of a_ij (K_ij (x_hat_j(k) - x_hat_i(k)) + H_ij nu_j(k)). So an
    unstable plant is followed exactly: the rounding of K_ii in a file is not multiplied by a state that grows.
    """
    x_hat_i = heard[gains.node].x_hat
    told = [] if gains.A is None else [x_hat_i]
    for link in gains.links[mode]:
        x_hat_j, nu_j = heard.get(link.sender) or (x_hat_i, np.zeros(link.H.shape[1]))
        told += [x_hat_j if gains.A is None else x_hat_j - x_hat_i, nu_j]
    return product(gains.rows[mode], np.concatenate(told))
