"""The linear matrix inequalities. Only the modules in here import cvxpy or a conic solver."""

from __future__ import annotations

from typing import NamedTuple

from agent.contract.arrays import Array
from agent.contract.gains import Solver
from agent.contract.problem import Problem


class LmiSolution(NamedTuple):
    """What a solver says of a design LMI. It is believed only after designer.proof has checked it."""

    gamma: float  # sqrt(delta) of (42)
    R: Array  # (nx, nx), over the state x of the plant; (0, 0) where the errors do not depend on x
    Q: Array  # (modes, n, nx, nx): Q_i(s)
    X: Array  # (modes, n nx, sum ny): X^s = Q_bar(s) H_bar^s
    Y: Array  # (modes, n nx, n nx): Y^s = Q_bar(s) K_bar^s
    solver: Solver
    weights: Array | None = None  # (modes, n_eta + nw, n_eta + nw): multipliers of the balance, over [x; e; w]


def beyond_paper(problem: Problem) -> str | None:
    """The first part of the problem that Theorem 2 does not know, in words; None: it is the paper's problem."""
    for node in problem.nodes:
        if node.seen and node.arrival_probability < 1.0:
            return f'node "{node.name}" sees its losses'
    for link in problem.links or ():
        if link.delivery_probability < 1.0:
            return f'the link from "{link.sender}" to "{link.receiver}" loses messages'
    return "the gains have to be unbiased" if problem.unbiased else None
