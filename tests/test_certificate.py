"""The check of Theorem 1, and mutants of a good certificate that it must refuse."""

from __future__ import annotations

import copy
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from networks import random_gains, random_problem

from agent.contract.errors import InputError
from agent.contract.gains import Gains
from agent.contract.problem import Problem
from designer.back_off import back_off, coupled_lyapunov
from designer.certificate import check, inequality_17, inequality_18, least_gamma, lyapunov_matrix, verify
from designer.error_model import error_model, stacked_gains
from designer.problems import find
from designer.synthesis import design

Document = dict[str, Any]


@pytest.fixture(scope="module")
def gains() -> Gains:
    """A certificate with P in full."""
    designed = design(find("zhu2020-lossy"), method="theorem2-reduced")
    P = dict(zip(designed.problem.mode_names, lyapunov_matrix(designed), strict=True))
    proved = designed.certificate.model_copy(update={"form": "full", "P": P, "R": None, "Q": None})
    return designed.model_copy(update={"certificate": proved})


@pytest.fixture(scope="module")
def structured() -> Gains:
    return design(find("zhu2020-ideal"), method="theorem2")


def mutated(gains: Gains, mutate: Callable[[Document], None]) -> Gains:
    """The gains after an edit of their document, with a digest that fits the edited problem."""
    document = copy.deepcopy(gains.document())
    mutate(document)
    document["problem_digest"] = Problem.from_document(document["problem"]).digest()
    return Gains.model_validate(document)


def lower_gamma(document: Document) -> None:
    document["certificate"]["gamma"] *= 1.0 - 1e-6


def change_one_gain(document: Document) -> None:
    document["K"]["3"]["2"]["1"][0][1] += 0.5


def change_one_measurement_gain(document: Document) -> None:
    document["H"]["2"]["4"]["3"][0][0] += 0.5


def swap_arrival_and_loss(document: Document) -> None:
    for node in document["problem"]["node"]:
        node["arrival_probability"] = 1.0 - node["arrival_probability"]


def permute_modes_of_P(document: Document) -> None:
    P = document["certificate"]["P"]
    document["certificate"]["P"] = {"1": P["2"], "2": P["3"], "3": P["4"], "4": P["1"]}


def change_transition(document: Document) -> None:
    document["problem"]["markov"]["transition"] = np.eye(4)[[1, 0, 3, 2]].tolist()


def make_P_indefinite(document: Document) -> None:
    P = document["certificate"]["P"]["4"]
    P[0][0] = -P[0][0]


def scale_P_up(document: Document) -> None:
    P = document["certificate"]["P"]
    document["certificate"]["P"] = {mode: (1.0001 * np.array(matrix)).tolist() for mode, matrix in P.items()}


MUTANTS = [
    (lower_gamma, "(18)"),
    (change_one_gain, "(17)"),
    (change_one_measurement_gain, "(17)"),
    (swap_arrival_and_loss, "(17)"),
    (permute_modes_of_P, "(1"),
    (change_transition, "(17)"),
    (make_P_indefinite, "(1"),
    (scale_P_up, "(17)"),
]


def test_the_designed_gains_hold_after_a_round_trip_through_the_file(gains: Gains, structured: Gains) -> None:
    """What design saves, verify confirms, with every margin positive, for both forms of P."""
    assert gains.certificate.form == "full"
    assert structured.certificate.form == "structured"
    for designed in (gains, structured):
        verdict = verify(Gains.from_bytes(designed.canonical(), source="memory"))
        assert verdict.holds
        assert verdict.failure is None
        assert verdict.gamma == designed.certificate.gamma
        assert set(verdict.margins) == {f"({i}) mode {s}" for i in (17, 18) for s in "1234"}
        assert min(verdict.margins.values()) > 0.0


@pytest.mark.parametrize(("mutate", "inequality"), MUTANTS)
def test_a_mutant_fails_and_the_failure_names_inequality_and_mode(
    gains: Gains, mutate: Callable[[Document], None], inequality: str
) -> None:
    """Any edit that breaks Theorem 1 gives a verdict with holds = False, not an exception."""
    verdict = verify(mutated(gains, mutate))
    assert not verdict.holds
    assert verdict.failure is not None
    assert verdict.failure.startswith(f"inequality {inequality}")
    assert "mode" in verdict.failure
    assert min(verdict.margins.values()) <= 0.0


def test_a_certificate_without_its_matrices_is_malformed_input(structured: Gains) -> None:
    """A missing Q of one node is bad input, named; so is a P of the wrong size."""
    with pytest.raises(InputError, match='Q of mode 2 lacks "3"'):
        verify(mutated(structured, lambda document: document["certificate"]["Q"]["2"].pop("3")))
    with pytest.raises(InputError, match="it must be 2 x 2"):
        verify(mutated(structured, lambda document: document["certificate"].update(R=[[1.0]])))


def test_the_check_is_theorem_1_as_printed(gains: Gains) -> None:
    """Positive definite matrices of the check are negative definite matrices (17) and (18)."""
    problem, P, gamma = gains.problem, lyapunov_matrix(gains), gains.certificate.gamma
    model = error_model(problem, *stacked_gains(gains))
    for s in range(4):
        A, B, M = model.A[s], model.B[s], model.M
        P_bar = sum(problem.markov.transition[s, t] * P[t] for t in range(4))
        lost = sum(
            model.alpha[i] * model.F_i(s, i)[:, : model.size].T @ P_bar @ model.F_i(s, i)[:, : model.size]
            for i in range(4)
        )
        printed = np.block(
            [[A.T @ P_bar @ A + lost - P[s], A.T @ P_bar @ B], [B.T @ P_bar @ A, B.T @ P_bar @ B - np.eye(1)]]
        )
        np.testing.assert_allclose(inequality_17(model, s, P), -printed, atol=1e-12 * np.abs(P).max())
        printed_18 = np.block([[-P[s], M.T], [M, -(gamma**2) * np.eye(len(M))]])
        assert np.linalg.eigvalsh(printed_18).max() < 0.0
        assert np.linalg.eigvalsh(inequality_18(model, s, P, gamma)).min() > 0.0


def test_least_gamma_is_where_18_turns() -> None:
    """(18) holds just above the least gamma and fails just below."""
    problem = random_problem(3)
    K_bar, H_bar = random_gains(problem, 3, size=0.1)
    model = error_model(problem, K_bar, H_bar)
    P = np.array([(s + 1.0) * np.diag(1.0 + np.arange(len(model.A[0]))) for s in range(2)])
    gamma = least_gamma(model.M, P)
    for factor, holds in ((1.0 + 1e-6, True), (1.0 - 1e-6, False)):
        verdict = check(problem, K_bar, H_bar, P=P, gamma=factor * gamma)
        assert all((verdict.margins[f"(18) mode m{s}"] > 0.0) for s in range(2)) is holds


@pytest.mark.parametrize("seed", range(6))
def test_gains_without_any_lmi_get_a_certificate_from_the_lyapunov_equation(seed: int) -> None:
    """For mean-square stable gains a small enough multiple of P0 satisfies (17), so the back-off has a start."""
    problem = random_problem(seed)
    K_bar, H_bar = random_gains(problem, seed, size=0.1)
    model = error_model(problem, K_bar, H_bar)
    P0 = coupled_lyapunov(model, np.tile(np.eye(len(model.A[0])), (2, 1, 1)))
    assert P0 is not None
    confirmed = back_off(problem, K_bar, H_bar, 1e-3 * P0 / np.abs(P0).max())
    assert confirmed.verdict.holds


def test_unstable_gains_are_never_confirmed() -> None:
    """Gains whose error grows in the mean square have no P, and the back-off says so."""
    problem = random_problem(1)
    K_bar, H_bar = random_gains(problem, 1, size=0.1)
    K_bar = K_bar + 1.5 * np.eye(len(K_bar[0]))
    model = error_model(problem, K_bar, H_bar)
    P = np.tile(np.eye(len(model.A[0])), (2, 1, 1))
    assert coupled_lyapunov(model, P) is None
    confirmed = back_off(problem, K_bar, H_bar, P)
    assert not confirmed.verdict.holds
    assert confirmed.verdict.failure is not None


def test_what_is_singular_in_exact_arithmetic_is_not_confirmed() -> None:
    """P = M'M / gamma^2 on one state meets (18) with equality: refused; with 1e-12 to spare: accepted."""
    problem = find("two-nodes")
    zero, P = np.zeros((1, 2, 2)), np.diag([1.0, 0.25, 0.25])[None]
    for gamma, holds in ((2.0, False), (2.0 * (1.0 + 1e-12), True)):
        margin = check(problem, zero, zero, P=P, gamma=gamma).margins["(18) mode linked"]
        assert (margin > 0.0) is holds


def test_verifying_imports_no_solver(gains: Gains, tmp_path: Path) -> None:
    """The check runs in a process that never loads cvxpy, a conic solver or scipy."""
    path = tmp_path / "gains.json"
    gains.save(path)
    code = (
        "import sys; from pathlib import Path; from agent.contract.gains import Gains;"
        "from designer.certificate import verify; assert verify(Gains.load(Path(sys.argv[1]))).holds;"
        "print(sorted({'cvxpy', 'clarabel', 'scs', 'scipy'} & set(sys.modules)))"
    )
    root = Path(__file__).parents[1]
    done = subprocess.run([sys.executable, "-c", code, path], cwd=root, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
