"""From the boundary of the design LMI, where a solver's answer lies, a small step inwards, P staying diag{R, Q(s)}.

By Schur complements (17) is a matrix inequality linear in (R, Q, X, Y). So a mean of the solver's answer and of a
strictly feasible point has its share of what that point has to spare. Such a point is known for every stable plant:
the network that ignores all measurements and messages, K_ii = A, H = 0, which no loss touches and which is unbiased.
There x and every e_i move alike, x+ = A x + B w, so P = c diag{W, ..., W} with W - A'WA = V > 0 leaves in (17)

    [c diag{V, ..., V}, -c [A'WB; ...]; *, I - c m B'WB],

m blocks: n + 1, or n where x is left out. That is at least diag{c V/2, ..., I/2} if
c <= 1 / (2 m lambda_max(B'WB + 2 B'WA V^-1 A'WB)). (18) gains too: Q grows.
"""

from __future__ import annotations

import numpy as np

from agent.contract.arrays import Array
from agent.contract.problem import Problem
from designer.lmi import LmiSolution

_DOUBLINGS = 60  # 2^60 terms of the sum of A'^k V A^k


def inwards(problem: Problem, solution: LmiSolution, t: float) -> LmiSolution:
    """(1 - t) times the answer, and t times the network that ignores everything: gamma grows by t/2 of itself.

    For a stable plant. R stays (0, 0) where x is left out.
    """
    W = idle(problem, solution)
    kept, n = 1.0 - t, problem.n
    R = kept * solution.R + t * W if solution.R.size else solution.R
    Q = kept * solution.Q + t * W
    Y = kept * solution.Y + t * np.kron(np.eye(n), W @ problem.plant.A)
    return solution._replace(R=R, Q=Q, X=kept * solution.X, Y=Y)


def idle(problem: Problem, solution: LmiSolution) -> Array:
    """c W of this module's first lines, (nx, nx); V is diagonal, in the units of the answer's Q."""
    A, B = problem.plant.A, problem.plant.B
    blocks = problem.n + (1 if problem.plant_states else 0)
    V = np.diag(np.maximum(np.diagonal(solution.Q, axis1=-2, axis2=-1).mean(axis=(0, 1)), np.finfo(float).tiny))
    W, power = V, A
    for _ in range(_DOUBLINGS):
        W, power = W + power.T @ W @ power, power @ power
    AWB = A.T @ W @ B
    worst = np.linalg.eigvalsh(B.T @ W @ B + 2.0 * AWB.T @ np.linalg.solve(V, AWB)).max()
    return np.asarray(W / (2.0 * blocks * worst) if worst > 0.0 else W)
