"""From a problem to gains: pick a method, solve, recover the gains by (38), check, and back off where needed."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from agent.contract.arrays import Array
from agent.contract.errors import InputError, Unattainable, listed
from agent.contract.gains import Certificate, Gains, LinkMatrices
from agent.contract.problem import Problem
from designer.diagnosis import explained, refuse_hopeless, refuse_nothing_to_estimate
from designer.gain.worst_case import with_worst_case
from designer.lmi import LmiSolution
from designer.lmi.attempts import tried_further
from designer.lmi.back_off import Confirmed, back_off, least_gamma, satisfies_17
from designer.lmi.inwards import inwards
from designer.model.error_model import error_model, link_gains, stacked_links
from designer.proof.theorem1 import check
from designer.search.descent import Progress
from designer.search.effort import default_method
from designer.search.exact_design import design_exact, with_ladder


class Designed(NamedTuple):
    """Gains, and what the check says of them."""

    K: LinkMatrices
    H: LinkMatrices
    confirmed: Confirmed

    @property
    def gamma(self) -> float:
        return self.confirmed.verdict.gamma


def design(problem: Problem, *, method: str | None = None, progress: Callable[[Progress], None] | None = None) -> Gains:
    """Gains for every mode and link, with a gamma that the check without a solver confirms.

    The default method is "exact" where that takes at most about ten minutes, else "decomposed".
    `progress` is called during the method "exact" only, which also returns its best gains on KeyboardInterrupt.
    Raises InputError for an unknown method, Unattainable where no gains or no certificate were found, with the reason
    as far as it is known.
    """
    method = default_method(problem) if method is None else method
    if method not in METHODS and method != EXACT:
        raise InputError(f'method "{method}" does not exist; the methods are {listed([*METHODS, EXACT])}')
    refuse_nothing_to_estimate(problem)
    refuse_hopeless(problem)
    try:
        return with_worst_case(
            design_exact(problem, progress=progress) if method == EXACT else _by_lmi(problem, method)
        )
    except Unattainable as error:
        raise explained(problem, error, _solvable) from None


def _solvable(problem: Problem) -> bool:
    """Whether the decomposed LMI has an answer that is confirmed."""
    from designer.lmi import decomposed

    try:
        _first_confirmed(problem, "decomposed", decomposed.answers(problem, last_resort=False))
    except Unattainable:
        return False
    return True


def _by_lmi(problem: Problem, method: str) -> Gains:
    started = time.perf_counter()
    solution, (K, H, confirmed), certify = _first_confirmed(problem, method, METHODS[method](problem))
    ended = time.perf_counter()
    return Gains(
        problem=problem,
        problem_digest=problem.digest(),
        method=method,
        K=K,
        H=H,
        certificate=with_ladder(problem, K, H, _certificate(problem, confirmed, lmi_gamma=solution.gamma)),
        solver=solution.solver,
        seconds={"solve": ended - started - certify, "certify": certify, "total": ended - started},
    )


def _first_confirmed(
    problem: Problem, method: str, answers: Iterator[LmiSolution]
) -> tuple[LmiSolution, Designed, float]:
    """The first answer whose gamma the check confirms at most _NEAR above the LMI's; else the best that it confirms.

    With the seconds that the checks took. Unattainable: no answer, or none that is confirmed.
    """
    seconds, best, refused = 0.0, None, None
    for solution in answers:
        begun = time.perf_counter()
        try:
            designed = (_moved_inwards(problem, solution) if method in MOVABLE else None) or _confirm(problem, solution)
        except Unattainable as error:
            refused = refused or error
        else:
            if best is None or designed.gamma < best[1].gamma:
                best = solution, designed
        seconds += time.perf_counter() - begun
        if best is not None and best[1].gamma <= best[0].gamma * (1.0 + _NEAR):
            break
    if best is None:
        assert refused is not None
        raise refused
    return tried_further(best[0], solution), best[1], seconds


def recover(problem: Problem, solution: LmiSolution) -> tuple[Array, Array]:
    """Eq. (38): K_bar^s = Q_bar(s)^-1 Y^s (modes, n nx, n nx) and H_bar^s = Q_bar(s)^-1 X^s (modes, n nx, sum ny).

    Node by node: Q_bar is block diagonal, so a block that is zero in X and Y stays exactly zero. Where the gains
    have to be unbiased, K_ii is what the other K_ij leave of A.
    """
    modes, n, nx = len(problem.topologies), problem.n, problem.nx
    Q_bar = np.tensordot(problem.markov.transition, solution.Q, axes=1)  # (modes, n, nx, nx)
    try:
        K = np.linalg.solve(Q_bar, solution.Y.reshape(modes, n, nx, -1))
        H = np.linalg.solve(Q_bar, solution.X.reshape(modes, n, nx, -1))
    except np.linalg.LinAlgError:
        raise _unconfirmed(problem, solution, "Q_bar(s) is singular") from None
    if problem.unbiased:
        blocks, i = K.reshape(modes, n, nx, n, nx), np.arange(n)
        blocks[:, i, :, i] = 0.0
        blocks[:, i, :, i] = problem.plant.A - blocks.sum(axis=3).swapaxes(0, 1)
    return np.asarray(K).reshape(solution.Y.shape), np.asarray(H).reshape(solution.X.shape)


def block_diagonal(R: Array, Q: Array) -> Array:
    """P(s) = diag{R, Q_1(s), ..., Q_n(s)}, (modes, n_eta, n_eta), from R (nx, nx) or (0, 0), Q (modes, n, nx, nx)."""
    modes, n, nx, _ = Q.shape
    p = len(R)
    P = np.zeros((modes, p + n * nx, p + n * nx))
    P[:, :p, :p] = R
    for i in range(n):
        rows = slice(p + i * nx, p + (i + 1) * nx)
        P[:, rows, rows] = Q[:, i]
    return P


def _confirm(problem: Problem, solution: LmiSolution) -> Designed:
    """The solver's own gains; their P and gamma backed off until the check confirms them; or Unattainable."""
    K, H = _links(problem, solution)
    confirmed = back_off(problem, K, H, block_diagonal(solution.R, solution.Q))
    if not confirmed.verdict.holds:
        raise _unconfirmed(problem, solution, confirmed.verdict.failure)
    return Designed(K, H, confirmed)


def _moved_inwards(problem: Problem, solution: LmiSolution) -> Designed | None:
    """Gains and P together a little inside the LMI, so that P keeps its form; None: not confirmed that way.

    For an unstable plant the answer itself has something to spare: the LMI was solved with a margin.
    """
    for t in STEPS_INWARDS if problem.plant.spectral_radius < 1.0 else (0.0,):
        moved = inwards(problem, solution, t) if t else solution
        K, H = _links(problem, moved)
        P = block_diagonal(moved.R, moved.Q)
        model = error_model(problem, *stacked_links(problem, K, H))
        if not satisfies_17(model, P):
            continue
        gamma = least_gamma(model.M, P) * (1.0 + 1e-9 + t / 100.0)  # so that (18) is strict
        verdict = check(problem, K, H, P=P, gamma=gamma)
        if verdict.holds:
            return Designed(K, H, Confirmed(P, "structured", t, verdict))
    return None


def _links(problem: Problem, solution: LmiSolution) -> tuple[LinkMatrices, LinkMatrices]:
    """The gains of every link; Unattainable where they are not numbers."""
    K_bar, H_bar = recover(problem, solution)
    if not (np.isfinite(K_bar).all() and np.isfinite(H_bar).all() and math.isfinite(solution.gamma)):
        raise _unconfirmed(problem, solution, "some of its numbers are not finite")
    return link_gains(problem, K_bar, H_bar)


def _unconfirmed(problem: Problem, solution: LmiSolution, why: str | None) -> Unattainable:
    advice = "; try the problem in other units, so that its numbers are near 1"
    return Unattainable(
        f"{solution.solver.name} says {solution.solver.status} with gamma {solution.gamma:.6g} for {problem.name}, "
        f"but the check without a solver does not confirm its answer ({why})"
        + (advice if problem.plant.spectral_radius < 1.0 else "")
    )


def _certificate(problem: Problem, confirmed: Confirmed, *, lmi_gamma: float) -> Certificate:
    P, verdict, nx, p = confirmed.P, confirmed.verdict, problem.nx, problem.plant_states
    modes, nodes = problem.mode_names, problem.node_names
    structured = confirmed.form == "structured"
    parts = [slice(p + i * nx, p + (i + 1) * nx) for i in range(problem.n)]
    return Certificate(
        gamma=verdict.gamma,
        kind="lyapunov",
        form=confirmed.form,
        R=P[0, :p, :p] if structured and p else None,
        Q={
            mode: {node: P[s, part, part] for node, part in zip(nodes, parts, strict=True)}
            for s, mode in enumerate(modes)
        }
        if structured
        else None,
        P=None if structured else dict(zip(modes, P, strict=True)),
        lmi_gamma=lmi_gamma,
        holds=verdict.holds,
        verified=f"(17) and (18) of Theorem 1 in every mode, for the numbers stored here: {verdict.arithmetic}",
        margins=verdict.margins,
    )


def _theorem2(problem: Problem) -> Iterator[LmiSolution]:
    from designer.lmi import theorem2  # cvxpy takes seconds to import, so only who solves pays for it

    return theorem2.answers(problem)


def _theorem2_reduced(problem: Problem) -> Iterator[LmiSolution]:
    from designer.lmi import theorem2

    return theorem2.answers(problem, reduced=True)


def _decomposed(problem: Problem) -> Iterator[LmiSolution]:
    from designer.lmi import decomposed

    return decomposed.answers(problem)


EXACT = "exact"  # gains designed for the exact gain; no LMI, and a certificate of its own kind
METHODS: dict[str, Callable[[Problem], Iterator[LmiSolution]]] = {
    "theorem2": _theorem2,  # (36)(37) as printed
    "theorem2-reduced": _theorem2_reduced,  # the same for the state [x; e]: faster, gamma equal or slightly lower
    "decomposed": _decomposed,  # the same optimum as theorem2-reduced, node by node: for large networks
}

# Methods whose gains may be moved a little together with P: their P stays small enough to store for large networks.
# The others are the paper's, and their gains stay as the solver gave them.
MOVABLE = frozenset({"decomposed"})
_NEAR = 5e-4  # a certified gamma this little above the LMI's, relatively, is taken at once
STEPS_INWARDS = (0.0, 1e-6, 3e-6, 1e-5, 2e-5, 5e-5, 1e-4, 2e-4, 5e-4, 1e-3)
