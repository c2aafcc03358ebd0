"""Theorem 2 of Zhu et al. 2020 for the state [x; e], node by node: the same optimum from many small inequalities.

For each mode s, with Q_bar_i = sum_t pi_st Q_i(t), N the nodes that node i hears, X = Q_bar H and Y = Q_bar K:

    node i   [S_i, G_i'; G_i, Q_bar_i] >= 0, G_i = [Q_bar_i A - sum_j Y_ij | Q_bar_i B - sum_j X_ij D_j
                                                    | (Y_ij - beta_j X_ij C_j) for j in N],  S_i over (x, w, e_N) free
    link ij  [T_ij, X_ij'; X_ij, Q_bar_i] >= 0 where alpha_j > 0, T_ij free
    balance  diag{R, I, Q(s)} - [A B]'R[A B] - sum_i S_i - sum_ij alpha_j C_j'T_ij C_j >= 0, over (x, w, e)
    peak i   [Q_i(s), M'; M, delta I] >= 0

and R >= 0 once. The balance is large and sparse: it is split along a tree of cliques into pieces that exchange what
they share. In each piece one node needs no S_i: what is left of the piece serves. docs/decomposed.md derives it all.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from agent.contract.arrays import Array
from agent.contract.errors import Unattainable
from agent.contract.gains import Solver
from agent.contract.problem import Problem
from designer.error_model import measurement_slices
from designer.lmi import LmiSolution, conic
from designer.lmi.cliques import clique_tree
from designer.lmi.cones import Assembly, Cones, Indices, Inequality
from designer.lmi.units import Units, natural_units, rescaled

Link = tuple[int, int]  # (i, j): node i hears node j
_ADVICE = "try the problem in other units, so that its numbers are near 1"


class Piece(NamedTuple):
    """A part of the balance of one mode, over (x, w) and the errors of a few nodes."""

    matrix: Inequality
    at: dict[int, Indices]  # the rows of (x, w) under 0, those of e_i under i + 1

    def rows(self, vertices: tuple[int, ...]) -> Indices:
        return np.concatenate([self.at[v] for v in vertices])


class NodePart(NamedTuple):
    """The inequality of node i: the rows of (x, w, e_N), those of Q_bar_i, and S_i where it has one."""

    matrix: Inequality
    rows: Indices
    last: Indices
    S: Indices | None


class Mode(NamedTuple):
    """The unknowns and inequalities of one mode."""

    Q: list[Indices]
    X: dict[Link, Indices]
    Y: dict[Link, Indices]
    T: dict[Link, Indices]  # links with alpha_j > 0
    balance: list[Piece]
    nodes: list[NodePart]
    links: dict[Link, Inequality]
    peaks: list[Inequality]


class Lmi(NamedTuple):
    """The whole problem: minimise delta, over all modes."""

    delta: Indices
    R: Indices
    modes: list[Mode]
    cones: Cones


def solve(problem: Problem) -> LmiSolution:
    """Minimise gamma^2 = delta. Clarabel first; then Clarabel on rescaled data, then SCS where it is installed.

    What failed on the way, or stalled with an inaccurate answer, stands in `solver.status`. Raises Unattainable:
    infeasible, or no solver had an answer.
    """
    attempts: list[tuple[Callable[[Cones, Array], conic.Answer], str]] = [
        (conic.clarabel, ""),
        (conic.clarabel, " on rescaled data"),
        (conic.scs, " on rescaled data"),
    ]
    failures: list[str] = []
    inaccurate: LmiSolution | None = None  # the answer of a solver that stalled, for want of a better one
    for solver, remark in attempts:
        if not conic.installed(solver) or (inaccurate is not None and solver is conic.scs):
            continue
        units = natural_units(problem) if remark else Units(np.ones(problem.nx), 1.0)
        lmi = assemble(rescaled(problem, units))
        q = np.zeros(lmi.cones.A.shape[1])
        q[lmi.delta] = 1.0
        u, record = solver(lmi.cones, q)
        if record.status in conic.INFEASIBLE and inaccurate is None:
            raise Unattainable(
                f"the decomposed LMI of Theorem 2 is infeasible for {problem.name}, says {record.name}{remark}; it "
                "has a solution for every plant with all eigenvalues of A well inside the unit circle: "
                f"check A, or {_ADVICE}"
            )
        if record.status in conic.SOLVED:
            status = "; ".join([record.status + remark, *failures])
            solution = _solution(problem, lmi, u, units, record.model_copy(update={"status": status}))
            if record.status == "optimal" or (remark and inaccurate is None):
                return solution
            inaccurate = inaccurate or solution
        failures.append(f"{record.name}{remark} {record.status}")
    if inaccurate is not None:
        status = "; ".join([inaccurate.solver.status, *failures[1:]])
        return inaccurate._replace(solver=inaccurate.solver.model_copy(update={"status": status}))
    raise Unattainable(
        f"no solver answered the decomposed LMI of Theorem 2 for {problem.name} ({'; '.join(failures)}); {_ADVICE}"
    )


def assemble(problem: Problem) -> Lmi:
    """Unknowns and inequalities of every mode."""
    build, nx, n = Assembly(), problem.nx, problem.n
    delta, R = build.unknown(1, 1), build.symmetric(nx)
    positive = build.inequality()  # R >= 0: the balance implies it for stable plants only
    x = positive.append(nx)
    positive.add(x, x, R)
    Q = [[build.symmetric(nx) for _ in range(n)] for _ in problem.topologies]
    modes = []
    for s, weights in enumerate(problem.markov.transition):
        heard = [problem.neighbours(s, i) for i in range(n)]
        links = [(i, j) for i in range(n) for j in heard[i]]
        X = {(i, j): build.unknown(nx, len(problem.nodes[j].C)) for i, j in links}
        Y = {link: build.unknown(nx, nx) for link in links}
        balance = _balance(build, problem, R, Q[s], heard)
        home = [_home(balance, heard_i) for heard_i in heard]
        spared = {k: max((i for i in range(n) if home[i] == k), key=lambda i: len(heard[i])) for k in set(home)}
        mode = Mode(Q[s], X, Y, T={}, balance=balance, nodes=[], links={}, peaks=[])
        for i in range(n):
            Q_bar = [(float(weight), Q[t][i]) for t, weight in enumerate(weights) if weight > 0.0]
            piece = balance[home[i]]
            mode.nodes.append(_node(build, problem, mode, i, heard[i], Q_bar, piece, spared[home[i]] == i))
            for j in heard[i]:
                if problem.beta[j] < 1.0:
                    _link(build, problem, mode, (i, j), Q_bar, piece)
            mode.peaks.append(_peak(build, problem, Q[s][i], delta))
        modes.append(mode)
    return Lmi(delta, R, modes, build.cones())


def _balance(
    build: Assembly, problem: Problem, R: Indices, Q: list[Indices], heard: list[tuple[int, ...]]
) -> list[Piece]:
    """diag{R, I, Q(s)} - [A B]'R[A B] in pieces, one for each clique; all of them have (x, w)."""
    nx, nw = problem.nx, problem.nw
    tree = clique_tree([j + 1 for j in heard_i] for heard_i in heard)
    pieces = []
    for clique in tree:
        matrix = build.inequality()
        pieces.append(Piece(matrix, {v: matrix.append(nx if v else nx + nw) for v in clique.vertices}))
    placed: set[int] = set()
    for piece, clique in zip(pieces, tree, strict=True):
        for v in set(clique.vertices) - placed - {0}:
            piece.matrix.add(piece.at[v], piece.at[v], Q[v - 1])
        placed |= set(clique.vertices)
        if clique.above is not None:
            U, above = build.symmetric(len(piece.rows(clique.shared))), pieces[clique.above]
            piece.matrix.add(piece.rows(clique.shared), piece.rows(clique.shared), U, factor=-1.0)
            above.matrix.add(above.rows(clique.shared), above.rows(clique.shared), U)
    first, A_B = pieces[0], np.hstack([problem.plant.A, problem.plant.B])
    x, w = np.split(first.at[0], [nx])
    first.matrix.add(x, x, R)
    first.matrix.add_number(w, w, np.eye(nw))
    first.matrix.add(first.at[0], first.at[0], R, factor=-1.0, left=A_B.T, right=A_B)
    return pieces


def _home(balance: list[Piece], heard: tuple[int, ...]) -> int:
    """The smallest piece that has the errors of all nodes heard."""
    fitting = [k for k, piece in enumerate(balance) if all(j + 1 in piece.at for j in heard)]
    return min(fitting, key=lambda k: len(balance[k].at))


def _node(
    build: Assembly,
    problem: Problem,
    mode: Mode,
    i: int,
    heard: tuple[int, ...],
    Q_bar: list[tuple[float, Indices]],
    piece: Piece,
    spared: bool,
) -> NodePart:
    """[S_i, G_i'; G_i, Q_bar_i] >= 0; where the node is spared its S_i, the piece of the balance stands there."""
    nx, nw, plant = problem.nx, problem.nw, problem.plant
    vertices = (0, *(j + 1 for j in heard))
    S: Indices | None = None
    part = piece
    if not spared:
        matrix = build.inequality()
        part = Piece(matrix, {v: matrix.append(nx if v else nx + nw) for v in vertices})
        S = build.symmetric(matrix.order)
        matrix.add(part.rows(vertices), part.rows(vertices), S)
        piece.matrix.add(piece.rows(vertices), piece.rows(vertices), S, factor=-1.0)
    matrix, last = part.matrix, part.matrix.append(nx)
    x, w = np.split(part.at[0], [nx])
    for weight, Q_i in Q_bar:
        matrix.add(x, last, Q_i, factor=weight, left=plant.A.T)
        matrix.add(w, last, Q_i, factor=weight, left=plant.B.T)
        matrix.add(last, last, Q_i, factor=weight)
    for j in heard:
        node, X, Y, e_j = problem.nodes[j], mode.X[i, j].T, mode.Y[i, j].T, part.at[j + 1]
        matrix.add(x, last, Y, factor=-1.0)
        matrix.add(w, last, X, factor=-1.0, left=node.D.T)
        matrix.add(e_j, last, Y)
        matrix.add(e_j, last, X, factor=-node.arrival_probability, left=node.C.T)
    return NodePart(matrix, part.rows(vertices), last, S)


def _link(
    build: Assembly, problem: Problem, mode: Mode, link: Link, Q_bar: list[tuple[float, Indices]], piece: Piece
) -> None:
    """[T_ij, X_ij'; X_ij, Q_bar_i] >= 0, and -alpha_j C_j'T_ij C_j on x in the balance."""
    node, matrix = problem.nodes[link[1]], build.inequality()
    beta, C = node.arrival_probability, node.C
    T = build.symmetric(len(C))
    y, last = matrix.append(len(C)), matrix.append(problem.nx)
    matrix.add(y, y, T)
    matrix.add(y, last, mode.X[link].T)
    for weight, Q_i in Q_bar:
        matrix.add(last, last, Q_i, factor=weight)
    x = piece.at[0][: problem.nx]
    piece.matrix.add(x, x, T, factor=-beta * (1.0 - beta), left=C.T, right=C)
    mode.T[link], mode.links[link] = T, matrix


def _peak(build: Assembly, problem: Problem, Q: Indices, delta: Indices) -> Inequality:
    """[Q_i(s), M'; M, delta I] >= 0."""
    matrix = build.inequality()
    x, z = matrix.append(problem.nx), matrix.append(problem.nz)
    matrix.add(x, x, Q)
    matrix.add_number(x, z, problem.plant.M.T)
    for k in range(problem.nz):
        matrix.add(z[k : k + 1], z[k : k + 1], delta)
    return matrix


def _solution(problem: Problem, lmi: Lmi, u: Array, units: Units, record: Solver) -> LmiSolution:
    """The numbers, in the problem's own units: with x = U x', Q = U^-1 Q' U^-1, Y likewise, X = U^-1 X'."""
    nx, n, columns = problem.nx, problem.n, measurement_slices(problem)
    X = np.zeros((len(lmi.modes), n * nx, columns[-1].stop))
    Y = np.zeros((len(lmi.modes), n * nx, n * nx))
    both = 1.0 / np.outer(units.state, units.state)
    for s, mode in enumerate(lmi.modes):
        for i, j in mode.X:
            rows = slice(i * nx, (i + 1) * nx)
            X[s, rows, columns[j]] = u[mode.X[i, j]] / units.state[:, None]
            Y[s, rows, j * nx : (j + 1) * nx] = both * u[mode.Y[i, j]]
    return LmiSolution(
        gamma=units.output * math.sqrt(max(float(u[lmi.delta].item()), 0.0)),
        R=both * u[lmi.R],
        Q=both * np.array([[u[Q_i] for Q_i in mode.Q] for mode in lmi.modes]),
        X=X,
        Y=Y,
        solver=record,
    )
