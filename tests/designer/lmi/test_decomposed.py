"""The decomposed LMI: the optimum of Theorem 2, its cone data against cvxpy, the solvers' failures, large networks."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache
from typing import Any

import clarabel
import cvxpy as cp
import numpy as np
import pytest
from networks import own_noise, random_gains, random_problem, real_network

from agent.contract.arrays import Array
from agent.contract.errors import Unattainable
from agent.contract.gains import Gains, Solver
from agent.contract.problem import Problem
from benchmarks.design import banded
from designer.lmi import LmiSolution, cliques, conic, decomposed, lmi_design, theorem2
from designer.lmi.back_off import back_off, least_gamma
from designer.lmi.cones import Assembly
from designer.lmi.inwards import inwards
from designer.lmi.recovery import block_diagonal, recover
from designer.lmi.witness import Witness, witness
from designer.model.error_model import error_model, link_gains
from designer.model.units import natural_units
from designer.problems import find
from designer.proof.certificate import verify
from designer.proof.prover import Prover
from designer.synthesis import design

PAPER = [
    find("zhu2020-ideal"),
    find("zhu2020-lossy"),
    random_problem(11),
    random_problem(12, n=1, modes=1),
    random_problem(13, n=4, nx=1, nw=3, nz=2, modes=1),
    random_problem(14, n=2, nx=3, modes=3, lossy=False),
    random_problem(15, n=4, nx=3, nz=2),
    banded(6),
]
NAMES = ["ideal", "lossy", "weights", "one-node-one-mode", "one-mode", "no-loss", "three-states", "banded"]
BEYOND = {
    "one-sees": real_network(random_problem(11), seen=["n1"]),
    "lossy-links": real_network(random_problem(11), delivery=0.7),
    "seen-and-links": real_network(random_problem(11), seen=True, delivery=0.7),
    "unbiased-hidden": real_network(random_problem(11), seen=["n1"], delivery=0.7, unbiased=True),
    "unstable": real_network(random_problem(11), seen=True, delivery=0.7, unbiased=True, radius=1.1),
    "unstable-one-node": real_network(random_problem(12, n=1), seen=True, unbiased=True, radius=1.2),
    "own-noise": own_noise(real_network(random_problem(11), seen=["n1"], delivery=0.7)),
    "own-noise-unstable": own_noise(real_network(random_problem(16), seen=True, unbiased=True, radius=1.05)),
    "banded-unbiased": real_network(banded(6), seen=True, delivery=0.9, unbiased=True),
}
papers = pytest.mark.parametrize("problem", PAPER[:-2], ids=NAMES[:-2])
small = pytest.mark.parametrize("problem", PAPER[2:5], ids=NAMES[2:5])
beyond = pytest.mark.parametrize("problem", BEYOND.values(), ids=BEYOND)
networks = pytest.mark.parametrize("problem", [*PAPER, *BEYOND.values()], ids=[*NAMES, *BEYOND])
solved = cache(decomposed.solve)  # most laws are about the same answers


@papers
def test_the_optimum_is_that_of_theorem_2(problem: Problem) -> None:
    """gamma equals the reduced Theorem 2's within 1e-4."""
    gamma = solved(problem).gamma
    assert gamma == pytest.approx(theorem2.solve(problem, reduced=True).gamma, rel=1e-4)


@small
def test_the_optimum_is_not_above_the_printed_one(problem: Problem) -> None:
    """Theorem 2 with the paper's longer state has the same optimum or a slightly higher one."""
    assert solved(problem).gamma <= theorem2.solve(problem).gamma * (1.0 + 1e-4)


@pytest.mark.parametrize("problem", [*PAPER[1:4], BEYOND["unbiased-hidden"], BEYOND["own-noise-unstable"]])
def test_the_optimum_is_that_of_the_witness(problem: Problem) -> None:
    """The same LMI by cvxpy, without cliques and with every S_i: the same gamma."""
    written = witness(problem)
    written.problem.solve(solver=cp.CLARABEL)
    assert solved(problem).gamma == pytest.approx(np.sqrt(written.delta.value), rel=1e-5)


@networks
def test_the_optimum_does_not_depend_on_the_units_of_errors(problem: Problem) -> None:
    """Errors measured in other units than states, as in large networks: the same gamma, and gains that keep it."""
    record, solution = decomposed._run(problem, conic.clarabel, natural_units(problem)._replace(error=1.5))
    assert record.status.startswith("optimal")
    assert solution is not None
    assert solution.gamma == pytest.approx(solved(problem).gamma, rel=1e-4)
    K, H = link_gains(problem, *recover(problem, solution))
    confirmed = back_off(problem, K, H, block_diagonal(solution.R, solution.Q))
    assert confirmed.verdict.holds
    assert confirmed.verdict.gamma < solution.gamma * (1.0 + 1e-3)


def test_large_networks_measure_errors_in_larger_units() -> None:
    """Up to 8 nodes errors have the state's units; of 32 nodes twice as large ones."""
    assert [natural_units(banded(n)).error for n in (4, 8, 32)] == [1.0, 1.0, 2.0]


@networks
def test_the_inequalities_are_the_witnesses_at_random_points(problem: Problem) -> None:
    """Wherever the unknowns are: node, link, peak and balance (the sum of its pieces) are the same matrices."""
    lmi, written = decomposed.assemble(problem), witness(problem)
    u = np.random.default_rng(0).normal(size=lmi.cones.A.shape[1])
    give(written, lmi, u)
    nx, p, columns = problem.nx, len(lmi.R), lmi.columns
    for mode, same in zip(lmi.modes, written.modes, strict=True):
        total = np.zeros(same.balance.shape)
        for piece in mode.balance:
            vertices = tuple(piece.at)
            into = []
            for v in vertices:
                first = np.arange(p) if v == 0 else p + problem.nw + nx * (v - 1) + np.arange(nx)
                into += [first, p + (columns.own[v - 1] if v else columns.shared)]
            rows = piece.rows(vertices)
            total[np.ix_(np.concatenate(into), np.concatenate(into))] += piece.matrix.value(u)[np.ix_(rows, rows)]
        np.testing.assert_allclose(total, same.balance.value, atol=1e-12)
        for part, node in zip(mode.nodes, same.nodes, strict=True):
            value, at = part.matrix.value(u), np.concatenate([part.rows, part.last])
            order = len(part.rows)
            np.testing.assert_allclose(value[np.ix_(at, part.last)], node.value[:, order:], atol=1e-12)
            if part.S is not None:
                np.testing.assert_allclose(value, node.value, atol=1e-12)
        for ours, theirs in ((mode.losses, same.losses), (mode.links, same.links)):
            assert set(ours) == set(theirs)
            for link, matrix in ours.items():
                np.testing.assert_allclose(matrix.value(u), theirs[link].value, atol=1e-12)
        for matrix, peak in zip(mode.peaks, same.peaks, strict=True):
            np.testing.assert_allclose(matrix.value(u), peak.value, atol=1e-12)


def give(written: Witness, lmi: decomposed.Lmi, u: Array) -> None:
    """Give the witness the values that stand in u; S_i is 0 where a piece of the balance stands for it."""
    written.delta.save_value(u[lmi.delta].item())
    if lmi.R.size:
        written.R.save_value(u[lmi.R])
    for mode, same in zip(lmi.modes, written.modes, strict=True):
        for Q_i, variable in zip(mode.Q, same.Q, strict=True):
            variable.save_value(u[Q_i])
        for part, variable in zip(mode.nodes, same.S, strict=True):
            variable.save_value(np.zeros(variable.shape) if part.S is None else u[part.S])
        for ours, theirs in ((mode.X, same.X), (mode.Y, same.Y), (mode.T, same.T), (mode.U, same.U)):
            assert set(ours) == set(theirs)
            for link, variable in theirs.items():
                variable.save_value(u[ours[link]])


@pytest.mark.parametrize("problem", [random_problem(11), BEYOND["unbiased-hidden"]], ids=["paper", "beyond"])
def test_the_cone_data_are_the_inequalities(problem: Problem) -> None:
    """b - A u holds the upper triangles with off-diagonal entries times sqrt(2): the sums of squares agree."""
    lmi = decomposed.assemble(problem)
    u = np.random.default_rng(1).normal(size=lmi.cones.A.shape[1])
    left = lmi.cones.b - lmi.cones.A @ u
    squares = np.sum(u[lmi.R] ** 2) + sum(np.sum(matrix.value(u) ** 2) for matrix in dict.fromkeys(everything(lmi)))
    assert np.sum(left**2) == pytest.approx(squares)


def everything(lmi: decomposed.Lmi) -> list[Any]:
    """All inequalities; one that serves a node as well as the balance is there twice."""
    return [
        matrix
        for mode in lmi.modes
        for matrix in (
            *(piece.matrix for piece in mode.balance),
            *(part.matrix for part in mode.nodes),
            *mode.losses.values(),
            *mode.links.values(),
            *mode.peaks,
        )
    ]


def test_the_papers_problems_have_the_cone_data_that_they_had() -> None:
    """Number of unknowns, of rows and of entries, and orders, counted when the LMI knew the paper's model alone."""
    for problem, unknowns, rows, entries in ((PAPER[1], 572, 1100, 2673), (PAPER[2], 279, 489, 1033)):
        cones = decomposed.assemble(problem).cones
        assert (*cones.A.shape, cones.A.nnz) == (rows, unknowns, entries)
        assert len(cones.b) == rows == sum(order * (order + 1) // 2 for order in cones.orders)


@pytest.mark.parametrize(
    "same",
    [
        real_network(random_problem(14, n=2, nx=3, modes=3, lossy=False), seen=True),
        real_network(random_problem(14, n=2, nx=3, modes=3, lossy=False), delivery=1.0),
    ],
    ids=["nothing-lost-is-seen", "every-message-arrives"],
)
def test_what_never_happens_leaves_the_cone_data_as_they_are(same: Problem) -> None:
    """beta = 1 seen, and rho = 1, are the paper's model, entry by entry."""
    cones, expected = (decomposed.assemble(problem).cones for problem in (same, PAPER[5]))
    assert (cones.A != expected.A).nnz == 0
    np.testing.assert_array_equal(cones.b, expected.b)
    assert cones.orders == expected.orders


def structured_optimum(problem: Problem, K_bar: Array, H_bar: Array) -> float:
    """The least gamma that (17) and (18) prove for these gains with P(s) = diag{R, Q(s)}, from the error model."""
    model, nx, n = error_model(problem, K_bar, H_bar), problem.nx, problem.n
    p, size = model.plant_states, model.size
    delta = cp.Variable()
    blocks = [[cp.Variable((nx, nx), symmetric=True) for _ in range(n)] for _ in range(model.modes)]
    R = [cp.Variable((nx, nx), symmetric=True)] if p else []
    constraints = []
    for s in range(model.modes):
        barred = [*R, *(sum(pi * blocks[t][i] for t, pi in enumerate(model.transition[s])) for i in range(n))]
        terms = [np.hstack([model.A[s], model.B[s]])]
        terms += [np.sqrt(model.alpha[i]) * model.F_i(s, i) for i in range(n)]
        if model.links is not None:
            here = np.flatnonzero(model.links.mode == s)
            terms += [np.sqrt(model.links.variance[term]) * model.V_l(term) for term in here]
        supply = np.zeros((size + problem.nw, size + problem.nw))
        supply[size:, size:] = np.eye(problem.nw)
        for k, block in enumerate([*R, *blocks[s]]):
            pick = np.eye(size + problem.nw)[k * nx : (k + 1) * nx]
            supply = supply + pick.T @ block @ pick
        for k, block in enumerate(barred):
            rows = [term[k * nx : (k + 1) * nx] for term in terms]
            weighed = sum(np.kron(row.T, row.T) for row in rows)  # vec(V'PV) = (V' kron V') vec(P)
            supply = supply - cp.reshape(weighed @ cp.vec(block, order="F"), supply.shape, order="F")
        constraints.append((supply + supply.T) / 2.0 >> 0)
        constraints += [
            cp.bmat([[Q, problem.plant.M.T], [problem.plant.M, delta * np.eye(problem.nz)]]) >> 0 for Q in blocks[s]
        ]
    lmi = cp.Problem(cp.Minimize(delta), [*constraints, *(block >> 0 for block in R)])
    lmi.solve(solver=cp.CLARABEL, tol_gap_abs=1e-7, tol_gap_rel=1e-7, tol_feas=1e-7)
    assert lmi.status == "optimal"
    return float(np.sqrt(delta.value))


@beyond
def test_the_optimum_is_what_theorem_1_proves_of_its_gains_and_of_no_others(problem: Problem) -> None:
    """(17)(18) for fixed gains, built from the error model: equal at the LMI's gains, above for gains beside them."""
    solution = solved(problem)
    K_bar, H_bar = recover(problem, solution)
    assert structured_optimum(problem, K_bar, H_bar) == pytest.approx(solution.gamma, rel=1e-5)
    dK, dH = random_gains(problem, 1, size=0.005)
    if problem.unbiased:
        for i in range(problem.n):
            rows = slice(i * problem.nx, (i + 1) * problem.nx)
            dK[:, rows, rows] = 0.0
            dK[:, rows, rows] = -dK[:, rows].reshape(len(dK), problem.nx, problem.n, problem.nx).sum(axis=2)
    assert structured_optimum(problem, K_bar + dK, H_bar + dH) > solution.gamma * (1.0 + 1e-6)


@pytest.mark.parametrize(("a", "beta"), [(1.2, 0.8), (0.9, 0.5), (1.0, 0.4)])
def test_one_node_with_one_state_is_solved_by_search(a: float, beta: float) -> None:
    """e+ = (a - theta h c) e + b w1 - theta h d w2: the best h on a grid, Q by the roots of a determinant."""
    b, c, d, m = 0.7, 0.5, 0.3, 2.0
    problem = Problem.from_document(
        {
            "name": "scalar",
            "plant": {"A": [[a]], "B": [[b, 0.0]], "M": [[m]]},
            "node": [{"name": "1", "C": [[c]], "D": [[0.0, d]], "arrival_probability": beta, "loss": "seen"}],
            "topology": [{"name": "1", "adjacency": [[1]]}],
            "markov": {"transition": [[1.0]], "initial": "1"},
            "unbiased": True,
        }
    )
    best = 0.0  # the largest Q; gamma^2 = m^2 / Q
    for h in np.linspace(0.0, 4.0, 4001):
        lost, arrived = np.array([a, b, 0.0]), np.array([a - h * c, b, -h * d])
        moved = beta * np.outer(arrived, arrived) + (1.0 - beta) * np.outer(lost, lost)
        if moved[0, 0] >= 1.0:
            continue
        # diag{Q, 1, 1} - Q moved >= 0 if and only if diag{1 - moved_ee, 1/Q - ...} is: Schur complement on e
        rest = moved[1:, 1:] + np.outer(moved[1:, 0], moved[0, 1:]) / (1.0 - moved[0, 0])
        best = max(best, 1.0 / float(np.linalg.eigvalsh(rest).max()))
    assert decomposed.solve(problem).gamma == pytest.approx(m / np.sqrt(best), rel=1e-5)


def test_unbiased_gains_are_unbiased_to_the_last_bits() -> None:
    """sum_j a_ij K_ij = A, as the gains file asks for; weights are not 1 here."""
    problem = BEYOND["unstable"]
    gains = design(problem, method="decomposed")
    for s, topology in enumerate(problem.topologies):
        for i, receiver in enumerate(problem.node_names):
            total = sum(
                topology.adjacency[i, j] * gains.K[topology.name][receiver][problem.node_names[j]]
                for j in problem.neighbours(s, i)
            )
            np.testing.assert_allclose(total, problem.plant.A, atol=1e-13)


@pytest.mark.parametrize("seed", range(5))
def test_cliques_hold_every_group_and_form_a_tree(seed: int) -> None:
    """Each group lies in a clique; what is shared lies in both; the cliques that hold a vertex hang together."""
    rng = np.random.default_rng(seed)
    groups = [[int(v) for v in 1 + rng.choice(12, size=rng.integers(1, 4), replace=False)] for _ in range(10)]
    tree = cliques.clique_tree(groups)
    assert all(any(set(group) <= set(clique.vertices) for clique in tree) for group in groups)
    assert sum(clique.above is None for clique in tree) == 1
    for clique in tree:
        if clique.above is None:
            assert clique.shared == ()
            continue
        assert 0 in clique.shared
        assert set(clique.shared) == set(clique.vertices) & set(tree[clique.above].vertices)
    for v in {v for clique in tree for v in clique.vertices}:
        assert sum(v in clique.vertices and v not in clique.shared for clique in tree) == 1


@networks
def test_designs_are_confirmed_with_a_small_certificate(problem: Problem) -> None:
    """The check holds, P is diag{R, Q(s)}, its gamma is near the optimum, also after a round trip through the file.

    The exact gain is below, and proved too; R is left out where the errors do not depend on x.
    """
    gains = design(problem, method="decomposed")
    proved = gains.certificate
    assert proved.form == "structured"
    assert proved.lmi_gamma is not None
    assert proved.by_theorem1 is not None
    assert proved.lmi_gamma * (1.0 - 1e-5) <= proved.by_theorem1 <= proved.lmi_gamma * (1.0 + 1e-4)
    assert verify(Gains.from_bytes(gains.canonical(), source="memory")).holds
    assert (proved.R is None) is not problem.carries_plant
    assert proved.exact is not None
    assert proved.gamma == pytest.approx(min(proved.exact[1], proved.by_theorem1), rel=1e-9)
    assert gains.solver.residuals is not None
    assert max(gains.solver.residuals) < 1e-6


@pytest.mark.parametrize(
    "problem",
    [random_problem(11), BEYOND["unbiased-hidden"], real_network(random_problem(11), seen=True, unbiased=True)],
    ids=["paper", "unbiased", "without-x"],
)
def test_the_idle_network_is_strictly_inside(problem: Problem) -> None:
    """All weight on the network that ignores everything: K_ii = A, H = 0, and the check holds with room to spare."""
    solution = solved(problem)
    idle = inwards(problem, solution, 1.0)
    assert not idle.X.any()
    K_bar, H_bar = recover(problem, idle)
    np.testing.assert_allclose(K_bar[0], np.kron(np.eye(problem.n), problem.plant.A), atol=1e-12)
    P = block_diagonal(idle.R, idle.Q)
    gamma = 1.01 * least_gamma(error_model(problem, K_bar, H_bar).M, P)
    verdict = Prover(problem, *link_gains(problem, K_bar, H_bar), P=P).theorem1(gamma)
    assert verdict.holds
    assert min(verdict.margins.values()) > 1e-3


def broken(times: int, solver: Callable[..., conic.Answer]) -> Callable[..., conic.Answer]:
    """A solver that stalls the first times it is called."""
    calls = 0

    def clarabel(cones: Any, q: Array) -> conic.Answer:
        nonlocal calls
        calls += 1
        if calls > times:
            return solver(cones, q)
        record = Solver(name="CLARABEL", version="0", status="failed: NumericalError", iterations=3, seconds=0.0)
        return conic.Answer(np.zeros(len(q)), record)

    return clarabel


@pytest.mark.parametrize(
    ("times", "status", "name"),
    [
        (1, "optimal in other units; CLARABEL failed: NumericalError", "CLARABEL"),
        (2, "; CLARABEL failed: NumericalError; CLARABEL in other units failed: NumericalError", "SCS"),
    ],
)
def test_what_failed_before_an_answer_stands_in_the_status(
    times: int, status: str, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Clarabel, Clarabel in other units, SCS: the first answer is taken, and what failed before is said."""
    problem = random_problem(11)
    gamma = solved(problem).gamma
    monkeypatch.setattr(conic, "clarabel", broken(times, conic.clarabel))
    solution = decomposed.solve(problem)
    assert solution.solver.name == name
    assert status in solution.solver.status
    assert solution.gamma == pytest.approx(gamma, rel=1e-3)


def test_a_solver_that_stalls_is_tried_again_in_other_units(monkeypatch: pytest.MonkeyPatch) -> None:
    """An inaccurate answer is kept only where no accurate one follows; either way both are said."""
    problem, solver, calls = random_problem(11), conic.clarabel, 0

    def clarabel(cones: Any, q: Array) -> conic.Answer:
        nonlocal calls
        calls += 1
        u, record, _ = solver(cones, q)
        status = "optimal" if calls == 2 else "optimal_inaccurate"
        return conic.Answer(u, record.model_copy(update={"status": status}))

    monkeypatch.setattr(conic, "clarabel", clarabel)
    status = decomposed.solve(problem).solver.status
    assert status == "optimal in other units; CLARABEL optimal_inaccurate"
    status = decomposed.solve(problem).solver.status
    again = "optimal_inaccurate in other units; CLARABEL optimal_inaccurate"
    assert status == f"optimal_inaccurate; tried further: CLARABEL {again}"


def test_no_answer_at_all_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    """Unattainable lists every attempt."""
    monkeypatch.setattr(conic, "clarabel", broken(2, conic.clarabel))
    monkeypatch.setattr(conic, "installed", lambda solve: False)
    with pytest.raises(Unattainable, match=r"Error; CLARABEL in other units failed: .*Error\)"):
        decomposed.solve(find("two-nodes"))


def test_infeasible_is_said_and_no_other_solver_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    """A solver that proves infeasibility in both units ends the attempts with one sentence."""

    def clarabel(cones: Any, q: Array) -> conic.Answer:
        record = Solver(name="CLARABEL", version="0", status="infeasible", iterations=3, seconds=0.0)
        return conic.Answer(np.zeros(len(q)), record)

    monkeypatch.setattr(conic, "clarabel", clarabel)
    with pytest.raises(Unattainable, match=r"for two-nodes is infeasible \(CLARABEL infeasible; .* infeasible\)$"):
        decomposed.solve(find("two-nodes"))


class PanicException(BaseException):
    """What a panic of Clarabel is in Python: not an Exception."""


def test_a_panic_of_the_solver_is_a_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rust code that panics raises what `except Exception` does not catch; Ctrl-C is another thing."""

    class Fake:
        raised: BaseException = PanicException("index out of bounds: the len is 3")

        def __init__(self, *arguments: Any) -> None:
            pass

        def set_termination_callback(self, callback: Any) -> None:
            pass

        def solve(self) -> None:
            raise self.raised

    monkeypatch.setattr(clarabel, "DefaultSolver", Fake)
    lmi = decomposed.assemble(find("two-nodes"))
    record = conic.clarabel(lmi.cones, np.zeros(lmi.cones.A.shape[1])).record
    assert record.status == "failed: index out of bounds: the len is 3"
    assert record.residuals is None
    Fake.raised = KeyboardInterrupt()
    with pytest.raises(KeyboardInterrupt):
        conic.clarabel(lmi.cones, np.zeros(lmi.cones.A.shape[1]))


def test_a_state_in_thousands_and_one_in_thousandths_change_no_gamma() -> None:
    """In such units Clarabel fails; in natural ones the answer is that of the problem in units near 1."""
    problem, S = random_problem(11), np.diag([1e4, 1e-4])
    document, back = problem.document(), np.linalg.inv(S)
    plant = problem.plant
    document["plant"] = {
        "A": (S @ plant.A @ back).tolist(),
        "B": (S @ plant.B).tolist(),
        "M": (plant.M @ back).tolist(),
    }
    for node in document["node"]:
        node["C"] = (np.array(node["C"]) @ back).tolist()
    scaled = Problem.from_document(document)
    own = decomposed.assemble(scaled)
    q = np.zeros(own.cones.A.shape[1])
    q[own.delta] = 1.0
    assert conic.clarabel(own.cones, q).record.status.startswith("failed")
    solution = decomposed.solve(scaled)
    assert solution.solver.status == "optimal"
    assert solution.gamma == pytest.approx(solved(problem).gamma, rel=1e-6)


def test_clarabel_and_scs_call_an_infeasible_lmi_infeasible() -> None:
    """u >= 1 and -u >= 0: both solvers' words are translated."""
    build = Assembly()
    u, one = build.unknown(1, 1), np.zeros(1, dtype=np.int64)
    for factor, number in ((1.0, -1.0), (-1.0, 0.0)):
        inequality = build.inequality()
        inequality.append(1)
        inequality.add(one, one, u, factor=factor)
        inequality.add_number(one, one, np.array([[number]]))
    for solver in (conic.clarabel, conic.scs):
        assert solver(build.cones(), np.ones(1)).record.status == "infeasible"


def test_twenty_five_nodes_are_designed_in_seconds_and_stored_small() -> None:
    """4 modes: confirmed within 1e-4 of the optimum, in a gains file of less than 200 kB."""
    gains = design(banded(25), method="decomposed")
    assert gains.certificate.form == "structured"
    assert gains.certificate.by_theorem1 == pytest.approx(gains.certificate.lmi_gamma, rel=1e-4)
    assert len(gains.canonical()) < 200_000
    assert gains.solver.status == "optimal"
    assert gains.solver.version == clarabel.__version__


@pytest.mark.parametrize("seed", [1, 2])
def test_where_no_answer_is_confirmed_there_are_gains_that_ignore_all_measurements(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Their gamma is that of the gramian of the plant, as if no node had a sensor; and no hint at units."""

    def fails(problem: Problem) -> Iterator[LmiSolution]:
        raise Unattainable("no solver answered")

    problem = random_problem(seed)
    monkeypatch.setitem(lmi_design.METHODS, "decomposed", fails)
    gains = lmi_design.design_by_lmi(problem, "decomposed")
    A, B, M = problem.plant.A, problem.plant.B, problem.plant.M
    size = len(A)
    W = np.linalg.solve(np.eye(size**2) - np.kron(A, A), (B @ B.T).reshape(-1)).reshape(size, size)
    trivial = float(np.sqrt(problem.n * np.linalg.eigvalsh(M @ W @ M.T)[-1]))
    assert trivial < gains.certificate.gamma < trivial * (1.0 + 1e-4)
    assert "ignore all measurements, because no solver answered" in gains.solver.status
    assert verify(gains).holds
