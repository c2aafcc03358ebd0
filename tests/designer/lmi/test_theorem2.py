"""Theorem 2's LMI: its optimum on the paper's examples, against other solvers and another formulation."""

from __future__ import annotations

import math
from typing import Any

import cvxpy as cp
import numpy as np
import pytest
from networks import random_gains, random_problem, real_network

from agent.contract.errors import InputError, Unattainable
from agent.contract.problem import Problem
from designer.lmi import theorem2
from designer.lmi.back_off import inequality_17, plant_lyapunov
from designer.lmi.recovery import block_diagonal, recover
from designer.model.error_model import error_model, paper_error_model, stacks
from designer.model.units import natural_units, rescaled
from designer.problems import find


def analysis_optimum(problem: Problem) -> float:
    """gamma by Theorem 1's Schur form (39)(40), built from the reduced error model with K_bar, H_bar as unknowns of
    one node each: every row i of the network has its own Schur complement and its own share S of the supply."""
    n, nx, modes = problem.n, problem.nx, len(problem.topologies)
    A, B, M = problem.plant.A, problem.plant.B, problem.plant.M
    delta = cp.Variable()
    R = cp.Variable((nx, nx), symmetric=True)
    Q = [[cp.Variable((nx, nx), symmetric=True) for _ in range(n)] for _ in range(modes)]
    constraints = [R >> 0]
    for s in range(modes):
        constraints += [cp.bmat([[Q[s][i], M.T], [M, delta * np.eye(len(M))]]) >> 0 for i in range(n)]
        order = nx + problem.nw + n * nx  # x, w, e
        supply: Any = cp.bmat(
            [
                [R - A.T @ R @ A, -A.T @ R @ B, np.zeros((nx, n * nx))],
                [-B.T @ R @ A, np.eye(problem.nw) - B.T @ R @ B, np.zeros((problem.nw, n * nx))],
                [np.zeros((n * nx, nx)), np.zeros((n * nx, problem.nw)), _diagonal(Q[s])],
            ]
        )
        for i in range(n):
            Q_bar = sum(problem.markov.transition[s, t] * Q[t][i] for t in range(modes))
            columns: list[Any] = [np.zeros((nx, nx)) for _ in range(n)]
            on_x, on_w = Q_bar @ A, Q_bar @ B
            for j in problem.neighbours(s, i):
                node, beta = problem.nodes[j], problem.beta[j]
                X_ij, Y_ij = cp.Variable((nx, len(node.C))), cp.Variable((nx, nx))
                on_x, on_w, columns[j] = on_x - Y_ij, on_w - X_ij @ node.D, Y_ij - beta * X_ij @ node.C
                T_ij = cp.Variable((len(node.C), len(node.C)), symmetric=True)
                constraints.append(cp.bmat([[T_ij, X_ij.T], [X_ij, Q_bar]]) >> 0)
                pad = np.vstack([node.C.T, np.zeros((order - nx, len(node.C)))])
                supply = supply - beta * (1.0 - beta) * (pad @ T_ij @ pad.T)
            S = cp.Variable((order, order), symmetric=True)
            G = cp.hstack([on_x, on_w, *columns])
            constraints.append(cp.bmat([[S, G.T], [G, Q_bar]]) >> 0)
            supply = supply - S
        constraints.append((supply + supply.T) / 2.0 >> 0)
    lmi = cp.Problem(cp.Minimize(delta), constraints)
    assert theorem2._run(lmi, cp.CLARABEL).status.startswith("optimal")
    return math.sqrt(float(delta.value))


def _diagonal(blocks: list[Any]) -> Any:
    zero = np.zeros(blocks[0].shape)
    return cp.bmat([[block if i == j else zero for j in range(len(blocks))] for i, block in enumerate(blocks)])


@pytest.mark.parametrize(("name", "expected"), [("zhu2020-ideal", 0.32977), ("zhu2020-lossy", 0.34797)])
@pytest.mark.parametrize("reduced", [False, True])
def test_the_optimum_on_the_papers_examples(name: str, expected: float, reduced: bool) -> None:
    """The global optimum of (42) on the printed data, within 1e-4; the paper prints 0.23 and 0.36."""
    solution = theorem2.solve(find(name), reduced=reduced)
    assert solution.solver.status.startswith("optimal")
    assert solution.gamma == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("seed", range(4))
def test_the_reduced_optimum_is_that_of_a_formulation_node_by_node(seed: int) -> None:
    """(36)(37) over [x; e] has the optimum of an LMI written from other blocks, and the printed one is not below."""
    problem = random_problem(seed, n=1 + seed % 3, modes=1 + seed % 2)
    gamma = theorem2.solve(problem, reduced=True).gamma
    assert gamma == pytest.approx(analysis_optimum(problem), rel=1e-4)
    assert gamma * (1.0 - 1e-4) <= theorem2.solve(problem).gamma <= gamma * (1.0 + 2e-3)


@pytest.mark.parametrize("reduced", [False, True])
def test_36_is_the_schur_form_39_of_theorem_1(reduced: bool) -> None:
    """With X = Q_bar H_bar and Y = Q_bar K_bar, (36) < 0 if and only if (17) < 0: their inertias agree."""
    problem = random_problem(7)
    bar, n, nx = stacks(problem), problem.n, problem.nx
    rng = np.random.default_rng(7)
    for size in (0.01, 0.1, 1.0, 10.0):
        Q = np.array([[_positive(rng, nx) for _ in range(n)] for _ in range(2)]) * size
        R = _positive(rng, nx) * size
        K_bar, H_bar = rng.normal(size=(n * nx, n * nx)) * 0.1, rng.normal(size=(n * nx, len(bar.D))) * 0.1
        Q_bar = block_diagonal(R, np.tensordot(problem.markov.transition, Q, axes=1))[0, nx:, nx:]
        J = np.tile(np.eye(nx), (n, 1)) if reduced else np.eye(n * nx)
        R_J = R if reduced else np.kron(np.eye(n), R / n)
        Q_s = block_diagonal(R, Q)[0, nx:, nx:]
        blocks = [cp.Constant(value) for value in (R_J, Q_s, Q_bar, Q_bar @ H_bar, Q_bar @ K_bar)]
        Xi = theorem2.inequality_36(bar, J, *blocks).value
        np.testing.assert_allclose(Xi, Xi.T, atol=1e-12)
        model = error_model(problem, np.tile(K_bar, (2, 1, 1)), np.tile(H_bar, (2, 1, 1)))
        P, P_bar = block_diagonal(R, Q)[0], np.zeros_like(block_diagonal(R, Q)[0])
        P_bar[:nx, :nx], P_bar[nx:, nx:] = R, Q_bar
        A, B = model.A[0], model.B[0]
        lost = sum(
            model.alpha[i] * model.F_i(0, i)[:, : model.size].T @ P_bar @ model.F_i(0, i)[:, : model.size]
            for i in range(n)
        )
        matrix_17 = np.block(
            [
                [A.T @ P_bar @ A + lost - P, A.T @ P_bar @ B],
                [B.T @ P_bar @ A, B.T @ P_bar @ B - np.eye(problem.nw)],
            ]
        )
        if reduced:
            positive = int((np.linalg.eigvalsh(matrix_17) > 0.0).sum())
            assert int((np.linalg.eigvalsh(Xi) > 0.0).sum()) == positive
        elif np.linalg.eigvalsh(Xi).max() < 0.0:
            assert np.linalg.eigvalsh(matrix_17).max() < 0.0  # the printed form asks for more


def _positive(rng: np.random.Generator, size: int) -> np.ndarray:
    factor = rng.normal(size=(size, size))
    return np.asarray(factor @ factor.T + 0.1 * np.eye(size))


def test_rows_left_out_of_36_meet_only_zeros() -> None:
    """The solver's (36) lacks rows of Xi_44 that say again what Xi_33 says: outside their block they are zero."""
    problem = random_problem(2, n=3)
    bar, n, nx, rng = stacks(problem), problem.n, problem.nx, np.random.default_rng(0)
    for s in range(2):
        R, Q = _positive(rng, n * nx), [_positive(rng, nx) for _ in range(n)]
        K_bar, H_bar = random_gains(problem, s)
        Q_s = block_diagonal(np.eye(nx), np.array([Q]))[0, nx:, nx:]
        blocks = [cp.Constant(value) for value in (R, Q_s, Q_s, Q_s @ H_bar[s], Q_s @ K_bar[s])]
        Xi = theorem2.inequality_36(bar, np.eye(n * nx), *blocks).value
        kept = theorem2._rows_that_matter(problem, s, n * nx)
        left_out = sorted(set(range(len(Xi))) - set(kept))
        assert 4 * n * nx + problem.nw <= left_out[0]
        assert not Xi[np.ix_(left_out, kept)].any()


@pytest.mark.parametrize("seed", range(4))
def test_what_the_reduced_form_admits_the_printed_one_admits_too(seed: int) -> None:
    """If diag{R, Q(s)} satisfies (17) for [x; e], then diag{R', Q(s)} does for [1 kron x; e], with
    R' = (1 1'/n^2) kron R + rho (I - 1 1'/n) kron S, S - A'SA > 0, and rho large enough: no gamma is lost by (36)
    as printed, but its optimum may lie at infinity, and a solver then stops a little above."""
    problem = random_problem(seed)
    n, nx, size = problem.n, problem.nx, problem.n * problem.nx
    K_bar, H_bar = random_gains(problem, seed, size=0.1)
    plant = plant_lyapunov(error_model(problem, K_bar, H_bar), np.tile(np.eye(size + nx), (2, 1, 1)))
    assert plant is not None
    S, Q = plant[0, :nx, :nx], np.tile(np.eye(nx), (2, n, 1, 1))
    P = 1e-6 * block_diagonal(1e3 * S, Q)
    reduced, printed = (form(problem, K_bar, H_bar) for form in (error_model, paper_error_model))
    assert np.linalg.eigvalsh(inequality_17(reduced, P)).min() > 0.0
    mean = np.ones((n, n)) / n
    for rho, holds in ((1e-9, False), (1e-2, True)):
        P_printed = np.zeros((2, 2 * size, 2 * size))
        P_printed[:, :size, :size] = np.kron(mean / n, P[0, :nx, :nx]) + rho * np.kron(np.eye(n) - mean, S)
        P_printed[:, size:, size:] = P[:, nx:, nx:]
        least = np.linalg.eigvalsh(inequality_17(printed, P_printed)).min()
        assert bool(least > 0.0) is holds


def test_units_change_no_gamma() -> None:
    """In rescaled units the optimum is gamma / output, and the gains come back in the problem's own units."""
    problem = random_problem(5)
    units = natural_units(problem)
    own = theorem2.solve(problem, reduced=True)
    lmi = theorem2.theorem2(rescaled(problem, units), reduced=True)
    record = theorem2._run(lmi.problem, cp.CLARABEL)
    assert record.status.startswith("optimal")
    back = theorem2._solution(lmi, units, record, reduced=True)
    assert back.gamma == pytest.approx(own.gamma, rel=1e-4)
    K_bar, H_bar = recover(problem, back)
    model = error_model(problem, K_bar, H_bar)
    P = block_diagonal(back.R, back.Q)
    for s in range(2):
        P_bar = np.tensordot(problem.markov.transition[s], P, axes=1)
        S = P[s] - model.A[s].T @ P_bar @ model.A[s]
        assert np.linalg.eigvalsh(S).min() > -1e-5 * np.abs(P).max()


def test_a_solver_that_fails_is_followed_by_the_next_and_that_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """Clarabel raising once leads to rescaled data, and the status says so; if all fail, Unattainable says so."""
    problem, calls = find("two-nodes"), []
    asked = cp.Problem.get_problem_data

    def fails_once(self: cp.Problem, solver: str, **options: Any) -> Any:
        calls.append(solver)
        if len(calls) == 1:
            raise cp.SolverError("numerical trouble\nmore")
        return asked(self, solver, **options)

    monkeypatch.setattr(cp.Problem, "get_problem_data", fails_once)
    solution = theorem2.solve(problem)
    assert "on rescaled data" in solution.solver.status
    assert "CLARABEL failed: numerical trouble" in solution.solver.status
    assert solution.gamma == pytest.approx(math.sqrt(2.0), rel=1e-4)

    def panics(self: cp.Problem, solver: str, **options: Any) -> Any:
        raise PanicException("index out of bounds")

    monkeypatch.setattr(cp.Problem, "get_problem_data", panics)
    with pytest.raises(Unattainable, match=r"no solver answered.*failed: index out of bounds.*SCS"):
        theorem2.solve(problem)


class PanicException(BaseException):
    """What a panic of Clarabel is in Python: not an Exception."""


def test_ctrl_c_is_no_failure_of_the_solver(monkeypatch: pytest.MonkeyPatch) -> None:
    """KeyboardInterrupt, which is no Exception either, goes through."""

    def interrupted(self: cp.Problem, solver: str, **options: Any) -> Any:
        raise KeyboardInterrupt

    monkeypatch.setattr(cp.Problem, "get_problem_data", interrupted)
    with pytest.raises(KeyboardInterrupt):
        theorem2.solve(find("two-nodes"))


def test_every_solve_leaves_its_residuals() -> None:
    """Status, iterations, residuals and seconds, as for the decomposed LMI."""
    record = theorem2.solve(find("two-nodes"), reduced=True).solver
    assert record.status == "optimal"
    assert record.iterations > 3
    assert record.residuals is not None
    assert max(record.residuals) < 1e-7
    assert record.seconds > 0.0


def test_scs_leaves_its_residuals_too() -> None:
    """The same facts from the other solver."""
    record = theorem2._run(theorem2.theorem2(find("two-nodes"), reduced=True).problem, cp.SCS)
    assert record.status.startswith("optimal")
    assert record.iterations > 3
    assert record.residuals is not None
    assert max(record.residuals) < 1e-5


def test_an_infeasible_lmi_is_said_to_be_infeasible(monkeypatch: pytest.MonkeyPatch) -> None:
    """Infeasible is an answer: asked again in other units, not of another solver, and said in one sentence."""
    made = theorem2.theorem2

    def contradictory(problem: Problem, *, reduced: bool) -> theorem2.Lmi:
        lmi = made(problem, reduced=reduced)
        constraints = [*lmi.problem.constraints, lmi.delta <= -1.0]
        return lmi._replace(problem=cp.Problem(lmi.problem.objective, constraints))

    monkeypatch.setattr(theorem2, "theorem2", contradictory)
    says = r"for two-nodes is infeasible \(CLARABEL infeasible; CLARABEL on rescaled data infeasible"
    with pytest.raises(Unattainable, match=says):
        theorem2.solve(find("two-nodes"))


@pytest.mark.parametrize(
    ("part", "says"),
    [
        ({"seen": ["n1"]}, 'node "n1" sees its losses'),
        ({"delivery": 0.9}, r'the link from "n\d" to "n\d" loses messages'),
        ({"unbiased": True}, "the gains have to be unbiased"),
    ],
)
@pytest.mark.parametrize("reduced", [False, True])
def test_what_is_not_in_the_paper_is_refused(part: dict[str, Any], says: str, reduced: bool) -> None:
    """One sentence: which part, and which method instead. What never happens is no such part."""
    with pytest.raises(InputError, match=rf"the paper does not know that {says}, .*random-1; use --method decomposed"):
        theorem2.solve(real_network(random_problem(1), **part), reduced=reduced)


def test_what_never_happens_is_not_refused() -> None:
    """beta = 1 where the node sees, and rho = 1, are the paper's problem."""
    problem = random_problem(12, n=2, modes=1, lossy=False)
    same = real_network(problem, seen=True, delivery=1.0)
    gamma = theorem2.solve(problem, reduced=True).gamma
    assert theorem2.solve(same, reduced=True).gamma == pytest.approx(gamma, rel=1e-12)
