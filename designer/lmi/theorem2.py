"""Theorem 2 of Zhu et al. 2020 as printed: LMI (36)(37) with objective (42), in the paper's letters.

The solver is given the non-strict inequalities: a strict one has no optimum. Its answer therefore lies on the
boundary, where (36) and (37) are singular; designer.synthesis backs off from there to a gamma that is checked.
"""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Sequence
from importlib.metadata import version
from typing import Any, NamedTuple

import cvxpy as cp
import numpy as np

from agent.contract.arrays import Array
from agent.contract.errors import Unattainable
from agent.contract.gains import Solver
from agent.contract.problem import Problem
from designer.error_model import Stacks, stacks
from designer.lmi import LmiSolution

_ADVICE = "try the problem in other units, so that its numbers are near 1, or remove sensors that say nothing"


class Lmi(NamedTuple):
    """The unknowns of Theorem 2 and the problem (42) that they stand in."""

    delta: Any  # gamma^2
    R: Any  # (n nx, n nx), as printed
    Q: list[list[Any]]  # Q[s][i] = Q_i(s), (nx, nx)
    X: list[Any]  # X[s], (n nx, sum ny), blocks zero where node i does not hear j
    Y: list[Any]  # Y[s], (n nx, n nx), likewise
    problem: cp.Problem


def solve(problem: Problem) -> LmiSolution:
    """Minimise gamma^2 subject to (36) and (37) for every mode.

    Clarabel first; if it gives no answer, Clarabel on rescaled data, then SCS where it is installed. What
    failed on the way stands in `solver.status`. Raises Unattainable: infeasible, or no solver had an answer.
    """
    scale = _scale(problem)
    attempts = [(problem, np.ones(problem.nx), 1.0, cp.CLARABEL, "")]
    for solver in [cp.CLARABEL, cp.SCS]:
        if solver in cp.installed_solvers():
            attempts.append((_rescaled(problem, *scale), *scale, solver, ", on rescaled data"))
    failures: list[str] = []
    for data, state_units, output_unit, solver, remark in attempts:
        lmi = theorem2(data)
        start = time.perf_counter()
        status = _run(lmi.problem, solver)
        seconds = time.perf_counter() - start
        if status in (cp.INFEASIBLE, cp.INFEASIBLE_INACCURATE):
            raise Unattainable(
                f"{solver} finds the LMI (36)(37) of Theorem 2 infeasible for {problem.name}; the plant must be "
                f"Schur stable, with no eigenvalue of A close to the unit circle; {_ADVICE}"
            )
        if status in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE):
            told = "".join(f"; {failure}" for failure in failures)
            record = Solver(
                name=solver.capitalize() if solver == cp.CLARABEL else solver,
                version=version(solver.lower()),
                status=f"{status}{remark}{told}",
                iterations=int(lmi.problem.solver_stats.num_iters or 0),
                seconds=seconds,
            )
            return _solution(problem, lmi, state_units, output_unit, record)
        failures.append(f"{solver}{remark}: {status}")
    raise Unattainable(
        f"no solver found an answer to the LMI (36)(37) for {problem.name} ({'; '.join(failures)}); {_ADVICE}"
    )


def theorem2(problem: Problem) -> Lmi:
    """The unknowns R, Q_i(s), X^s, Y^s and delta, and (42) subject to (36) and (37)."""
    n, nx, modes = problem.n, problem.nx, len(problem.topologies)
    bar = stacks(problem)
    delta = cp.Variable(name="delta", nonneg=True)
    R = cp.Variable((n * nx, n * nx), symmetric=True, name="R")
    Q = [[cp.Variable((nx, nx), symmetric=True) for _ in range(n)] for _ in range(modes)]
    X = [_sparse(problem, s, [node.C.shape[0] for node in problem.nodes]) for s in range(modes)]
    Y = [_sparse(problem, s, [nx] * n) for s in range(modes)]
    constraints = []
    for s in range(modes):
        Q_s = _diag(Q[s])
        Q_bar = _diag(
            [sum(problem.markov.transition[s, t] * Q[t][i] for t in range(modes)) for i in range(n)]
        )
        constraints.append(inequality_36(bar, R, Q_s, Q_bar, X[s], Y[s]) << 0)
        constraints.append(inequality_37(bar, R, Q_s, delta) << 0)
    return Lmi(delta, R, Q, X, Y, cp.Problem(cp.Minimize(delta), constraints))


def inequality_36(bar: Stacks, R: Any, Q: Any, Q_bar: Any, X: Any, Y: Any) -> Any:
    """The matrix of (36) for one mode, of order 2 n nx + nw + 2 n nx + n (2 n nx)."""
    n, nw = len(bar.alpha), bar.B.shape[1]
    P_bar = _diag([R, Q_bar])
    O = np.zeros_like(bar.A)  # noqa: E741 - the zero block of (36)
    Xi_11 = _diag([-R, -Q])
    Xi_22 = -np.eye(nw)
    Xi_33 = -P_bar
    Xi_44 = _diag([-P_bar] * n)
    Xi_21 = np.zeros((nw, Xi_11.shape[0]))
    Xi_31 = cp.bmat([[R @ bar.A, O], [Q_bar @ bar.A - Y, Y - X @ bar.C_beta]])
    Xi_32 = cp.vstack([R @ bar.B, Q_bar @ bar.B - X @ bar.D])
    Xi_41 = cp.vstack(
        [cp.bmat([[O, O], [-math.sqrt(bar.alpha[i]) * X @ bar.E[i], O]]) for i in range(n)]
    )
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
    O = np.zeros_like(bar.A)  # noqa: E741
    M, zeros = bar.M, np.zeros_like(bar.M)
    return cp.bmat([[-R, O, zeros.T], [O, -Q, M.T], [zeros, M, -delta * np.eye(len(M))]])


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
        rows.append(
            [cp.Variable((nx, q)) if j in heard else np.zeros((nx, q)) for j, q in enumerate(widths)]
        )
    return cp.bmat(rows)


def _run(problem: cp.Problem, solver: str) -> str:
    """Solve; the status, or the solver's own words where it raised."""
    options: dict[str, Any] = {"max_iters": 20_000, "eps": 1e-7} if solver == cp.SCS else {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what cvxpy warns of is the status, and the status is returned
        try:
            problem.solve(solver=solver, **options)
        except (cp.SolverError, ValueError, ArithmeticError) as error:
            return f"failed ({str(error).splitlines()[0]})"
    return str(problem.status)


def _scale(problem: Problem) -> tuple[Array, float]:
    """Units in which a unit-energy w moves each state by at most 1, and every output of z is near 1."""
    A, B, M = problem.plant.A, problem.plant.B, problem.plant.M
    gramian, power = B @ B.T, A.copy()
    for _ in range(20):  # doubling: 2^20 terms of sum A^k B B' A'^k
        gramian, power = gramian + power @ gramian @ power.T, power @ power
    reach = np.sqrt(np.diag(gramian))
    state_units = np.where(reach > 0.0, reach, 1.0)
    output = float(np.linalg.norm(M * state_units, 2))
    return state_units, output or 1.0


def _rescaled(problem: Problem, state_units: Array, output_unit: float) -> Problem:
    """The problem with x = diag(state_units) x' and z = output_unit z'."""
    plant, columns, rows = problem.plant, state_units, state_units[:, None]
    scaled = plant.model_copy(
        update={"A": plant.A * columns / rows, "B": plant.B / rows, "M": plant.M * columns / output_unit}
    )
    nodes = tuple(node.model_copy(update={"C": node.C * columns}) for node in problem.nodes)
    return problem.model_copy(update={"plant": scaled, "nodes": nodes})


def _solution(
    problem: Problem, lmi: Lmi, state_units: Array, output_unit: float, solver: Solver
) -> LmiSolution:
    """The numbers, in the problem's own units: Q = U^-1 Q' U^-1 for x = U x', so X = U^-1 X', Y = U^-1 Y' U^-1."""
    n, nx = problem.n, problem.nx
    U = 1.0 / state_units
    R_bar = np.asarray(lmi.R.value).reshape(n, nx, n, nx)
    R = R_bar.sum(axis=(0, 2))  # (1 kron I)' R (1 kron I): the printed R acts on 1 kron x only
    Q = np.array([[block.value for block in Q_s] for Q_s in lmi.Q])
    rows = np.tile(U, n)[:, None]
    return LmiSolution(
        gamma=output_unit * math.sqrt(max(float(lmi.delta.value), 0.0)),
        R=U[:, None] * (R + R.T) / 2.0 * U,
        Q=U[:, None] * (Q + Q.swapaxes(-1, -2)) / 2.0 * U,
        X=np.array([rows * X.value for X in lmi.X]),
        Y=np.array([rows * Y.value * rows.T for Y in lmi.Y]),
        solver=solver,
    )
