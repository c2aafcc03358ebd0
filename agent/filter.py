"""One node's step: eqs. (4) and (5) of Zhu et al. 2020. Pure numpy; no clock, no chance, no network."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from agent.contract.arrays import Array
from agent.contract.gains import NodeGains


class Pair(NamedTuple):
    """What a node tells the others at step k."""

    x_hat: Array  # x_hat_j(k), (nx,)
    innovation: Array  # y_j(k) - beta_j C_j x_hat_j(k), (ny_j,)


def innovation(gains: NodeGains, y: Array, x_hat: Array) -> Array:
    """The bracket of eq. (4): y_i(k) - beta_i C_i x_hat_i(k), (ny_i,)."""
    return y - gains.arrival_probability * (gains.C @ x_hat)


def step(gains: NodeGains, mode: str, heard: Mapping[str, Pair]) -> Array:
    """Eqs. (4)(5): x_hat_i(k+1) = sum over j in N_i of a_ij K_ij x_hat_j(k) + a_ij H_ij innovation_j(k), (nx,).

    `heard` holds the pair of every node that node i hears in `mode`, its own among them.
    """
    x_hat_next = np.zeros(gains.M.shape[1])
    for j, a_ij, K_ij, H_ij in gains.links[mode]:
        x_hat_j, innovation_j = heard[j]
        x_hat_next += a_ij * (K_ij @ x_hat_j + H_ij @ innovation_j)
    return x_hat_next
