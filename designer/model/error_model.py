"""The centralised error model: eqs. (6)-(11) of the paper for every mode, with what real networks need beside it.

Eq. (10) has the state [1 kron x; e], but 1 kron x never leaves an nx-dimensional subspace. The reduced model has
eta = [x; e_1; ...; e_n]; it gives the same errors. Where gains are unbiased and every loss is seen, x drops out and
eta = [e_1; ...; e_n]. `error_model` is the reduced one, and is used everywhere; `paper_error_model` is (10)(11) as
printed.

Chance enters in three ways, each with mean 0 and uncorrelated with the others (docs/theory.md, section 9):
theta_j - beta_j for every node, phi_ij - rho_ij for every lossy link, and the products of both.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from agent.contract.arrays import Array
from agent.contract.gains import Gains, LinkMatrices
from agent.contract.problem import Problem
from designer.coordinates import There
from designer.model.links import Innovations, LinkTerms, link_terms

Indices = NDArray[np.intp]
StackedGains = tuple[Array, Array]  # K_bar (modes, n nx, n nx) and H_bar (modes, n nx, sum ny) of (8)


@dataclass(frozen=True, eq=False)
class ErrorModel:
    """Eq. (10): eta(k+1) = [A_s + sum_i (theta_i - beta_i) F_i,s] eta + B_s w(k), z_tilde = M eta, in mode s.

    `plant_states` is the length p of the part of eta that comes before e: nx, n nx in the printed form, or 0.
    F_i = -H[:, rows_i] R[rows_i] in the rows of e, where rows_i are the measurements of node i; it acts on [eta; w],
    since a loss that is seen takes D_i w with it.
    """

    A: Array  # (modes, n_eta, n_eta), script A of (11)
    B: Array  # (modes, n_eta, nw), script B
    H: Array  # (modes, n nx, sum ny): H_bar, each block times rho_ij
    R: Array  # (sum ny, n_eta + nw): what a loss takes from each innovation
    M: Array  # (n nz, n_eta), script M
    beta: Array  # (n,)
    alpha: Array  # (n,): beta (1 - beta)
    transition: Array  # (modes, modes): Pi
    plant_states: int
    rows: list[slice]  # of each node's measurements
    links: LinkTerms | None  # None: no link loses messages

    @property
    def modes(self) -> int:
        return len(self.A)

    @property
    def size(self) -> int:
        """n_eta."""
        return int(self.A.shape[1])

    @property
    def nw(self) -> int:
        return int(self.B.shape[2])

    @cached_property
    def owner(self) -> Indices:
        """The node of each measurement, (sum ny,)."""
        return np.repeat(np.arange(len(self.rows)), [rows.stop - rows.start for rows in self.rows])

    @cached_property
    def moves(self) -> NDArray[np.bool_]:
        """Whether state j moves state i, in any mode, by chance or without, (n_eta, n_eta)."""
        first = self.plant_states
        moves = np.asarray((self.A != 0.0).any(axis=0))
        moves[first:] |= (self.H != 0.0).any(axis=0) @ (self.R[:, : self.size] != 0.0)
        if self.links is not None:
            nx = self.links.V.shape[1]
            padded = np.pad(moves, ((0, 0), (0, self.nw)))
            rows = first + self.links.receiver[:, None] * nx + np.arange(nx)
            padded[rows[:, :, None], self.links.columns[:, None, :]] = True
            moves = padded[:, : self.size]
        return moves

    def F_i(self, s: int, i: int) -> Array:
        """Script F_i in full, with the columns of w: (n_eta, n_eta + nw)."""
        full = np.zeros((self.size, self.size + self.nw))
        full[self.plant_states :] = -self.H[s][:, self.rows[i]] @ self.R[self.rows[i]]
        return full

    def V_l(self, term: int) -> Array:
        """The matrix of one term of the links in full, (n_eta, n_eta + nw)."""
        assert self.links is not None
        nx = self.links.V.shape[1]
        full = np.zeros((self.size, self.size + self.nw))
        first = self.plant_states + int(self.links.receiver[term]) * nx
        full[first : first + nx, self.links.columns[term]] = self.links.V[term]
        return full


@dataclass(frozen=True, eq=False)
class Stacks:
    """The matrices that (8) defines from the problem alone. Nodes may have different numbers ny_i of measurements."""

    A: Array  # (n nx, n nx): A_bar = diag{A, ..., A}
    B: Array  # (n nx, nw): B_bar
    C: Array  # (sum ny, n nx): diag{C_1, ..., C_n}
    C_beta: Array  # (sum ny, n nx): C_bar_beta
    D: Array  # (sum ny, nw): D_bar
    D_beta: Array  # (sum ny, nw): beta_i D_i where node i sees its losses, else D_i: the mean of what arrives of D w
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
    D = np.vstack([node.D for node in problem.nodes])
    D_beta = D.copy()
    for i, (node, rows) in enumerate(zip(problem.nodes, slices, strict=True)):
        C[rows, i * nx : (i + 1) * nx] = node.C
        C_beta[rows] = beta[i] * C[rows]
        if node.seen:
            D_beta[rows] = beta[i] * D[rows]
    return Stacks(
        A=np.asarray(np.kron(np.eye(n), plant.A), dtype=np.float64),
        B=np.tile(plant.B, (n, 1)),
        C=C,
        C_beta=C_beta,
        D=D,
        D_beta=D_beta,
        M=np.asarray(np.kron(np.diag(problem.weights), plant.M), dtype=np.float64),
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


def stacked_gains(gains: Gains) -> StackedGains:
    """K_bar and H_bar of (8): blocks a_ij K_ij and a_ij H_ij."""
    return stacked_links(gains.problem, gains.K, gains.H)


def stacked_links(problem: Problem, K: LinkMatrices, H: LinkMatrices) -> StackedGains:
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
    """Eqs. (10)(11) with the reduced state: eta = [x; e_1; ...; e_n], or e alone where x drops out."""
    bar, plant, modes = stacks(problem), problem.plant, len(problem.topologies)
    nx, n, p = problem.nx, problem.n, problem.plant_states
    H = H_bar
    A = np.zeros((modes, p + n * nx, p + n * nx))
    B = np.zeros((modes, p + n * nx, problem.nw))
    A[:, p:, p:] = K_bar
    if problem.links:
        rho = problem.delivery
        delivered = np.kron(rho, np.ones((nx, nx)))  # (n nx, n nx)
        H = H_bar * np.repeat(np.repeat(rho, nx, axis=0), [len(node.C) for node in problem.nodes], axis=1)
        A[:, p:, p:] *= delivered
        undelivered = ((1.0 - delivered) * K_bar).reshape(modes, n, nx, n, nx).sum(axis=3)  # what node i makes up for
        for i in range(n):
            part = slice(p + i * nx, p + (i + 1) * nx)
            A[:, part, part] += undelivered[:, i]
    for i, rows in enumerate(bar.rows):  # H C_bar_beta, which is block diagonal
        part = slice(i * nx, (i + 1) * nx)
        A[:, p:, p + i * nx : p + (i + 1) * nx] -= H[:, :, rows] @ bar.C_beta[rows, part]
    B[:, p:] = bar.B - H @ bar.D_beta
    if p:
        A[:, :p, :p], B[:, :p] = plant.A, plant.B
    if not problem.unbiased:
        ones = np.tile(np.eye(nx), (n, 1))  # (n nx, nx): 1 kron I
        A[:, p:, :p] = np.tile(plant.A, (n, 1)) - K_bar @ ones
    R = _taken_by_losses(problem, bar, p)
    innovations = Innovations(bar.rows, np.zeros((len(R), p)), bar.C_beta, bar.D_beta, R)
    M = np.hstack([np.zeros((n * problem.nz, p)), bar.M])
    return ErrorModel(
        A=A,
        B=B,
        H=H,
        R=R,
        M=M,
        beta=bar.beta,
        alpha=bar.alpha,
        transition=problem.markov.transition,
        plant_states=p,
        rows=bar.rows,
        links=link_terms(problem, innovations, K_bar, H_bar, rho=problem.delivery, alpha=bar.alpha),
    )


def model_of_gains(problem: Problem, K: LinkMatrices, H: LinkMatrices) -> ErrorModel:
    """`error_model` of gains by links, for what does not depend on the coordinates of the states, such as a gain.

    Where M cancels, eta = [T x; T e_1; ...; T e_n], of which it does not: designer.coordinates.
    """
    there = There.of(problem, K, H)
    return error_model(there.problem, *stacked_links(there.problem, there.K, there.H))


def initial_eta(problem: Problem) -> Array:
    """eta(0), (n_eta,), where x(0) is the initial error and every node begins with 0."""
    return np.tile(problem.initial_error, problem.n + (1 if problem.plant_states else 0))


def _taken_by_losses(problem: Problem, bar: Stacks, p: int) -> Array:
    """What a loss takes from each innovation, (sum ny, n_eta + nw): C_i x, or where it is seen C_i e_i + D_i w."""
    nx, size = problem.nx, p + problem.n * problem.nx
    R = np.zeros((len(bar.D), size + problem.nw))
    for i, (node, rows) in enumerate(zip(problem.nodes, bar.rows, strict=True)):
        if node.seen or not p:
            R[rows, p + i * nx : p + (i + 1) * nx] = node.C
            R[rows, size:] = node.D
        else:
            R[rows, :p] = node.C
    return R


def paper_error_model(problem: Problem, K_bar: Array, H_bar: Array) -> ErrorModel:
    """Eqs. (10)(11) as printed: eta = [x_bar; e], of length 2 n nx. The paper knows hidden losses alone."""
    if problem.unbiased or problem.links or any(node.seen for node in problem.nodes):
        raise ValueError("the paper's model has neither seen losses, nor lossy links, nor imposed unbiasedness")
    bar, modes = stacks(problem), len(problem.topologies)
    size = problem.n * problem.nx
    A = np.zeros((modes, 2 * size, 2 * size))
    A[:, :size, :size] = bar.A
    A[:, size:, :size] = bar.A - K_bar
    A[:, size:, size:] = K_bar - H_bar @ bar.C_beta
    B = np.concatenate([np.tile(bar.B, (modes, 1, 1)), bar.B - H_bar @ bar.D], axis=1)
    R = np.hstack([bar.C, np.zeros((len(bar.C), size + problem.nw))])  # E_n^i in the rows of node i
    M = np.hstack([np.zeros_like(bar.M), bar.M])
    transition = problem.markov.transition
    return ErrorModel(A, B, H_bar, R, M, bar.beta, bar.alpha, transition, plant_states=size, rows=bar.rows, links=None)


def realised(model: ErrorModel, s: int, theta: Array, delivered: NDArray[np.bool_] | None = None) -> Array:
    """[A_k B_k], (n_eta, n_eta + nw): what (10) is in a step of mode s with these losses.

    theta (n,) says which measurements arrived; delivered (n, n) which messages, row i for what node i got, and
    counts where links are lossy.
    """
    AB = np.hstack([model.A[s], model.B[s]])
    AB[model.plant_states :] -= (model.H[s] * (theta - model.beta)[model.owner]) @ model.R
    links = model.links
    if links is not None:
        assert delivered is not None
        nx = links.V.shape[1]
        for term in np.flatnonzero(links.mode == s):
            i, j = links.receiver[term], links.sender[term]
            xi = delivered[i, j] - links.rho[term]
            if links.with_loss[term]:
                xi *= theta[j] - model.beta[j]
            first = model.plant_states + i * nx
            AB[first : first + nx, links.columns[term]] += xi * links.V[term]
    return AB


def step(
    model: ErrorModel, s: int, theta: Array, eta: Array, w: Array, delivered: NDArray[np.bool_] | None = None
) -> Array:
    """Eq. (10) for one step in mode s: eta(k+1), (n_eta,), from what arrived, eta (n_eta,) and w (nw,)."""
    return np.asarray(realised(model, s, theta, delivered) @ np.concatenate([eta, w]))
