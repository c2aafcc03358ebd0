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
from designer.model.error_model import ErrorModel, error_model, measurement_slices
from designer.model.links import Innovations, LinkTerms, link_terms


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
    innovation, alpha = innovations(problem, told, real, p), real.beta * (1.0 - real.beta)
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
        alpha=alpha,
        transition=real.transition,
        plant_states=p,
        rows=rows,
        links=link_terms(problem, innovation, K_bar, H_bar, rho=real.rho, alpha=alpha),
    )


def innovations(problem: Problem, told: Array, real: Real, p: int) -> Innovations:
    """Those of filters that have the C_i of `problem`, and beta = `told`; ValueError where they need x, and p is 0."""
    nx, n, all_rows = problem.nx, problem.n, measurement_slices(problem)
    ny, size = all_rows[-1].stop, p + n * nx
    by_x, by_e, by_w = np.zeros((ny, nx)), np.zeros((ny, n * nx)), np.zeros((ny, problem.nw))
    lost = np.zeros((ny, size + problem.nw))
    for j, (node, rows) in enumerate(zip(problem.nodes, all_rows, strict=True)):
        C, D, beta, c = real.matrices.C[j], real.matrices.D[j], real.beta[j], told[j]
        e_j = slice(j * nx, (j + 1) * nx)
        if node.seen:
            by_x[rows], by_e[rows, e_j], by_w[rows] = beta * (C - node.C), beta * node.C, beta * D
            lost[rows, p + j * nx : p + (j + 1) * nx], lost[rows, size:] = node.C, D
            lost[rows, :p] = (C - node.C)[:, :p]
        else:
            by_x[rows], by_e[rows, e_j], by_w[rows] = beta * C - c * node.C, c * node.C, D
            lost[rows, :p] = C[:, :p]
    if not p and by_x.any():
        raise ValueError("the errors contain x, which is left out")
    return Innovations(all_rows, by_x[:, :p], by_e, by_w, lost)
