"""A disturbance that no node sees, and what Theorem 1 cannot undercut because of it: a bound from below in closed form.

In mode s let S be nodes that hear nobody outside S. Let x = e_j = f for all j in S, so that their estimates are 0, and
let w = W f cancel the mean of what each of them measures. Whatever the gains, x+ and the mean of every e_j+ are then
(A + B W)f. If that is lambda f, with pi_ss lambda^2 >= 1, what (17) says of this vector is, by (18),

    |W f|^2 >= (lambda^2 - 1) sum over S of |M f|^2 / gamma^2:

with the weights of nodes in M. The terms of R and of Q_j(s) are on the right side with factors >= 0. In
`designer.proof.least` a family of matrices has to be positive definite; where the best weights are on a line whose
direction is no fraction, this is left.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from flint import acb, acb_mat, arb, arb_mat, ctx

from agent.contract.problem import Problem
from designer.proof.ball_model import told
from designer.proof.balls import exact
from designer.proof.least import float_below

_BITS = 256


def at_least_by_silence(problem: Problem) -> float | None:
    """gamma that no gains and no P = diag{R, Q(s)} satisfy (17) and (18) below; None where all is seen or decays."""
    with ctx.workprec(_BITS):
        found = [float_below(bound) for bound in _bounds(problem)]
    return max((bound for bound in found if bound is not None), default=None)


def _bounds(problem: Problem) -> Iterator[arb]:
    """Of every mode, set of nodes and real eigenvalue."""
    M, B, transition = exact(problem.plant.M), exact(problem.plant.B), told(problem).transition
    for s in range(len(problem.topologies)):
        stays = arb(transition[s][s].numerator) / arb(transition[s][s].denominator)
        for nodes in {_closed(problem, s, i) for i in range(problem.n)}:
            W = _hiding(problem, sorted(nodes))
            if W is None:
                continue
            for value, f in _real_pairs(exact(problem.plant.A) + B * W):
                if stays * value**2 >= 1:
                    seen = sum((arb(float(problem.weights[j])) ** 2 for j in nodes), arb(0)) * _square(M * f)
                    yield ((value**2 - 1) * seen / _square(W * f)).sqrt()


def _closed(problem: Problem, s: int, i: int) -> frozenset[int]:
    """Node i, whom it hears in mode s, whom they hear, and so on."""
    found, new = frozenset([i]), frozenset([i])
    while new:
        new = frozenset(j for k in new for j in problem.neighbours(s, k)) - found
        found |= new
    return found


def _hiding(problem: Problem, nodes: list[int]) -> arb_mat | None:
    """W of least norm with C + D W = 0 for what these nodes measure in the mean; None where floats see none."""
    heard = [problem.nodes[j] for j in nodes]
    D = np.vstack([node.D for node in heard])
    if np.linalg.matrix_rank(D) < len(D):
        return None
    C = [exact(node.C) * (1 if node.seen else arb(node.arrival_probability)) for node in heard]
    rows = [C_j[k, m] for C_j in C for k in range(C_j.nrows()) for m in range(problem.nx)]
    by_w = exact(D)
    try:
        return -(by_w.transpose() * (by_w * by_w.transpose()).solve(arb_mat(len(D), problem.nx, rows)))
    except ZeroDivisionError:
        return None


def _real_pairs(A: arb_mat) -> Iterator[tuple[arb, arb_mat]]:
    """Every simple real eigenvalue with its vector; nothing where balls do not tell them apart."""
    try:
        values, vectors = acb_mat(A).eig(right=True)
    except ValueError:
        return
    for k, value in enumerate(values):
        mirrored = acb(value.real, -value.imag)
        if any(mirrored.overlaps(other) for m, other in enumerate(values) if m != k):
            continue  # else the mirrored one, which is an eigenvalue too, is this one: it is real
        column = [vectors[i, k] for i in range(A.nrows())]
        largest = max(column, key=lambda entry: float(abs(entry).mid()))
        if not abs(largest) > 0:
            continue
        yield value.real, arb_mat(A.nrows(), 1, [(entry / largest).real for entry in column])


def _square(v: arb_mat) -> arb:
    return sum((entry**2 for entry in v.entries()), arb(0))
