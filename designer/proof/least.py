"""What no gains can undercut by Theorem 1 with P(s) = diag{R, Q_1(s), ..., Q_n(s)}, so by Theorem 2, proved in balls.

Let V(s) >= 0 be any weights on [eta; w], one matrix for each mode: (17) weighed by them is

    sum_s tr(V(s) diag{P(s), I}) >= sum_s tr(V(s) S(P)(s)).

What the gains of node i may do to its error in mode s is a regression: weighed by V(s), E e_i+ e_i+' is not below
what its best gains leave, Res_i(s), a Schur complement of moments, and the same gains are best for every Q_bar_i. With

    U_R = sum_s [A B]V(s)[A B]' - V_xx(s),      U_i(t) = sum_s pi_st Res_i(s) - V_ii(t),

all of them >= 0, sum_s tr V_ww(s) >= sum_it tr(Q_i(t) U_i(t)), and Q_i(t) >= M'M / gamma^2 by (18): hence gamma^2 >=
sum_it tr(M U_i(t) M') / sum_s tr V_ww(s), with the weight of node i in M. Nothing is asked of where V comes from;
docs/theory.md, section 6.
"""

from __future__ import annotations

from fractions import Fraction
from typing import Any, NamedTuple

import numpy as np
from flint import arb, arb_mat, ctx, fmpq, fmpq_mat
from numpy.typing import NDArray

from agent.contract.arrays import Array
from agent.contract.problem import Problem
from designer.proof.ball_model import told
from designer.proof.balls import diagonal, exact, identity, part, sign
from designer.proof.by_balls import symmetric

_BITS = 256

Indices = NDArray[np.intp]


def at_least(problem: Problem, V: Array, T: Array | None = None) -> float | None:
    """gamma that no gains and no P = diag{R, Q(s)} satisfy (17) and (18) below; None where V proves nothing.

    V (modes, n_eta + nw, n_eta + nw): weights, of which (V + V')/2 counts. Rows of zeros weigh nothing. With T (nx, nx)
    they weigh [T x; T e; w], where signs are looked at too.
    """
    if not np.isfinite(V).all():
        return None
    with ctx.workprec(_BITS):
        try:
            weighed = [np.flatnonzero(V_s.any(axis=0) | V_s.any(axis=1)) for V_s in V]
            return _proved(problem, symmetric(V), weighed, None if T is None else exact(T))
        except ZeroDivisionError:  # a matrix that is singular, as far as balls know it
            return None


def _proved(problem: Problem, V: list[arb_mat], weighed: list[Indices], T: arb_mat | None) -> float | None:
    nx, p, nw, pi = problem.nx, problem.plant_states, problem.nw, told(problem).transition
    if not all(_positive(part(V_s, at.tolist(), at.tolist())) for V_s, at in zip(V, weighed, strict=True)):
        return None
    if T is not None:
        V, weighed = _among_states(problem, V, weighed, T.inv())
    if p and not _positive(_turned(_left_for_R(problem, V), T)):
        return None
    M, gained, spent = _balls(_rational(problem.plant.M)), arb(0), arb(0)
    for i in range(problem.n):
        e_i = _places(problem, i)
        residuals = [_residual(regression(problem, s, i), V_s, weighed[s]) for s, V_s in enumerate(V)]
        for t, V_t in enumerate(V):
            U = sum((Res * _ball(pi[s][t]) for s, Res in enumerate(residuals)), arb_mat(nx, nx)) - part(V_t, e_i, e_i)
            if np.isin(e_i, weighed[t]).any() and not _positive(_turned(U, T)):  # else U is a sum of Res >= 0
                return None
            gained += _trace(M * U * M.transpose()) * arb(float(problem.weights[i])) ** 2
    for V_s in V:
        w = range(V_s.nrows() - nw, V_s.nrows())
        spent += _trace(part(V_s, w, w))
    return float_below((gained / spent).sqrt()) if gained > 0 and spent > 0 else None


def _among_states(
    problem: Problem, V: list[arb_mat], weighed: list[Indices], inverse: arb_mat
) -> tuple[list[arb_mat], list[Indices]]:
    """Weights on [T x; T e; w] as they weigh [x; e; w]."""
    nx, size = problem.nx, V[0].nrows()
    back, firsts = identity(size), range(0, size - problem.nw, nx)
    for first in firsts:
        for i, j in np.ndindex(nx, nx):
            back[first + i, first + j] = inverse[i, j]
    w = np.arange(size - problem.nw, size)
    together = [*(np.arange(first, first + nx) for first in firsts), *w[:, None]]
    weighed = [np.concatenate([at for at in together if np.isin(at, found).any()]) for found in weighed]
    return [back * V_s * back.transpose() for V_s in V], weighed


def _turned(U: arb_mat, T: arb_mat | None) -> arb_mat:
    """T U T', whose sign is that of U."""
    return U if T is None else T * U * T.transpose()


def _left_for_R(problem: Problem, V: list[arb_mat]) -> arb_mat:
    """U_R."""
    x, n_eta = list(range(problem.nx)), problem.nx * (problem.n + 1)
    xw, AB = x + list(range(n_eta, n_eta + problem.nw)), np.hstack([problem.plant.A, problem.plant.B])
    exact_AB, U = _balls(_rational(AB)), arb_mat(problem.nx, problem.nx)
    for V_s in V:
        U += exact_AB * part(V_s, xw, xw) * exact_AB.transpose() - part(V_s, x, x)
    return U


def _residual(found: Regression, V: arb_mat, weighed: Indices) -> arb_mat:
    """What the best gains leave of E e_i+ e_i+', (nx, nx): a Schur complement, as far as balls know it."""
    at = weighed.tolist()
    V, found = part(V, at, at), found.over(weighed)
    t, mean = _balls(found.t), _balls(found.mean)
    left, across, gram = t * V * t.transpose(), t * V * mean.transpose(), mean * V * mean.transpose()
    for variance, noise in found.noises:
        gram += _balls(noise) * V * _balls(noise).transpose() * _ball(variance)
    return left - across * gram.solve(across.transpose()) if gram.nrows() else left


class Regression(NamedTuple):
    """e_i+ = t - G mean - sum of xi_l G noise_l of node i in one mode, over [eta; w], for any gains G; in fractions."""

    t: Any  # (nx, n_eta + nw)
    mean: Any  # (regressors, n_eta + nw)
    noises: list[tuple[Fraction, Any]]  # the variance of xi_l, not 0, and the matrix

    def over(self, columns: Indices) -> Regression:
        """As the other columns are 0, by regressors that do not depend on each other: gains of more say no more."""
        mean, noises = self.mean[:, columns], [(variance, noise[:, columns]) for variance, noise in self.noises]
        kept = _independent(np.hstack([mean, *(noise for _, noise in noises)]))
        return Regression(self.t[:, columns], mean[kept], [(variance, noise[kept]) for variance, noise in noises])


def regression(problem: Problem, s: int, i: int) -> Regression:
    """With one regressor for each column of K_ij and H_ij; where gains are unbiased, K_ii is what the others leave."""
    nx, p, n_eta = problem.nx, problem.plant_states, problem.plant_states + problem.n * problem.nx
    x, w, eye = slice(p), slice(n_eta, n_eta + problem.nw), _rational(np.eye(nx))
    t = _zeros(nx, w.stop)
    t[:, _e(problem, i) if problem.unbiased else x] = _rational(problem.plant.A)
    t[:, w] = _rational(problem.plant.B)
    means: list[Any] = []
    noises: list[tuple[Fraction, int, Any]] = []
    for j in problem.neighbours(s, i):
        node, rho = problem.nodes[j], Fraction(problem.delivery[i, j].item())
        beta, C, D = Fraction(node.arrival_probability), _rational(node.C), _rational(node.D)
        K, H, lost = _zeros(nx, w.stop), _zeros(len(C), w.stop), _zeros(nx + len(C), w.stop)
        K[:, _e(problem, i)] += eye
        K[:, _e(problem, j)] -= eye
        H[:, _e(problem, j)], H[:, w] = C * beta, D * beta if node.seen else D
        if node.seen:
            lost[nx:, _e(problem, j)], lost[nx:, w] = C, D
        elif p:
            lost[nx:, x] = C
        own = _zeros(nx + len(C), w.stop)  # x_hat_i, which is there in any case
        if not problem.unbiased:
            own[:nx, x], own[:nx, _e(problem, i)] = eye, -eye
        sent = np.vstack([K, H])
        at = sum(len(matrix) for matrix in means)
        means.append(own + sent * rho)
        noises.append((rho * (1 - rho), at, sent))
        noises.append((rho * beta * (1 - beta), at, lost))
    mean = np.vstack(means)
    return Regression(
        t, mean, [(variance, _placed(noise, at, mean.shape)) for variance, at, noise in noises if variance]
    )


def _independent(rows: Any) -> list[int]:
    """Rows that span all: gains for the others say nothing that gains for these do not."""
    if not rows.size:
        return []
    columns = fmpq_mat(rows.shape[1], rows.shape[0], [fmpq(f.numerator, f.denominator) for f in rows.T.reshape(-1)])
    reduced, rank = columns.rref()
    return [next(j for j in range(len(rows)) if reduced[k, j] != 0) for k in range(rank)]


def _e(problem: Problem, j: int) -> slice:
    first = problem.plant_states + j * problem.nx
    return slice(first, first + problem.nx)


def _places(problem: Problem, j: int) -> list[int]:
    return list(range(problem.plant_states + problem.n * problem.nx))[_e(problem, j)]


def _placed(matrix: Any, at: int, shape: tuple[int, ...]) -> Any:
    whole = _zeros(*shape)
    whole[at : at + len(matrix)] = matrix
    return whole


def _zeros(*shape: int) -> Any:
    return np.full(shape, Fraction(0), dtype=object)


def _rational(matrix: Array) -> Any:
    """The floats as they are, an array of fractions."""
    return np.array([[Fraction(entry) for entry in row] for row in matrix.tolist()], dtype=object).reshape(matrix.shape)


def _balls(matrix: Any) -> arb_mat:
    rows, columns = matrix.shape
    return arb_mat(rows, columns, [_ball(entry) for entry in matrix.reshape(-1)])


def _ball(number: Fraction) -> arb:
    return arb(number.numerator) / arb(number.denominator)


def _positive(U: arb_mat) -> bool:
    return sign(U, np.abs(diagonal(U))).proved


def _trace(matrix: arb_mat) -> arb:
    return sum((matrix[i, i] for i in range(matrix.nrows())), arb(0))


def float_below(ball: arb) -> float | None:
    """A float that is not above what is in the ball; None where that is not positive."""
    found = float(np.nextafter(float(ball.lower()), -np.inf))
    return found if np.isfinite(found) and found > 0.0 else None
