"""The decomposed LMI written once more, with cvxpy and in the letters of docs/decomposed.md: the witness.

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
    S: list[Any]  # over (x, w, e_N), less what G_i never has; each node's own w stands after its e_j
    T: dict[Link, Any]  # (ny_j, ny_j), where alpha_j > 0
    U: dict[Link, Any]  # over (e_i, e_j, w), where rho_ij < 1
    nodes: list[Any]
    losses: dict[Link, Any]
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
    delta = cp.Variable(nonneg=True)
    R = cp.Variable((nx, nx), symmetric=True) if problem.carries_plant else None
    Q = [[cp.Variable((nx, nx), symmetric=True) for _ in range(n)] for _ in problem.topologies]
    modes = [_mode(problem, s, delta, R, Q) for s in range(len(Q))]
    matrices = [
        matrix
        for mode in modes
        for matrix in (*mode.nodes, *mode.losses.values(), *mode.links.values(), mode.balance, *mode.peaks)
    ]
    constraints = [matrix >> 0 for matrix in (*matrices, *([] if R is None else [R]))]
    return Witness(delta, R, modes, cp.Problem(cp.Minimize(delta), constraints))


def _mode(problem: Problem, s: int, delta: Any, R: Any, Q: list[list[Any]]) -> WitnessMode:
    plant, nx, nw, n = problem.plant, problem.nx, problem.nw, problem.n
    beta, rho = problem.beta, problem.delivery
    C, D = [node.C for node in problem.nodes], [node.D for node in problem.nodes]
    Dm = [beta[j] * D[j] if problem.nodes[j].seen else D[j] for j in range(n)]
    N = [problem.neighbours(s, i) for i in range(n)]
    links = [(i, j) for i in range(n) for j in N[i]]
    Q_bar = [sum(weight * Q[t][i] for t, weight in enumerate(problem.markov.transition[s])) for i in range(n)]
    X = {(i, j): cp.Variable((nx, len(C[j]))) for i, j in links}
    Y = {(i, j): cp.Variable((nx, nx)) for i, j in links if i != j or not problem.unbiased}
    all_Y = dict(Y)
    if problem.unbiased:
        for i in range(n):
            all_Y[i, i] = Q_bar[i] @ plant.A - sum(Y[i, j] for j in N[i] if j != i)

    p = problem.plant_states
    rows = np.eye(p + nw + n * nx)  # row k picks entry k of (x, w, e)
    x, w = rows[:p], rows[p : p + nw]
    e = [rows[p + nw + i * nx :][:nx] for i in range(n)]
    own = [[k for k in range(nw) if _only(problem, k, j)] for j in range(n)]
    shared = [k for k in range(nw) if not any(k in own_j for own_j in own)]
    balance = w.T @ w
    if p:
        A_B = plant.A @ x + plant.B @ w
        balance = balance + x.T @ R @ x - A_B.T @ R @ A_B

    nodes, S = [], []
    for i in range(n):
        G_x = Q_bar[i] @ plant.A - sum(all_Y[i, j] for j in N[i])
        G_w = Q_bar[i] @ plant.B - sum(rho[i, j] * X[i, j] @ Dm[j] for j in N[i])
        picks, parts = ([], []) if problem.unbiased else ([x], [G_x])
        picks, parts = [*picks, w[shared]], [*parts, G_w[:, shared]]
        for j in N[i]:
            G_j = rho[i, j] * (all_Y[i, j] - beta[j] * X[i, j] @ C[j])
            if j == i:
                G_j = G_j + sum((1.0 - rho[i, k]) * all_Y[i, k] for k in N[i])
            picks, parts = [*picks, e[j], w[own[j]]], [*parts, G_j, G_w[:, own[j]]]
        embed = np.vstack(picks)
        G_i = cp.hstack([part for pick, part in zip(picks, parts, strict=True) if len(pick)])
        S.append(_symmetric(len(embed)))
        nodes.append(cp.bmat([[S[i], G_i.T], [G_i, Q_bar[i]]]))
        balance = balance + e[i].T @ Q[s][i] @ e[i] - embed.T @ S[i] @ embed

    T, losses, U, link_matrices = {}, {}, {}, {}
    for i, j in links:
        if beta[j] < 1.0:
            T[i, j] = _symmetric(len(C[j]))
            losses[i, j] = cp.bmat([[T[i, j], X[i, j].T], [X[i, j], Q_bar[i]]])
            r_j = C[j] @ e[j] + D[j] @ w if problem.nodes[j].seen else C[j] @ x
            balance = balance - beta[j] * (1.0 - beta[j]) * rho[i, j] * r_j.T @ T[i, j] @ r_j
        if rho[i, j] < 1.0:
            at_j = [*shared, *own[j]]
            U[i, j] = _symmetric(2 * nx + len(at_j))
            V_ij = cp.hstack([-Y[i, j], Y[i, j] - beta[j] * X[i, j] @ C[j], -X[i, j] @ Dm[j][:, at_j]])
            link_matrices[i, j] = cp.bmat([[U[i, j], V_ij.T], [V_ij, Q_bar[i]]])
            embed = np.vstack([e[i], e[j], w[at_j]])
            balance = balance - rho[i, j] * (1.0 - rho[i, j]) * embed.T @ U[i, j] @ embed

    M, nz = plant.M, problem.nz
    peaks = [
        cp.bmat([[Q_i, weight * M.T], [weight * M, delta * np.eye(nz)]])
        for weight, Q_i in zip(problem.weights, Q[s], strict=True)
    ]
    return WitnessMode(Q[s], X, Y, S, T, U, nodes, losses, link_matrices, balance, peaks)


def _only(problem: Problem, k: int, j: int) -> bool:
    """Whether entry k of w disturbs node j, and neither the plant nor another node."""
    others = [node.D for i, node in enumerate(problem.nodes) if i != j]
    elsewhere = any(bool(matrix[:, k].any()) for matrix in (problem.plant.B, *others))
    return bool(problem.nodes[j].D[:, k].any()) and not elsewhere


def _symmetric(order: int) -> Any:
    return cp.Variable((order, order), symmetric=True)
