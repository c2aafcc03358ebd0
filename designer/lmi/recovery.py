"""From a solver's answer to gains and P: eq. (38)."""

from __future__ import annotations

import math

import numpy as np

from agent.contract.arrays import Array
from agent.contract.errors import Unattainable
from agent.contract.gains import LinkMatrices
from agent.contract.problem import Problem
from designer.lmi import LmiSolution
from designer.model.error_model import link_gains


def recover(problem: Problem, solution: LmiSolution) -> tuple[Array, Array]:
    """Eq. (38): K_bar^s = Q_bar(s)^-1 Y^s (modes, n nx, n nx) and H_bar^s = Q_bar(s)^-1 X^s (modes, n nx, sum ny).

    Node by node: Q_bar is block diagonal, so a block that is zero in X and Y stays exactly zero. Where the gains
    have to be unbiased, K_ii is what the other K_ij leave of A.
    """
    modes, n, nx = len(problem.topologies), problem.n, problem.nx
    Q_bar = np.tensordot(problem.markov.transition, solution.Q, axes=1)  # (modes, n, nx, nx)
    try:
        K = np.linalg.solve(Q_bar, solution.Y.reshape(modes, n, nx, -1))
        H = np.linalg.solve(Q_bar, solution.X.reshape(modes, n, nx, -1))
    except np.linalg.LinAlgError:
        raise unconfirmed(problem, solution, "Q_bar(s) is singular") from None
    if problem.unbiased:
        blocks, i = K.reshape(modes, n, nx, n, nx), np.arange(n)
        blocks[:, i, :, i] = 0.0
        blocks[:, i, :, i] = problem.plant.A - blocks.sum(axis=3).swapaxes(0, 1)
    return np.asarray(K).reshape(solution.Y.shape), np.asarray(H).reshape(solution.X.shape)


def block_diagonal(R: Array, Q: Array) -> Array:
    """P(s) = diag{R, Q_1(s), ..., Q_n(s)}, (modes, n_eta, n_eta), from R (nx, nx) or (0, 0), Q (modes, n, nx, nx)."""
    modes, n, nx, _ = Q.shape
    p = len(R)
    P = np.zeros((modes, p + n * nx, p + n * nx))
    P[:, :p, :p] = R
    for i in range(n):
        rows = slice(p + i * nx, p + (i + 1) * nx)
        P[:, rows, rows] = Q[:, i]
    return P


def links(problem: Problem, solution: LmiSolution) -> tuple[LinkMatrices, LinkMatrices]:
    """The gains of every link; Unattainable where they are not numbers."""
    K_bar, H_bar = recover(problem, solution)
    if not (np.isfinite(K_bar).all() and np.isfinite(H_bar).all() and math.isfinite(solution.gamma)):
        raise unconfirmed(problem, solution, "some of its numbers are not finite")
    return link_gains(problem, K_bar, H_bar)


def unconfirmed(problem: Problem, solution: LmiSolution, why: str | None) -> Unattainable:
    return Unattainable(
        f"{solution.solver.name} says {solution.solver.status} with gamma {solution.gamma:.6g} for {problem.name}, "
        f"but the check without a solver does not confirm its answer ({why})"
    )
