"""What links that lose messages do to the errors, beside what they do on average (docs/theory.md, section 9)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agent.contract.arrays import Array
from agent.contract.problem import Problem


@dataclass(frozen=True, eq=False)
class LinkTerms:
    """What lossy links do to the errors: xi_l V_l [eta; w] is added to e of one node, for every l, in one mode.

    xi_l is phi_ij - rho_ij, or (phi_ij - rho_ij)(theta_j - beta_j) where `with_loss`. Only some columns of V_l are
    not zero, and those are kept.
    """

    mode: NDArray[np.intp]  # (terms,)
    receiver: NDArray[np.intp]  # (terms,): i
    sender: NDArray[np.intp]  # (terms,): j
    with_loss: NDArray[np.bool_]  # (terms,)
    rho: Array  # (terms,): rho_ij
    variance: Array  # (terms,): of xi_l
    columns: NDArray[np.intp]  # (terms, c): of [eta; w]; those of (x, e_i, e_j, w)
    V: Array  # (terms, nx, c)


class Innovations(NamedTuple):
    """Those of all nodes: their mean over theta, by_x x + by_e e + by_w w, and what losses take from them."""

    rows: list[slice]  # of each node
    by_x: Array  # (sum ny, p), p the states of the plant in eta
    by_e: Array  # (sum ny, n nx)
    by_w: Array  # (sum ny, nw)
    lost: Array  # (sum ny, n_eta + nw), of [eta; w]


def link_terms(
    problem: Problem, of: Innovations, K_bar: Array, H_bar: Array, *, rho: Array, alpha: Array
) -> LinkTerms | None:
    """phi_ij - rho_ij multiplies a_ij (K_ij (e_j - e_i) - H_ij times the mean innovation of node j) in e_i.

    Its product with theta_j - beta_j multiplies -a_ij H_ij times what a loss takes from the innovation. `rho` (n, n)
    are the probabilities of delivery, `alpha` (n,) the variances of theta. None where no link loses messages.
    """
    nx, n, p, size = problem.nx, problem.n, of.by_x.shape[1], of.lost.shape[1] - problem.nw
    found = [
        (s, i, j, with_loss)
        for s in range(len(problem.topologies) if (rho < 1.0).any() else 0)
        for i in range(n)
        for j in problem.neighbours(s, i)
        if rho[i, j] < 1.0
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
        mean = [-H_ij @ of.by_x[rows], -K_ij, K_ij - H_ij @ of.by_e[rows, j * nx : (j + 1) * nx]]
        columns.append(here)
        V.append(-H_ij @ of.lost[rows][:, here] if with_loss else np.hstack([*mean, -H_ij @ of.by_w[rows]]))
    mode, receiver, sender, lost_too = (np.array(part) for part in zip(*found, strict=True))
    delivered = rho[receiver, sender]
    return LinkTerms(
        mode=mode,
        receiver=receiver,
        sender=sender,
        with_loss=lost_too.astype(np.bool_),
        rho=delivered,
        variance=delivered * (1.0 - delivered) * np.where(lost_too, alpha[sender], 1.0),
        columns=np.array(columns),
        V=np.array(V),
    )
