"""The error model of a network that does not behave as its filters were told.

The gains are those of the file, and so are beta_i, C_i and M in the filters; what happens has other probabilities and
other matrices (docs/theory.md, sections 12 and 13).
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from agent.contract.arrays import Array
from agent.contract.problem import Problem
from agent.contract.problem.matrices import Matrices
from designer.model.error_model import ErrorModel, LinkTerms, error_model, measurement_slices


class Real(NamedTuple):
    """What is: probabilities of arrival (n,), of delivery (n, n), Pi, and the matrices."""

    beta: Array
    rho: Array
    transition: Array
    matrices: Matrices


def error_model_of(truth: Problem, told: Array, K_bar: Array, H_bar: Array) -> ErrorModel:
    """Eq. (10) of `truth` where the filters use the arrival probabilities `told` (n,).

    A node that sees its losses uses none. One that does not has nu_i = theta_i C_i x + D_i w - c_i C_i x_hat_i with
    c_i = told; for true beta_i its mean is c_i C_i e_i + (beta_i - c_i) C_i x + D_i w: x feeds the errors, which it
    does in the model of the file by loss alone (docs/theory.md, section 12).
    """
    model, p, nx = error_model(truth, K_bar, H_bar), truth.plant_states, truth.nx
    off = [0.0 if node.seen else float(b - c) for node, b, c in zip(truth.nodes, truth.beta, told, strict=True)]
    if not any(off):
        return model
    A, rows = model.A.copy(), measurement_slices(truth)
    for j, node in enumerate(truth.nodes):
        of_j = model.H[:, :, rows[j]] @ (off[j] * node.C)  # (modes, n nx, nx)
        A[:, p:, p + j * nx : p + (j + 1) * nx] += of_j
        A[:, p:, :p] -= of_j
    return replace(model, A=A, links=_mean_links(model, truth, off, H_bar))


def _mean_links(model: ErrorModel, truth: Problem, off: list[float], H_bar: Array) -> LinkTerms | None:
    """Where a message is lost, so is that part of its mean innovation."""
    if model.links is None:
        return None
    links, p, nx, rows = model.links, truth.plant_states, truth.nx, measurement_slices(truth)
    V = links.V.copy()
    for term in np.flatnonzero(~links.with_loss):
        s, i, j = int(links.mode[term]), int(links.receiver[term]), int(links.sender[term])
        of_j = H_bar[s, i * nx : (i + 1) * nx, rows[j]] @ (off[j] * truth.nodes[j].C)
        V[term, :, p + nx : p + 2 * nx] += of_j  # the columns are those of (x, e_i, e_j, w)
        V[term, :, :p] -= of_j
    return replace(links, V=V)


def real_error_model(
    problem: Problem, told: Array, real: Real, K_bar: Array, H_bar: Array, *, carry: bool
) -> ErrorModel:
    """Eq. (10) of what is `real`, where the filters have the C_i and M of `problem`, and beta = `told` (n,).

    `carry`: x is in eta. It has to be where the errors depend on it, which they do through every mismatch but those
    of B, of D, and of the beta_i of nodes that see their losses.
    """
    nx, n, p, rows = problem.nx, problem.n, problem.nx if carry else 0, measurement_slices(problem)
    innovation = Innovation(problem, told, real, p)
    rho_K = np.kron(real.rho, np.ones((nx, nx)))
    H = H_bar * np.repeat(np.repeat(real.rho, nx, axis=0), [len(node.C) for node in problem.nodes], axis=1)
    size, modes = p + n * nx, len(K_bar)
    A, B = np.zeros((modes, size, size)), np.zeros((modes, size, problem.nw))
    A[:, p:, p:] = rho_K * K_bar - H @ innovation.by_e
    undelivered = ((1.0 - rho_K) * K_bar).reshape(modes, n, nx, n, nx).sum(axis=3)
    for i in range(n):
        part = slice(p + i * nx, p + (i + 1) * nx)
        A[:, part, part] += undelivered[:, i]
    B[:, p:] = np.tile(real.matrices.B, (n, 1)) - H @ innovation.by_w
    off, weights = real.matrices.M - problem.plant.M, problem.weights
    M = np.hstack([np.kron(weights[:, None], off)[:, :p], np.kron(np.diag(weights), problem.plant.M)])
    if p:
        A[:, :p, :p], B[:, :p] = real.matrices.A, real.matrices.B
        taken = (
            np.tile(problem.plant.A, (n, 1)) if problem.unbiased else K_bar.reshape(modes, n * nx, n, nx).sum(axis=2)
        )
        A[:, p:, :p] = np.tile(real.matrices.A, (n, 1)) - taken - H @ innovation.by_x
    return ErrorModel(
        A=A,
        B=B,
        H=H,
        R=innovation.lost,
        M=M,
        beta=real.beta,
        alpha=real.beta * (1.0 - real.beta),
        transition=real.transition,
        plant_states=p,
        rows=rows,
        links=_links(problem, real, innovation, K_bar, H_bar),
    )


class Innovation:
    """Its mean over theta, by_x x + by_e e + by_w w for all nodes, and what a loss takes from it, lost [eta; w]."""

    def __init__(self, problem: Problem, told: Array, real: Real, p: int) -> None:
        nx, n, nw, self.rows, self.p = problem.nx, problem.n, problem.nw, measurement_slices(problem), p
        ny, size = self.rows[-1].stop, p + problem.n * problem.nx
        self.by_x, self.by_e, self.by_w = np.zeros((ny, nx)), np.zeros((ny, n * nx)), np.zeros((ny, nw))
        self.lost = np.zeros((ny, size + nw))
        for j, (node, rows) in enumerate(zip(problem.nodes, self.rows, strict=True)):
            C, D, beta, c = real.matrices.C[j], real.matrices.D[j], real.beta[j], told[j]
            e_j = slice(j * nx, (j + 1) * nx)
            if node.seen:
                self.by_x[rows], self.by_e[rows, e_j], self.by_w[rows] = beta * (C - node.C), beta * node.C, beta * D
                self.lost[rows, p + j * nx : p + (j + 1) * nx], self.lost[rows, size:] = node.C, D
                self.lost[rows, :p] = (C - node.C)[:, :p]
            else:
                self.by_x[rows], self.by_e[rows, e_j], self.by_w[rows] = beta * C - c * node.C, c * node.C, D
                self.lost[rows, :p] = C[:, :p]
        if not p and self.by_x.any():
            raise ValueError("the errors contain x, which is left out")


def _links(problem: Problem, real: Real, of: Innovation, K_bar: Array, H_bar: Array) -> LinkTerms | None:
    """Where a message may be lost: its own part, and the product with the loss of what it is of."""
    nx, n, p, size = problem.nx, problem.n, of.p, of.lost.shape[1] - problem.nw
    alpha = real.beta * (1.0 - real.beta)
    found = [
        (s, i, j, with_loss)
        for s in range(len(problem.topologies))
        for i in range(n)
        for j in problem.neighbours(s, i)
        if real.rho[i, j] < 1.0
        for with_loss in ((False, True) if alpha[j] > 0.0 else (False,))
    ]
    if not found:
        return None
    columns, V = [], []
    for s, i, j, with_loss in found:
        at_i, at_j = (np.arange(p + node * nx, p + (node + 1) * nx) for node in (i, j))
        here = np.concatenate([np.arange(p), at_i, at_j, np.arange(size, size + problem.nw)])
        K_ij = K_bar[s, i * nx : (i + 1) * nx, j * nx : (j + 1) * nx]
        H_ij, rows = H_bar[s, i * nx : (i + 1) * nx, of.rows[j]], of.rows[j]
        mean = [-H_ij @ of.by_x[rows][:, :p], -K_ij, K_ij - H_ij @ of.by_e[rows, j * nx : (j + 1) * nx]]
        columns.append(here)
        V.append(-H_ij @ of.lost[rows][:, here] if with_loss else np.hstack([*mean, -H_ij @ of.by_w[rows]]))
    mode, receiver, sender, lost_too = (np.array(part) for part in zip(*found, strict=True))
    rho = real.rho[receiver, sender]
    return LinkTerms(
        mode=mode,
        receiver=receiver,
        sender=sender,
        with_loss=lost_too.astype(np.bool_),
        rho=rho,
        variance=rho * (1.0 - rho) * np.where(lost_too, alpha[sender], 1.0),
        columns=np.array(columns),
        V=np.array(V),
    )
