"""The decomposed LMI written once more, with cvxpy and in the letters of theory.md: the witness for decomposed.py.

The balance is one large matrix here, and every node has its S_i. Slower by far, and independent of the cone data.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import cvxpy as cp
import numpy as np

from agent.contract.problem import Problem

Link = tuple[int, int]  # (i, j): node i hears node j


class WitnessMode(NamedTuple):
    """The unknowns of one mode, and its matrices that have to be positive semidefinite."""

    Q: list[Any]  # Q_i, (nx, nx)
    X: dict[Link, Any]  # (nx, ny_j)
    Y: dict[Link, Any]  # (nx, nx)
    S: list[Any]  # over (x, w, e_N)
    T: dict[Link, Any]  # (ny_j, ny_j), where alpha_j > 0
    nodes: list[Any]
    links: dict[Link, Any]
    balance: Any
    peaks: list[Any]


class Witness(NamedTuple):
    """Minimise delta, over all modes."""

    delta: Any
    R: Any
    modes: list[WitnessMode]
    problem: cp.Problem


def witness(problem: Problem) -> Witness:
    """The whole problem."""
    nx, n = problem.nx, problem.n
    delta, R = cp.Variable(nonneg=True), cp.Variable((nx, nx), symmetric=True)
    Q = [[cp.Variable((nx, nx), symmetric=True) for _ in range(n)] for _ in problem.topologies]
    modes = [_mode(problem, s, delta, R, Q) for s in range(len(Q))]
    constraints = [
        matrix >> 0 for mode in modes for matrix in (*mode.nodes, *mode.links.values(), mode.balance, *mode.peaks)
    ]
    return Witness(delta, R, modes, cp.Problem(cp.Minimize(delta), [R >> 0, *constraints]))


def _mode(problem: Problem, s: int, delta: Any, R: Any, Q: list[list[Any]]) -> WitnessMode:
    plant, nx, nw, n = problem.plant, problem.nx, problem.nw, problem.n
    beta, C, D = problem.beta, [node.C for node in problem.nodes], [node.D for node in problem.nodes]
    N = [problem.neighbours(s, i) for i in range(n)]
    links = [(i, j) for i in range(n) for j in N[i]]
    X = {(i, j): cp.Variable((nx, len(C[j]))) for i, j in links}
    Y = {link: cp.Variable((nx, nx)) for link in links}
    S = [_symmetric(nx + nw + nx * len(N[i])) for i in range(n)]
    T = {(i, j): _symmetric(len(C[j])) for i, j in links if beta[j] < 1.0}
    Q_bar = [sum(weight * Q[t][i] for t, weight in enumerate(problem.markov.transition[s])) for i in range(n)]

    nodes = []
    for i in range(n):
        G_x = Q_bar[i] @ plant.A - sum(Y[i, j] for j in N[i])
        G_w = Q_bar[i] @ plant.B - sum(X[i, j] @ D[j] for j in N[i])
        G_e = [Y[i, j] - beta[j] * X[i, j] @ C[j] for j in N[i]]
        G = cp.hstack([G_x, G_w, *G_e])
        nodes.append(cp.bmat([[S[i], G.T], [G, Q_bar[i]]]))
    link_matrices = {(i, j): cp.bmat([[T_ij, X[i, j].T], [X[i, j], Q_bar[i]]]) for (i, j), T_ij in T.items()}

    rows = np.eye(nx + nw + n * nx)  # row k picks entry k of (x, w, e)
    xw, x = rows[: nx + nw], rows[:nx]
    e = [rows[nx + nw + i * nx :][:nx] for i in range(n)]
    A_B = np.hstack([plant.A, plant.B])
    balance = x.T @ R @ x + rows[nx : nx + nw].T @ rows[nx : nx + nw] - (A_B @ xw).T @ R @ (A_B @ xw)
    for i in range(n):
        embed = np.vstack([xw, *(e[j] for j in N[i])])
        balance = balance + e[i].T @ Q[s][i] @ e[i] - embed.T @ S[i] @ embed
    for (_, j), T_ij in T.items():
        balance = balance - beta[j] * (1.0 - beta[j]) * (C[j] @ x).T @ T_ij @ (C[j] @ x)

    M, nz = plant.M, problem.nz
    peaks = [cp.bmat([[Q_i, M.T], [M, delta * np.eye(nz)]]) for Q_i in Q[s]]
    return WitnessMode(Q[s], X, Y, S, T, nodes, link_matrices, balance, peaks)


def _symmetric(order: int) -> Any:
    return cp.Variable((order, order), symmetric=True)
