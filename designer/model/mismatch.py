"""The error model of a network that does not behave as its filters were told.

The gains and the beta_i in the filters are those of the file; modes, losses and deliveries have other probabilities.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from agent.contract.arrays import Array
from agent.contract.problem import Problem
from designer.model.error_model import ErrorModel, LinkTerms, error_model, measurement_slices


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
    return replace(model, A=A, links=_links(model, truth, off, H_bar))


def _links(model: ErrorModel, truth: Problem, off: list[float], H_bar: Array) -> LinkTerms | None:
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
