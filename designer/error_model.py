"""The paper's centralised error model, eqs. (6)-(11), for every mode; and the same with the shorter state.

Eq. (10) has the state [1 kron x; e], but 1 kron x never leaves an nx-dimensional subspace. The reduced model has
eta = [x; e_1; ...; e_n], of length nx (n + 1); it gives the same errors. `error_model` is the reduced one, and
is used everywhere; `paper_error_model` is (10)(11) as printed.

F_i is zero except for one block (rows of e, columns of x), and only that block is kept: for 100 nodes with four
states it is 5 MB for four modes, where the matrices as printed would take gigabytes.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np

from agent.contract.arrays import Array
from agent.contract.gains import Gains, LinkMatrices
from agent.contract.problem import Problem


@dataclass(frozen=True, eq=False)
class ErrorModel:
    """Eq. (10): eta(k+1) = [A_s + sum_i (theta_i - beta_i) F_i,s] eta + B_s w, z_tilde = M eta, in mode s.

    `plant_states` is the length p of the part of eta that comes before e: nx, or n nx in the printed form.
    """

    A: Array  # (modes, n_eta, n_eta), script A of (11)
    B: Array  # (modes, n_eta, nw), script B
    F: Array  # (modes, n, n nx, p): the rows of e and the columns of the plant's part of script F_i
    M: Array  # (n nz, n_eta), script M
    beta: Array  # (n,)
    alpha: Array  # (n,): beta (1 - beta)
    transition: Array  # (modes, modes): Pi
    plant_states: int

    def F_i(self, s: int, i: int) -> Array:
        """Script F_i of (11) in full, (n_eta, n_eta)."""
        full = np.zeros_like(self.A[s])
        full[self.plant_states :, : self.plant_states] = self.F[s, i]
        return np.asarray(full)


@dataclass(frozen=True, eq=False)
class Stacks:
    """The matrices that (8) defines from the problem alone. Nodes may have different numbers ny_i of measurements."""

    A: Array  # (n nx, n nx): A_bar = diag{A, ..., A}
    B: Array  # (n nx, nw): B_bar
    C: Array  # (sum ny, n nx): diag{C_1, ..., C_n}
    C_beta: Array  # (sum ny, n nx): C_bar_beta
    D: Array  # (sum ny, nw): D_bar
    M: Array  # (n nz, n nx): M_bar
    beta: Array  # (n,)
    alpha: Array  # (n,), eq. (3)
    rows: list[slice]  # of each node's measurements

    @cached_property
    def E(self) -> list[Array]:
        """E[i] = E_n^i, (sum ny, n nx): C_i in block i, else zero. Only for who asks: large networks do not."""
        matrices = [np.zeros_like(self.C) for _ in self.rows]
        for E_i, rows in zip(matrices, self.rows, strict=True):
            E_i[rows] = self.C[rows]
        return matrices


def stacks(problem: Problem) -> Stacks:
    """A_bar, B_bar, C_bar_beta, D_bar, M_bar and E_n^i of (8)."""
    plant, n, beta, nx = problem.plant, problem.n, problem.beta, problem.nx
    slices = measurement_slices(problem)
    C, C_beta = np.zeros((2, slices[-1].stop, n * nx))
    for i, rows in enumerate(slices):
        C[rows, i * nx : (i + 1) * nx] = problem.nodes[i].C
        C_beta[rows] = beta[i] * C[rows]
    return Stacks(
        A=np.asarray(np.kron(np.eye(n), plant.A), dtype=np.float64),
        B=np.tile(plant.B, (n, 1)),
        C=C,
        C_beta=C_beta,
        D=np.vstack([node.D for node in problem.nodes]),
        M=np.asarray(np.kron(np.eye(n), plant.M), dtype=np.float64),
        beta=beta,
        alpha=beta * (1.0 - beta),
        rows=slices,
    )


def measurement_slices(problem: Problem) -> list[slice]:
    """Where the measurements of each node stand in y = [y_1; ...; y_n]."""
    ends = np.cumsum([0] + [node.C.shape[0] for node in problem.nodes])
    return [slice(int(first), int(end)) for first, end in pairwise(ends)]


def rows_total(problem: Problem) -> int:
    """Number of measurements of all nodes together, sum ny."""
    return sum(node.C.shape[0] for node in problem.nodes)


def stacked_gains(gains: Gains) -> tuple[Array, Array]:
    """K_bar (modes, n nx, n nx) and H_bar (modes, n nx, sum ny) of (8): blocks a_ij K_ij and a_ij H_ij."""
    return stacked_links(gains.problem, gains.K, gains.H)


def stacked_links(problem: Problem, K: LinkMatrices, H: LinkMatrices) -> tuple[Array, Array]:
    """`stacked_gains` of gains that are in no file yet."""
    nx, columns = problem.nx, measurement_slices(problem)
    K_bar = np.zeros((len(problem.topologies), problem.n * nx, problem.n * nx))
    H_bar = np.zeros((len(problem.topologies), problem.n * nx, rows_total(problem)))
    for s, topology in enumerate(problem.topologies):
        for i, receiver in enumerate(problem.node_names):
            rows = slice(i * nx, (i + 1) * nx)
            for j in problem.neighbours(s, i):
                sender, a_ij = problem.node_names[j], topology.adjacency[i, j]
                K_bar[s, rows, j * nx : (j + 1) * nx] = a_ij * K[topology.name][receiver][sender]
                H_bar[s, rows, columns[j]] = a_ij * H[topology.name][receiver][sender]
    return K_bar, H_bar


def link_gains(problem: Problem, K_bar: Array, H_bar: Array) -> tuple[LinkMatrices, LinkMatrices]:
    """K_ij and H_ij of (5) from the blocks of (8): the inverse of `stacked_links`, so divided by a_ij."""
    nx, columns = problem.nx, measurement_slices(problem)
    K: LinkMatrices = {}
    H: LinkMatrices = {}
    for s, topology in enumerate(problem.topologies):
        K[topology.name] = {name: {} for name in problem.node_names}
        H[topology.name] = {name: {} for name in problem.node_names}
        for i, receiver in enumerate(problem.node_names):
            rows = slice(i * nx, (i + 1) * nx)
            for j in problem.neighbours(s, i):
                sender, a_ij = problem.node_names[j], topology.adjacency[i, j]
                K[topology.name][receiver][sender] = K_bar[s, rows, j * nx : (j + 1) * nx] / a_ij
                H[topology.name][receiver][sender] = H_bar[s, rows, columns[j]] / a_ij
    return K, H


def error_model(problem: Problem, K_bar: Array, H_bar: Array) -> ErrorModel:
    """Eqs. (10)(11) with the reduced state eta = [x; e_1; ...; e_n]."""
    bar, plant, modes = stacks(problem), problem.plant, len(problem.topologies)
    nx, n = problem.nx, problem.n
    ones = np.tile(np.eye(nx), (n, 1))  # (n nx, nx): 1 kron I
    C_one = bar.C @ ones  # (sum ny, nx): [C_1; ...; C_n]
    A = np.zeros((modes, nx * (n + 1), nx * (n + 1)))
    A[:, :nx, :nx] = plant.A
    A[:, nx:, :nx] = bar.A @ ones - K_bar @ ones
    A[:, nx:, nx:] = K_bar - H_bar @ bar.C_beta
    B = np.concatenate([np.tile(plant.B, (modes, 1, 1)), bar.B - H_bar @ bar.D], axis=1)
    F = np.stack([-H_bar[:, :, rows] @ C_one[rows] for rows in measurement_slices(problem)], axis=1)
    M = np.hstack([np.zeros((n * problem.nz, nx)), bar.M])
    return ErrorModel(A, B, F, M, bar.beta, bar.alpha, problem.markov.transition, plant_states=nx)


def paper_error_model(problem: Problem, K_bar: Array, H_bar: Array) -> ErrorModel:
    """Eqs. (10)(11) as printed: eta = [x_bar; e], of length 2 n nx."""
    bar, modes = stacks(problem), len(problem.topologies)
    size = problem.n * problem.nx
    A = np.zeros((modes, 2 * size, 2 * size))
    A[:, :size, :size] = bar.A
    A[:, size:, :size] = bar.A - K_bar
    A[:, size:, size:] = K_bar - H_bar @ bar.C_beta
    B = np.concatenate([np.tile(bar.B, (modes, 1, 1)), bar.B - H_bar @ bar.D], axis=1)
    F = np.stack([-H_bar @ E_i for E_i in bar.E], axis=1)
    M = np.hstack([np.zeros_like(bar.M), bar.M])
    return ErrorModel(A, B, F, M, bar.beta, bar.alpha, problem.markov.transition, plant_states=size)


def step(model: ErrorModel, s: int, theta: Array, eta: Array, w: Array) -> Array:
    """Eq. (10) for one step in mode s: eta(k+1), (n_eta,), from the realised theta (n,), eta (n_eta,), w (nw,)."""
    p = model.plant_states
    eta_next = model.A[s] @ eta + model.B[s] @ w
    eta_next[p:] += np.tensordot(theta - model.beta, model.F[s], axes=1) @ eta[:p]
    return np.asarray(eta_next)
