"""The linear matrix inequalities. Only the modules in here import cvxpy or a conic solver."""

from __future__ import annotations

from typing import NamedTuple

from agent.contract.arrays import Array
from agent.contract.gains import Solver


class LmiSolution(NamedTuple):
    """What a solver says of a design LMI. It is believed only after designer.certificate has checked it."""

    gamma: float  # sqrt(delta) of (42)
    R: Array  # (nx, nx), over the state x of the plant; (0, 0) where the errors do not depend on x
    Q: Array  # (modes, n, nx, nx): Q_i(s)
    X: Array  # (modes, n nx, sum ny): X^s = Q_bar(s) H_bar^s
    Y: Array  # (modes, n nx, n nx): Y^s = Q_bar(s) K_bar^s
    solver: Solver
