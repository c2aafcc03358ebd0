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

from collections.abc import Iterable, Iterator
from fractions import Fraction
from typing import Any, NamedTuple

import numpy as np
from flint import arb, arb_mat, ctx
from numpy.typing import NDArray

from agent.contract.arrays import Array
from agent.contract.problem import Problem
from designer.coordinates import fractions
from designer.proof.ball_model import told
from designer.proof.balls import diagonal, part, sign
from designer.proof.by_balls import symmetric
from designer.proof.reachable import Seen, rational, seen_from

_BITS = 256

Indices = NDArray[np.intp]


def at_least(problem: Problem, V: Array, T: Array | None = None) -> float | None:
    """gamma that no gains and no P = diag{R, Q(s)} satisfy (17) and (18) below; None where V proves nothing.

    V (modes, n_eta + nw, n_eta + nw): weights on [T x; T e; w], of which (V + V')/2 counts, with T (r, nx) for r
    states that w can bring about (`designer.proof.reachable`); T None: for the states as they are. Rows of zeros weigh
    nothing. Other zeros, at which nothing looks, stand for whatever makes V(s) >= 0, if anything does.
    """
    if not np.isfinite(V).all():
        return None
    with ctx.workprec(_BITS):
        try:
            seen = seen_from(problem, T)
            if seen is None or V.shape[1:] != 2 * (_w(problem, seen) + problem.nw,):
                return None
            regressions = [[regression(problem, s, i, seen) for s in range(len(V))] for i in range(problem.n)]
            return _proved(problem, seen, regressions, V)
        except ZeroDivisionError:  # a matrix that is singular, as far as balls know it
            return None


def _proved(problem: Problem, seen: Seen, regressions: list[list[Regression]], given: Array) -> float | None:
    pi, w = told(problem).transition, _w(problem, seen)
    weighed, V = [_weighed(V_s) for V_s in given], symmetric(given)
    for s, V_s in enumerate(V):
        looked_at = [_of_R(problem, seen)]
        for i, of_node in enumerate(regressions):
            looked_at.append(np.union1d(np.flatnonzero(of_node[s].columns), _places(problem, seen, i)))
        if not all(_positive(part(V_s, at, at)) for at in cliques(_given(given[s], looked_at), weighed[s])):
            return None
    if problem.plant_states and not _positive(_left_for_R(problem, seen, V)):
        return None
    M, gained, spent = _balls(seen.M), arb(0), arb(0)
    for i in range(problem.n):
        e_i = _places(problem, seen, i)
        residuals = [_residual(regressions[i][s], V_s, weighed[s]) for s, V_s in enumerate(V)]
        for t, V_t in enumerate(V):
            parts = (Res * _ball(pi[s][t]) for s, Res in enumerate(residuals))
            U = sum(parts, arb_mat(seen.states, seen.states)) - part(V_t, e_i, e_i)
            if weighed[t][e_i].any() and not _positive(U):  # else U is a sum of Res >= 0
                return None
            gained += _trace(M * U * M.transpose()) * arb(float(problem.weights[i])) ** 2
    for V_s in V:
        spent += _trace(part(V_s, range(w, w + problem.nw), range(w, w + problem.nw)))
    return float_below((gained / spent).sqrt()) if gained > 0 and spent > 0 else None


def _weighed(V: Array) -> NDArray[np.bool_]:
    return np.asarray(V.any(axis=0) | V.any(axis=1))


def _given(V: Array, looked_at: Iterable[Indices]) -> NDArray[np.bool_]:
    """The entries that V says: those that are not 0, and those that are looked at."""
    given = (V != 0.0) | (V.T != 0.0) | np.eye(len(V), dtype=bool)
    for at in looked_at:
        given[np.ix_(at, at)] = True
    return np.asarray(given)


def cliques(given: NDArray[np.bool_], left: NDArray[np.bool_]) -> Iterator[list[int]]:
    """Sets of those rows `left`: where these parts of a matrix are positive definite, so it is, or can be made.

    If only the entries within the cliques of a chordal graph are given, the others can be chosen so (Grone, Johnson,
    Sa and Wolkowicz, Linear Algebra and its Applications 58, 1984). A row whose neighbours are all joined is in one
    clique, and the rest is chordal if all is; where there is no such row the rest is taken as it is.
    """
    left, found = left.copy(), list[set[int]]()
    while left.any():
        near = (np.flatnonzero(given[v] & left) for v in np.flatnonzero(left))
        clique = next((at for at in near if given[np.ix_(at, at)].all()), np.flatnonzero(left))
        if not any(set(clique.tolist()) <= one for one in found):
            found.append(set(clique.tolist()))
            yield clique.tolist()
        outside = left.copy()
        outside[clique] = False
        left[clique] = given[np.ix_(clique, np.flatnonzero(outside))].any(axis=1)


def _left_for_R(problem: Problem, seen: Seen, V: list[arb_mat]) -> arb_mat:
    """U_R."""
    xw, x, moved = _of_R(problem, seen).tolist(), list(range(seen.states)), seen.B.any(axis=0).astype(bool)
    AB, U = _balls(np.hstack([seen.A, seen.B[:, moved]])), arb_mat(seen.states, seen.states)
    for V_s in V:
        U += AB * part(V_s, xw, xw) * AB.transpose() - part(V_s, x, x)
    return U


def _residual(found: Regression, V: arb_mat, weighed: NDArray[np.bool_]) -> arb_mat:
    """What the best gains leave of E e_i+ e_i+', (nx, nx): a Schur complement, as far as balls know it."""
    columns = np.flatnonzero(found.columns & weighed)
    at = columns.tolist()
    V, found = part(V, at, at), found.over(columns)
    t, mean = _balls(found.t), _balls(found.mean)
    left, across, gram = t * V * t.transpose(), t * V * mean.transpose(), mean * V * mean.transpose()
    for variance, noise in found.noises:
        gram += _balls(noise) * V * _balls(noise).transpose() * _ball(variance)
    return left - across * gram.solve(across.transpose()) if gram.nrows() else left


class Regression(NamedTuple):
    """e_i+ = t - G mean - sum of xi_l G noise_l of node i in one mode, over [eta; w], for any gains G; in fractions."""

    t: Any  # (r, n_eta + nw)
    mean: Any  # (regressors, n_eta + nw)
    noises: list[tuple[Fraction, Any]]  # the variance of xi_l, not 0, and the matrix

    @property
    def columns(self) -> NDArray[np.bool_]:
        """Of [eta; w], those that it depends on."""
        return np.vstack([self.t, self.mean, *(noise for _, noise in self.noises)]).any(axis=0).astype(bool)

    def over(self, columns: Indices) -> Regression:
        """As the other columns are 0, by regressors that do not depend on each other: gains of more say no more."""
        mean, noises = self.mean[:, columns], [(variance, noise[:, columns]) for variance, noise in self.noises]
        kept = _independent(np.hstack([mean, *(noise for _, noise in noises)]))
        return Regression(self.t[:, columns], mean[kept], [(variance, noise[kept]) for variance, noise in noises])


def regression(problem: Problem, s: int, i: int, seen: Seen) -> Regression:
    """With one regressor for each column of K_ij and H_ij; where gains are unbiased, K_ii is what the others leave."""
    r, at_w = seen.states, _w(problem, seen)
    x, w, eye = slice(r if problem.plant_states else 0), slice(at_w, at_w + problem.nw), fractions(np.eye(r))

    def e(j: int) -> slice:
        return slice(x.stop + j * r, x.stop + (j + 1) * r)

    t = _zeros(r, w.stop)
    t[:, e(i) if problem.unbiased else x] = seen.A
    t[:, w] = seen.B
    means: list[Any] = []
    noises: list[tuple[Fraction, int, Any]] = []
    for j in problem.neighbours(s, i):
        node, rho = problem.nodes[j], Fraction(problem.delivery[i, j].item())
        beta, C, D = Fraction(node.arrival_probability), seen.C[j], fractions(node.D)
        K, H, lost = _zeros(r, w.stop), _zeros(len(C), w.stop), _zeros(r + len(C), w.stop)
        K[:, e(i)] += eye
        K[:, e(j)] -= eye
        H[:, e(j)], H[:, w] = C * beta, D * beta if node.seen else D
        if node.seen:
            lost[r:, e(j)], lost[r:, w] = C, D
        elif x.stop:
            lost[r:, x] = C
        own = _zeros(r + len(C), w.stop)  # x_hat_i, which is there in any case
        if not problem.unbiased:
            own[:r, x], own[:r, e(i)] = eye, -eye
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
    reduced, rank = rational(rows.T).rref()
    return [next(j for j in range(len(rows)) if reduced[k, j] != 0) for k in range(rank)]


def _w(problem: Problem, seen: Seen) -> int:
    """Where w begins in [eta; w]."""
    return seen.states * (problem.n + (1 if problem.plant_states else 0))


def _places(problem: Problem, seen: Seen, j: int) -> list[int]:
    """Of e_j."""
    first = _w(problem, seen) - seen.states * (problem.n - j)
    return list(range(first, first + seen.states))


def _of_R(problem: Problem, seen: Seen) -> Indices:
    """Of x and what moves it in w, if x is there."""
    if not problem.plant_states:
        return np.zeros(0, dtype=np.intp)
    return np.concatenate([np.arange(seen.states), _w(problem, seen) + np.flatnonzero(seen.B.any(axis=0))])


def _placed(matrix: Any, at: int, shape: tuple[int, ...]) -> Any:
    whole = _zeros(*shape)
    whole[at : at + len(matrix)] = matrix
    return whole


def _zeros(*shape: int) -> Any:
    return np.full(shape, Fraction(0), dtype=object)


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
