"""Eq. (10) as it acted in one step of a paced run: with what was used there, and no mean.

With phi_ij = 1 where node i used the pair of node j, and mu_i = 1 where its measurement was there in time, node i
makes x_hat_i(k+1) = sum over j of a_ij (phi_ij (K_ij x_hat_j + H_ij nu_j) + (1 - phi_ij) K_ij x_hat_i) with
nu_i = mu_i (theta_i C_i x + D_i w - c_i C_i x_hat_i), where c_i is beta_i, or 1 where the node sees its losses (and
mu_i = 0 where it saw one). So (10) becomes, with the matrices of (8) and K_phi, H_phi for what was used,

    e(k+1) = (1 A - K_phi 1 - H_phi mu (theta - c) C 1) x + (K_phi - H_phi mu c C) e + (1 B - H_phi mu D) w.

No loss of the model, no late message and no absence is an average here, so nothing cancels.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from agent.contract.arrays import Array
from designer.replay.central import Central


class Acted(NamedTuple):
    """One step: eta(k+1) = A eta(k) + B w(k), less H u(k) in the rows of e."""

    A: Array  # (n_eta, n_eta)
    B: Array  # (n_eta, nw)
    H: Array  # (n nx, sum ny)


class Acting:
    """The matrices of every step that is different."""

    def __init__(self, central: Central) -> None:
        self._central = central
        self._matrices = lru_cache(maxsize=256)(self._made)

    def __call__(self, key: tuple[int, bytes, bytes, bytes]) -> Acted:
        return self._matrices(*key)

    def _made(self, s: int, theta_of: bytes, used_of: bytes, measured_of: bytes) -> Acted:
        central, problem, bar = self._central, self._central.problem, self._central.bar
        n, nx, p = problem.n, problem.nx, central.model.plant_states
        used = np.frombuffer(used_of, dtype=bool).reshape(n, n).astype(float)
        mu = np.frombuffer(measured_of)[central.y_owner]
        by_row = np.repeat(used, nx, axis=0)
        K = central.K_bar[s] * np.repeat(by_row, nx, axis=1)
        unused = (central.K_bar[s] - K).reshape(n, nx, n, nx).sum(axis=2)
        for i in range(n):
            K[i * nx : (i + 1) * nx, i * nx : (i + 1) * nx] += unused[i]
        H = central.H_bar[s] * by_row[:, central.y_owner] * mu
        A, B = np.zeros((central.model.size, central.model.size)), np.zeros((central.model.size, problem.nw))
        A[p:, p:] = K - H @ central.C_nu
        if p:
            ones = np.tile(np.eye(nx), (n, 1))
            seen = np.array([node.seen for node in problem.nodes])[central.y_owner]
            theta = np.frombuffer(theta_of)[central.y_owner]
            missed = np.where(seen, 0.0, theta - problem.beta[central.y_owner])  # theta - c
            A[:p, :p], B[:p] = problem.plant.A, problem.plant.B
            drift = np.zeros((n * nx, nx)) if problem.unbiased else bar.A @ ones - K @ ones
            A[p:, :p] = drift - (H * missed) @ bar.C @ ones
            B[p:] = bar.B - H @ bar.D
        return Acted(A, B, H)


def with_plant(central: Central) -> Central:
    """With x in the state, also where the errors do not need it: a node may begin with 0."""
    nx, M = central.problem.nx, central.bar.M
    M = np.hstack([np.zeros((len(M), nx)), M])
    size = nx * (central.problem.n + 1)
    blank = np.zeros((central.model.modes, size, size))
    return replace(central, model=replace(central.model, plant_states=nx, M=M, A=blank))


def without_plant(central: Central) -> Central:
    """With the errors alone: what is compared are estimates."""
    size = central.problem.nx * central.problem.n
    blank = np.zeros((central.model.modes, size, size))
    return replace(central, model=replace(central.model, plant_states=0, M=central.bar.M, A=blank))
