"""The decomposed LMI: the optimum of Theorem 2 of Zhu et al. 2020 from many small inequalities; and beyond the paper.

For each mode s, with Q_bar_i = sum_t pi_st Q_i(t), N the nodes that node i hears, X = Q_bar H and Y = Q_bar K, each
with a_ij; rho_ij = 1 where no link loses messages; Dm_j = D_j, or beta_j D_j where node j sees its losses:

    node i   [S_i, G_i'; G_i, Q_bar_i] >= 0, S_i over (x, w, e_N) free,
             G_i = [Q_bar_i A - sum_j Y_ij | Q_bar_i B - sum_j rho_ij X_ij Dm_j
                    | rho_ij (Y_ij - beta_j X_ij C_j) for j in N, and sum_j (1 - rho_ij) Y_ij more for e_i]
    loss ij  [T_ij, X_ij'; X_ij, Q_bar_i] >= 0 where alpha_j > 0, T_ij free
    link ij  [U_ij, V_ij'; V_ij, Q_bar_i] >= 0 where rho_ij < 1, U_ij over (e_i, e_j, w) free,
             V_ij = [-Y_ij | Y_ij - beta_j X_ij C_j | -X_ij Dm_j]
    balance  diag{R, I, Q(s)} - [A B]'R[A B] - sum_i S_i - sum_ij alpha_j rho_ij r_j'T_ij r_j
             - sum_ij rho_ij (1 - rho_ij) U_ij >= 0, over (x, w, e); r_j = C_j x, or C_j e_j + D_j w where j sees
    peak i   [Q_i(s), M'; M, delta I] >= 0

and R >= 0 once. Where the gains have to be unbiased, Y_ii stands for Q_bar_i A less the other Y_ij, so that G_i has
no x; and where no loss is hidden from its node either, x and R are left out of it all.

The balance is large and sparse: it is split along a tree of cliques into pieces that exchange what they share. In
each piece one node needs no S_i: what is left of the piece serves. An entry of w that disturbs one sensor alone goes
with the error of that node. docs/decomposed.md derives it all.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import partial
from typing import NamedTuple

import numpy as np

from agent.contract.arrays import Array
from agent.contract.gains import Solver
from agent.contract.problem import Problem
from agent.contract.problem.parts import Node
from designer.lmi import LmiSolution, attempts, conic
from designer.lmi.attempts import SOLVED, Attempt, first_accurate
from designer.lmi.cliques import clique_tree
from designer.lmi.cones import Assembly, Cones, Indices, Inequality
from designer.model.error_model import measurement_slices
from designer.model.units import Units, natural_units, rescaled

Link = tuple[int, int]  # (i, j): node i hears node j
MOST_WEIGHTS = 20_000  # multipliers that are kept: a file that has them has other things in it
MARGIN = 1e-6  # of the balance, for unstable plants: designer.lmi.inwards knows no way inwards there


class Columns(NamedTuple):
    """Which entries of w disturb one sensor alone, and not the plant; and the others."""

    shared: Indices
    own: list[Indices]  # of each node

    def of(self, j: int) -> Indices:
        """Those that may disturb node j: shared ones first."""
        return np.concatenate([self.shared, self.own[j]])


class Piece(NamedTuple):
    """A part of the balance of one mode, over (x, shared w) and the errors of a few nodes, each with its own w."""

    matrix: Inequality
    at: dict[int, Indices]  # the rows of (x, shared w) under 0, those of (e_i, own w) under i + 1

    def rows(self, vertices: tuple[int, ...]) -> Indices:
        return np.concatenate([self.at[v] for v in vertices])

    def x(self, columns: Columns) -> Indices:
        return self.at[0][: len(self.at[0]) - len(columns.shared)]

    def w(self, columns: Columns, j: int) -> Indices:
        """The rows of the w that may disturb node j, in the order of `Columns.of`."""
        shared, own = len(columns.shared), len(columns.own[j])
        return np.concatenate([self.at[0][len(self.at[0]) - shared :], self.at[j + 1][len(self.at[j + 1]) - own :]])


class NodePart(NamedTuple):
    """The inequality of node i: the rows of (x, w, e_N), in the order of a piece, of Q_bar_i, and S_i, if any."""

    matrix: Inequality
    rows: Indices
    last: Indices
    S: Indices | None


class Mode(NamedTuple):
    """The unknowns and inequalities of one mode."""

    Q: list[Indices]
    X: dict[Link, Indices]
    Y: dict[Link, Indices]  # without Y_ii where the gains have to be unbiased
    T: dict[Link, Indices]  # links with alpha_j > 0
    U: dict[Link, Indices]  # links with rho_ij < 1
    balance: list[Piece]
    nodes: list[NodePart]
    losses: dict[Link, Inequality]  # of measurements
    links: dict[Link, Inequality]  # of messages
    peaks: list[Inequality]


class Receiver(NamedTuple):
    """Node i in one mode, and what its inequalities are written with and into."""

    build: Assembly
    problem: Problem
    columns: Columns
    mode: Mode
    i: int
    Q_bar: list[tuple[float, Indices]]  # sum of weight times Q_t
    piece: Piece  # of the balance, where node i is at home
    onto: float  # what x and w do to an error is multiplied by it: 1 / (the unit of errors)


class Lmi(NamedTuple):
    """The whole problem: minimise delta, over all modes."""

    columns: Columns
    delta: Indices
    R: Indices  # (nx, nx); (0, 0) where x is left out
    modes: list[Mode]
    cones: Cones


def solve(problem: Problem) -> LmiSolution:
    """Minimise gamma^2 = delta: the first of `answers` that its solver calls accurate. Raises Unattainable."""
    return first_accurate(answers(problem))


def answers(problem: Problem, *, last_resort: bool = True) -> Iterator[LmiSolution]:
    """What Clarabel says in natural units, then in the problem's own; then SCS, where Clarabel says nothing at all.

    Natural units first: they take fewer steps, and where a state is measured in thousands Clarabel needs them.
    """
    natural, own = natural_units(problem), Units(np.ones(problem.nx), 1.0)
    plan = [Attempt("", partial(_run, problem, conic.clarabel, natural))]
    plan.append(Attempt(" in other units", partial(_run, problem, conic.clarabel, own)))
    if last_resort and conic.installed(conic.scs):
        plan.append(Attempt("", partial(_run, problem, conic.scs, natural), last_resort=True))
    return attempts.answers(f"the decomposed LMI for {problem.name}", plan)


def _run(
    problem: Problem, solver: Callable[[Cones, Array], conic.Answer], units: Units
) -> tuple[Solver, LmiSolution | None]:
    margin = 0.0 if problem.plant.spectral_radius < 1.0 else MARGIN
    lmi = assemble(rescaled(problem, units), margin=margin, error=units.error)
    q = np.zeros(lmi.cones.A.shape[1])
    q[lmi.delta] = 1.0
    u, record, z = solver(lmi.cones, q)
    if record.status not in SOLVED:
        return record, None
    solution = _solution(problem, lmi, u, units, record)
    if z is not None and numbers_of_weights(problem) <= MOST_WEIGHTS:
        solution = solution._replace(weights=multipliers(problem, lmi, z, units))
    return record, solution


def assemble(problem: Problem, *, margin: float = 0.0, error: float = 1.0) -> Lmi:
    """Unknowns and inequalities of every mode; `margin` times diag{R, I, Q(s)} is kept to spare in the balance.

    Errors are measured in units `error` times as large as the state's: what x and w do to them is divided by it.
    """
    build, nx, n, columns = Assembly(), problem.nx, problem.n, split_columns(problem)
    delta, R = build.unknown(1, 1), build.symmetric(problem.plant_states)
    if problem.carries_plant:
        positive = build.inequality()  # R >= 0: the balance implies it for stable plants only
        x = positive.append(nx)
        positive.add(x, x, R)
    Q = [[build.symmetric(nx) for _ in range(n)] for _ in problem.topologies]
    modes = []
    for s, weights in enumerate(problem.markov.transition):
        heard = [problem.neighbours(s, i) for i in range(n)]
        links = [(i, j) for i in range(n) for j in heard[i]]
        X = {(i, j): build.unknown(nx, len(problem.nodes[j].C)) for i, j in links}
        Y = {(i, j): build.unknown(nx, nx) for i, j in links if i != j or not problem.unbiased}
        balance = _balance(build, problem, columns, R, Q[s], heard, 1.0 - margin)
        home = [_home(balance, heard_i) for heard_i in heard]
        spared = {k: max((i for i in range(n) if home[i] == k), key=lambda i: len(heard[i])) for k in set(home)}
        mode = Mode(Q[s], X, Y, T={}, U={}, balance=balance, nodes=[], losses={}, links={}, peaks=[])
        for i in range(n):
            Q_bar = [(float(weight), Q[t][i]) for t, weight in enumerate(weights) if weight > 0.0]
            at = Receiver(build, problem, columns, mode, i, Q_bar, balance[home[i]], onto=1.0 / error)
            mode.nodes.append(_node(at, heard[i], spared=spared[home[i]] == i))
            for j in heard[i]:
                if problem.beta[j] < 1.0:
                    _loss(at, j)
                if problem.delivery[i, j] < 1.0:
                    _link(at, j)
            mode.peaks.append(_peak(build, problem, i, Q[s][i], delta))
        modes.append(mode)
    return Lmi(columns, delta, R, modes, build.cones())


def split_columns(problem: Problem) -> Columns:
    """A sensor's own noise meets nobody but those who hear the sensor: it goes where the sensor's error goes."""
    disturbs = np.array([problem.plant.B.any(axis=0), *(node.D.any(axis=0) for node in problem.nodes)])
    alone = ~disturbs[0] & (disturbs.sum(axis=0) == 1)
    return Columns(np.flatnonzero(~alone), [np.flatnonzero(alone & disturbs[j + 1]) for j in range(problem.n)])


def _balance(
    build: Assembly,
    problem: Problem,
    columns: Columns,
    R: Indices,
    Q: list[Indices],
    heard: list[tuple[int, ...]],
    kept: float,
) -> list[Piece]:
    """kept diag{R, I, Q(s)} - [A B]'R[A B] in pieces, one for each clique; all of them have (x, shared w)."""
    nx, p = problem.nx, len(R)
    sizes = [p + len(columns.shared), *(nx + len(own) for own in columns.own)]
    tree = clique_tree([j + 1 for j in heard_i] for heard_i in heard)
    pieces = []
    for clique in tree:
        matrix = build.inequality()
        pieces.append(Piece(matrix, {v: matrix.append(sizes[v]) for v in clique.vertices}))
    placed: set[int] = set()
    for piece, clique in zip(pieces, tree, strict=True):
        for v in set(clique.vertices) - placed - {0}:
            e, w = np.split(piece.at[v], [nx])
            piece.matrix.add(e, e, Q[v - 1], factor=kept)
            piece.matrix.add_number(w, w, kept * np.eye(len(w)))
        placed |= set(clique.vertices)
        if clique.above is not None:
            U, above = build.symmetric(len(piece.rows(clique.shared))), pieces[clique.above]
            piece.matrix.add(piece.rows(clique.shared), piece.rows(clique.shared), U, factor=-1.0)
            above.matrix.add(above.rows(clique.shared), above.rows(clique.shared), U)
    first = pieces[0]
    x, w = np.split(first.at[0], [p])
    first.matrix.add_number(w, w, kept * np.eye(len(w)))
    if p:
        A_B = np.hstack([problem.plant.A, problem.plant.B[:, columns.shared]])
        first.matrix.add(x, x, R, factor=kept)
        first.matrix.add(first.at[0], first.at[0], R, factor=-1.0, left=A_B.T, right=A_B)
    return pieces


def _home(balance: list[Piece], heard: tuple[int, ...]) -> int:
    """The smallest piece that has the errors of all nodes heard."""
    fitting = [k for k, piece in enumerate(balance) if all(j + 1 in piece.at for j in heard)]
    return min(fitting, key=lambda k: len(balance[k].at))


def _node(at: Receiver, heard: tuple[int, ...], *, spared: bool) -> NodePart:
    """[S_i, G_i'; G_i, Q_bar_i] >= 0; where the node is spared its S_i, the piece of the balance stands there."""
    build, problem, columns, mode, i, Q_bar, piece, onto = at
    nx, plant, rho, shared = problem.nx, problem.plant, problem.delivery, len(columns.shared)
    if problem.unbiased:
        piece = Piece(piece.matrix, {**piece.at, 0: piece.at[0][len(piece.at[0]) - shared :]})  # x is not in G_i
    vertices = (0, *(j + 1 for j in heard))
    S: Indices | None = None
    part = piece
    if not spared:
        matrix = build.inequality()
        part = Piece(matrix, {v: matrix.append(len(piece.at[v])) for v in vertices})
        S = build.symmetric(matrix.order)
        matrix.add(part.rows(vertices), part.rows(vertices), S)
        piece.matrix.add(piece.rows(vertices), piece.rows(vertices), S, factor=-1.0)
    matrix, last = part.matrix, part.matrix.append(nx)
    x, w, e_i = part.x(columns), part.at[0][len(part.at[0]) - shared :], part.at[i + 1][:nx]
    for weight, Q_i in Q_bar:
        if problem.unbiased:
            matrix.add(e_i, last, Q_i, factor=weight, left=plant.A.T)
        else:
            matrix.add(x, last, Q_i, factor=onto * weight, left=plant.A.T)
        matrix.add(w, last, Q_i, factor=onto * weight, left=plant.B.T[columns.shared])
        matrix.add(last, last, Q_i, factor=weight)
    for j in heard:
        node, X, e_j, rho_ij = problem.nodes[j], mode.X[i, j].T, part.at[j + 1][:nx], float(rho[i, j])
        matrix.add(part.w(columns, j), last, X, factor=-onto * rho_ij, left=_mean_D(node).T[columns.of(j)])
        matrix.add(e_j, last, X, factor=-rho_ij * node.arrival_probability, left=node.C.T)
        if (i, j) not in mode.Y:
            continue
        Y = mode.Y[i, j].T
        matrix.add(e_j, last, Y, factor=rho_ij)
        if problem.unbiased:
            matrix.add(e_i, last, Y, factor=-rho_ij)  # -Y_ij of Y_ii, (1 - rho_ij) Y_ij of messages that are lost
        else:
            matrix.add(x, last, Y, factor=-onto)
            if rho_ij < 1.0:
                matrix.add(e_i, last, Y, factor=1.0 - rho_ij)
    return NodePart(matrix, part.rows(vertices), last, S)


def _loss(at: Receiver, j: int) -> None:
    """[T_ij, X_ij'; X_ij, Q_bar_i] >= 0, and -alpha_j rho_ij r_j'T_ij r_j in the balance."""
    build, problem, columns, mode, i, Q_bar, piece, onto = at
    matrix, node, link = build.inequality(), problem.nodes[j], (i, j)
    beta, C = node.arrival_probability, node.C
    T = build.symmetric(len(C))
    y, last = matrix.append(len(C)), matrix.append(problem.nx)
    matrix.add(y, y, T)
    matrix.add(y, last, mode.X[link].T)
    for weight, Q_i in Q_bar:
        matrix.add(last, last, Q_i, factor=weight)
    rows, r = piece.x(columns), onto * C
    if node.seen:
        rows = np.concatenate([piece.w(columns, j), piece.at[j + 1][: problem.nx]])
        r = np.hstack([onto * node.D[:, columns.of(j)], C])
    factor = -beta * (1.0 - beta) * float(problem.delivery[link])
    piece.matrix.add(rows, rows, T, factor=factor, left=r.T, right=r)
    mode.T[link], mode.losses[link] = T, matrix


def _link(at: Receiver, j: int) -> None:
    """[U_ij, V_ij'; V_ij, Q_bar_i] >= 0, and -rho_ij (1 - rho_ij) U_ij in the balance."""
    build, problem, columns, mode, i, Q_bar, piece, onto = at
    matrix, link, nx, nw = build.inequality(), (i, j), problem.nx, len(columns.of(j))
    node, rho, X, Y = problem.nodes[j], float(problem.delivery[link]), mode.X[link].T, mode.Y[link].T
    U = build.symmetric(2 * nx + nw)
    e_i, e_j, w, last = (matrix.append(size) for size in (nx, nx, nw, nx))
    rows = np.concatenate([e_i, e_j, w])
    matrix.add(rows, rows, U)
    matrix.add(e_i, last, Y, factor=-1.0)
    matrix.add(e_j, last, Y)
    matrix.add(e_j, last, X, factor=-node.arrival_probability, left=node.C.T)
    matrix.add(w, last, X, factor=-onto, left=_mean_D(node).T[columns.of(j)])
    for weight, Q_i in Q_bar:
        matrix.add(last, last, Q_i, factor=weight)
    rows = np.concatenate([piece.at[i + 1][:nx], piece.at[j + 1][:nx], piece.w(columns, j)])
    piece.matrix.add(rows, rows, U, factor=-rho * (1.0 - rho))
    mode.U[link], mode.links[link] = U, matrix


def _mean_D(node: Node) -> Array:
    """Dm_j of this module's first lines: the mean of what arrives of D_j w."""
    return node.arrival_probability * node.D if node.seen else node.D


def _peak(build: Assembly, problem: Problem, i: int, Q: Indices, delta: Indices) -> Inequality:
    """[Q_i(s), M'; M, delta I] >= 0."""
    matrix = build.inequality()
    x, z = matrix.append(problem.nx), matrix.append(problem.nz)
    matrix.add(x, x, Q)
    matrix.add_number(x, z, problem.weights[i] * problem.plant.M.T)
    for k in range(problem.nz):
        matrix.add(z[k : k + 1], z[k : k + 1], delta)
    return matrix


def numbers_of_weights(problem: Problem) -> int:
    """How many `multipliers` has."""
    order = problem.plant_states + problem.n * problem.nx + problem.nw
    return len(problem.topologies) * order * (order + 1) // 2


def multipliers(problem: Problem, lmi: Lmi, z: Array, units: Units) -> Array:
    """Those of the balance, (modes, n_eta + nw, n_eta + nw), over [x; e; w]; 0 where no piece has two of them.

    Pieces agree where they meet, but for the solver's tolerance: the mean is taken.
    """
    nx, p, at_w = problem.nx, problem.plant_states, problem.plant_states + problem.n * problem.nx
    V = np.zeros((len(lmi.modes), at_w + problem.nw, at_w + problem.nw))
    for s, mode in enumerate(lmi.modes):
        pieces = np.zeros_like(V[s])
        for piece in mode.balance:
            at = np.concatenate([np.arange(p), at_w + lmi.columns.shared])
            for j in (v - 1 for v in piece.at if v):
                at = np.concatenate([at, p + j * nx + np.arange(nx), at_w + lmi.columns.own[j]])
            rows = piece.rows(tuple(piece.at))
            V[s][np.ix_(at, at)] += lmi.cones.piece(z, piece.matrix.number)[np.ix_(rows, rows)]
            pieces[np.ix_(at, at)] += 1.0
        V[s] /= np.maximum(pieces, 1.0)
    own = [np.tile(units.state, p // nx), np.tile(units.error * units.state, problem.n), np.ones(problem.nw)]
    return V * (sizes := np.concatenate(own)) * sizes[:, None]


def _solution(problem: Problem, lmi: Lmi, u: Array, units: Units, record: Solver) -> LmiSolution:
    """The numbers, in the problem's own units.

    With x = U x' and e = c U e': R = U^-1 R' U^-1, Q = U^-1 Q' U^-1 / c^2, Y likewise, X = U^-1 X' / c^2.
    """
    nx, n, columns = problem.nx, problem.n, measurement_slices(problem)
    X = np.zeros((len(lmi.modes), n * nx, columns[-1].stop))
    Y = np.zeros((len(lmi.modes), n * nx, n * nx))
    both, of_error = 1.0 / np.outer(units.state, units.state), 1.0 / units.error**2
    for s, mode in enumerate(lmi.modes):
        for (i, j), X_ij in mode.X.items():
            X[s, i * nx : (i + 1) * nx, columns[j]] = of_error * u[X_ij] / units.state[:, None]
        for (i, j), Y_ij in mode.Y.items():
            Y[s, i * nx : (i + 1) * nx, j * nx : (j + 1) * nx] = of_error * both * u[Y_ij]
    Q = of_error * both * np.array([[u[Q_i] for Q_i in mode.Q] for mode in lmi.modes])
    if problem.unbiased:
        Q_bar = np.tensordot(problem.markov.transition, Q, axes=1)
        others = Y.reshape(len(Y), n, nx, n, nx).sum(axis=3)
        for i in range(n):
            part = slice(i * nx, (i + 1) * nx)
            Y[:, part, part] = Q_bar[:, i] @ problem.plant.A - others[:, i]
    return LmiSolution(
        gamma=units.output * units.error * math.sqrt(max(float(u[lmi.delta].item()), 0.0)),
        R=both * u[lmi.R] if lmi.R.size else np.zeros((0, 0)),
        Q=Q,
        X=X,
        Y=Y,
        solver=record,
    )
