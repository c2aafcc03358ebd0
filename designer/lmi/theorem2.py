"""Theorem 2 of Zhu et al. 2020 as printed: LMI (36)(37) with objective (42), in the paper's letters.

The solver is given the non-strict inequalities: a strict one has no optimum. Its answer therefore lies on the
boundary, where (36) and (37) are singular; designer.lmi.back_off leads from there to a gamma that is checked.

`reduced` stands for the state [x; e] in place of the paper's [1 kron x; e]; see `inequality_36`.
"""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Iterator, Sequence
from functools import partial
from importlib.metadata import version
from typing import Any, NamedTuple

import cvxpy as cp
import numpy as np

from agent.contract.arrays import Array
from agent.contract.errors import InputError
from agent.contract.gains import Solver
from agent.contract.problem import Problem
from designer.lmi import LmiSolution, attempts, beyond_paper
from designer.lmi.attempts import SOLVED, Attempt, first_accurate
from designer.lmi.conic import failure
from designer.model.error_model import Stacks, stacks
from designer.model.units import Units, natural_units, rescaled

_OPTIONS: dict[str, dict[str, Any]] = {
    cp.CLARABEL: {"chordal_decomposition_merge_method": "none"},  # three times faster than merging on six nodes
    cp.SCS: {"eps": 1e-7, "max_iters": 50_000},
}


class Lmi(NamedTuple):
    """The unknowns of Theorem 2 and the problem (42) that they stand in."""

    delta: Any  # gamma^2
    R: Any  # (n nx, n nx) as printed; (nx, nx) reduced
    Q: list[list[Any]]  # Q[s][i] = Q_i(s), (nx, nx)
    X: list[Any]  # X[s], (n nx, sum ny), blocks zero where node i does not hear j
    Y: list[Any]  # Y[s], (n nx, n nx), likewise
    problem: cp.Problem


def solve(problem: Problem, *, reduced: bool = False) -> LmiSolution:
    """Minimise gamma^2 subject to (36) and (37) for every mode: the first of `answers` that is called accurate.

    Raises Unattainable: infeasible, or no solver had an answer; InputError: a part of it is not in the paper.
    """
    return first_accurate(answers(problem, reduced=reduced))


def answers(problem: Problem, *, reduced: bool = False, unit: float = 1.0) -> Iterator[LmiSolution]:
    """What Clarabel says, then on rescaled data; then SCS, where Clarabel says nothing at all.

    At first states have units `unit` times as large as the problem's own.
    """
    part = beyond_paper(problem)
    if part is not None:
        raise InputError(
            f"Theorem 2 is the paper's, and the paper does not know that {part}, as it is in {problem.name}; "
            "use --method decomposed, or --method exact"
        )
    own, natural = Units(np.full(problem.nx, unit), 1.0), natural_units(problem)
    plan = [
        Attempt("", partial(_attempt, problem, cp.CLARABEL, own, reduced)),
        Attempt(" on rescaled data", partial(_attempt, problem, cp.CLARABEL, natural, reduced)),
    ]
    if cp.SCS in cp.installed_solvers():
        run = partial(_attempt, problem, cp.SCS, natural, reduced)
        plan.append(Attempt(" on rescaled data", run, last_resort=True))
    return attempts.answers(f"the LMI (36)(37) of Theorem 2 for {problem.name}", plan)


def _attempt(problem: Problem, solver: str, units: Units, reduced: bool) -> tuple[Solver, LmiSolution | None]:
    lmi = theorem2(rescaled(problem, units), reduced=reduced)
    record = _run(lmi.problem, solver)
    return record, _solution(lmi, units, record, reduced=reduced) if record.status in SOLVED else None


def gamma_by_scs(problem: Problem, *, iterations: int) -> float | None:
    """gamma of (42) as printed, on rescaled data, by SCS stopped after so many iterations at most; None: no answer."""
    if cp.SCS not in cp.installed_solvers():
        return None
    units = natural_units(problem)
    lmi = theorem2(rescaled(problem, units))
    record = _run(lmi.problem, cp.SCS, {"max_iters": iterations})
    return units.output * math.sqrt(max(float(lmi.delta.value), 0.0)) if record.status in SOLVED else None


def theorem2(problem: Problem, *, reduced: bool = False) -> Lmi:
    """The unknowns R, Q_i(s), X^s, Y^s and delta, and (42) subject to (36) and (37).

    `reduced` writes (36) for eta = [x; e] in place of [1 kron x; e], so that R is (nx, nx).
    """
    n, nx, modes = problem.n, problem.nx, len(problem.topologies)
    bar = stacks(problem)
    J = np.tile(np.eye(nx), (n, 1)) if reduced else np.eye(n * nx)
    delta = cp.Variable(name="delta", nonneg=True)
    R = cp.Variable((len(J.T), len(J.T)), symmetric=True, name="R")
    Q = [[cp.Variable((nx, nx), symmetric=True) for _ in range(n)] for _ in range(modes)]
    X = [_sparse(problem, s, [node.C.shape[0] for node in problem.nodes]) for s in range(modes)]
    Y = [_sparse(problem, s, [nx] * n) for s in range(modes)]
    constraints = []
    for s in range(modes):
        Q_s = _diag(Q[s])
        Q_bar = _diag([sum(problem.markov.transition[s, t] * Q[t][i] for t in range(modes)) for i in range(n)])
        kept = _rows_that_matter(problem, s, len(J.T))
        constraints.append(inequality_36(bar, J, R, Q_s, Q_bar, X[s], Y[s])[kept][:, kept] << 0)
        constraints.append(inequality_37(bar, R, Q_s, delta) << 0)
    return Lmi(delta, R, Q, X, Y, cp.Problem(cp.Minimize(delta), constraints))


def inequality_36(bar: Stacks, J: Array, R: Any, Q: Any, Q_bar: Any, X: Any, Y: Any) -> Any:
    """The matrix of (36) for one mode, of order 2 n nx + nw + 2 n nx + n (2 n nx).

    x_bar = J x' says which state R is of: J = I, (n nx, n nx), is (36) as printed; J = 1 kron I, (n nx, nx),
    is (36) for the reduced state x' = x. The plant moves x' by J^+ A_bar J and J^+ B_bar.
    """
    n, nw, p = len(bar.alpha), bar.B.shape[1], J.shape[1]
    J_plus = J.T / (J.T @ J)[0, 0]
    P_bar = _diag([R, Q_bar])
    Xi_11 = _diag([-R, -Q])
    Xi_22 = -np.eye(nw)
    Xi_33 = -P_bar
    Xi_44 = _diag([-P_bar] * n)
    Xi_21 = np.zeros((nw, Xi_11.shape[0]))
    Xi_31 = cp.bmat(
        [
            [R @ (J_plus @ bar.A @ J), np.zeros((p, len(bar.A)))],
            [(Q_bar @ bar.A - Y) @ J, Y - X @ bar.C_beta],
        ]
    )
    Xi_32 = cp.vstack([R @ (J_plus @ bar.B), Q_bar @ bar.B - X @ bar.D])
    Xi_41 = cp.vstack([_loss_block(-math.sqrt(bar.alpha[i]) * X @ (bar.E[i] @ J)) for i in range(n)])
    Xi_42 = np.zeros((Xi_44.shape[0], nw))
    Xi_43 = np.zeros((Xi_44.shape[0], Xi_33.shape[0]))
    return cp.bmat(
        [
            [Xi_11, Xi_21.T, Xi_31.T, Xi_41.T],
            [Xi_21, Xi_22, Xi_32.T, Xi_42.T],
            [Xi_31, Xi_32, Xi_33, Xi_43.T],
            [Xi_41, Xi_42, Xi_43, Xi_44],
        ]
    )


def inequality_37(bar: Stacks, R: Any, Q: Any, delta: Any) -> Any:
    """The matrix of (37) for one mode, of order 2 n nx + n nz."""
    O, M = np.zeros((R.shape[0], len(bar.A))), bar.M  # noqa: E741 - the zero block of (37)
    zeros = np.zeros((R.shape[0], len(M)))
    return cp.bmat([[-R, O, zeros], [O.T, -Q, M.T], [zeros.T, M, -delta * np.eye(len(M))]])


def _loss_block(block: Any) -> Any:
    """[0 0; block 0] of Xi_41, (p + n nx, p + n nx), for a block (n nx, p)."""
    size, p = block.shape
    return cp.bmat([[np.zeros((p, p)), np.zeros((p, size))], [block, np.zeros((size, size))]])


def _rows_that_matter(problem: Problem, s: int, p: int) -> list[int]:
    """The rows and columns of (36) but for those of Xi_44 that meet nothing except zeros in Xi_41.

    Those say R > 0 and Q_bar_l > 0 again, which Xi_33 has said; without them the solver does less for the same
    answer. Left of the block of node i are the rows of the nodes that hear i, if i loses measurements.
    """
    n, nx = problem.n, problem.nx
    first = 2 * (p + n * nx) + problem.nw
    kept = list(range(first))
    for i in range(n):
        for receiver in range(n):
            if problem.beta[i] < 1.0 and i in problem.neighbours(s, receiver):
                start = first + i * (p + n * nx) + p + receiver * nx
                kept += range(start, start + nx)
    return kept


def _diag(blocks: Sequence[Any]) -> Any:
    """diag{...} of square blocks."""
    sizes = [block.shape[0] for block in blocks]
    return cp.bmat(
        [
            [block if i == j else np.zeros((sizes[i], sizes[j])) for j in range(len(blocks))]
            for i, block in enumerate(blocks)
        ]
    )


def _sparse(problem: Problem, s: int, widths: Sequence[int]) -> Any:
    """An unknown matrix with the block sparsity (9) of mode s; block (i, j) is (nx, widths[j])."""
    nx = problem.nx
    rows = []
    for i in range(problem.n):
        heard = problem.neighbours(s, i)
        rows.append([cp.Variable((nx, q)) if j in heard else np.zeros((nx, q)) for j, q in enumerate(widths)])
    return cp.bmat(rows)


def _run(problem: cp.Problem, solver: str, options: dict[str, Any] | None = None) -> Solver:
    """Solve, and record what the solver says; or its own words where it raised."""
    options = _OPTIONS[solver] | (options or {})
    start, iterations, residuals = time.perf_counter(), 0, (math.nan, math.nan)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what cvxpy warns of is the status, and the status is recorded
        try:
            data, chain, inverse = problem.get_problem_data(solver, solver_opts=options)
            found = chain.solve_via_data(problem, data, solver_opts=options)
            iterations, residuals = _quality(solver, found)
            problem.unpack_results(found, chain, inverse)
            status = str(problem.status)
        except (TypeError, AttributeError):
            raise  # nothing that a solver says: cvxpy is not what it was
        except BaseException as error:
            status = failure(error)
    return Solver(
        name=solver,
        version=version(solver.lower()),
        status=status,
        iterations=iterations,
        residuals=residuals if np.isfinite(residuals).all() else None,
        seconds=time.perf_counter() - start,
    )


def _quality(solver: str, found: Any) -> tuple[int, tuple[float, float]]:
    """Iterations, and the primal and dual residual, from what the solver returned to cvxpy."""
    if solver == cp.CLARABEL:
        return int(found.iterations), (float(found.r_prim), float(found.r_dual))
    info = found["info"]
    return int(info["iter"]), (float(info["res_pri"]), float(info["res_dual"]))


def _solution(lmi: Lmi, units: Units, solver: Solver, *, reduced: bool) -> LmiSolution:
    """The numbers, in the problem's own units: with x = U x', Q = U^-1 Q' U^-1, Y likewise, X = U^-1 X'."""
    nx, n = len(units.state), len(lmi.Q[0])
    R = np.asarray(lmi.R.value)
    if not reduced:
        R = R.reshape(n, nx, n, nx).sum(axis=(0, 2))  # (1 kron I)' R (1 kron I): P acts on 1 kron x only
    Q = np.array([[block.value for block in Q_s] for Q_s in lmi.Q])
    both = 1.0 / np.outer(units.state, units.state)
    rows = np.tile(1.0 / units.state, n)
    return LmiSolution(
        gamma=units.output * math.sqrt(max(float(lmi.delta.value), 0.0)),
        R=both * (R + R.T) / 2.0,
        Q=both * (Q + Q.swapaxes(-1, -2)) / 2.0,
        X=np.array([rows[:, None] * X.value for X in lmi.X]),
        Y=np.array([np.outer(rows, rows) * Y.value for Y in lmi.Y]),
        solver=solver,
    )
