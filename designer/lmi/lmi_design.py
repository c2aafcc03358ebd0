"""Gains by the paper's LMI: solve, recover the gains by (38), prove, and back off where needed.

All but the proof is done in natural units: there the same problem is solved, whatever the units of the one that was
given. The proof is of that one, with gains and P in its units.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from agent.contract.arrays import Array
from agent.contract.errors import Unattainable
from agent.contract.gains import Certificate, Gains, LinkMatrices, Solver, Weights
from agent.contract.problem import Problem
from designer.lmi import LmiSolution
from designer.lmi.attempts import tried_further
from designer.lmi.back_off import Confirmed, Prove, back_off, least_gamma, satisfies_17
from designer.lmi.inwards import inwards
from designer.lmi.recovery import block_diagonal, links, unconfirmed
from designer.model.error_model import error_model, link_gains, stacked_links
from designer.model.units import NaturalUnits, natural_units
from designer.patience import Budget, TimeIsUp, looking
from designer.proof.findings import Verdict
from designer.proof.prover import Prover


class Designed(NamedTuple):
    """Gains and P in natural units, and what the check says of them in those of the problem that was given."""

    K: LinkMatrices
    H: LinkMatrices
    confirmed: Confirmed

    @property
    def gamma(self) -> float:
        return self.confirmed.verdict.gamma


def design_by_lmi(problem: Problem, method: str, budget: Budget | None = None) -> Gains:
    """KeyboardInterrupt and TimeIsUp where a signal or the end of the budget came before an answer was confirmed."""
    started, budget, natural = time.perf_counter(), Budget() if budget is None else budget, NaturalUnits(problem)
    try:
        found = first_confirmed(natural, method, METHODS[method](natural.problem), budget)
    except Unattainable as error:
        ignorant = gains_that_ignore(problem, method, str(error), started) if method in MOVABLE else None
        if ignorant is None:
            raise
        return ignorant
    solution, designed, certify = found
    ended = time.perf_counter()
    return Gains.of(
        problem,
        *natural.back(designed.K, designed.H),
        method=method,
        certificate=_certificate(
            natural, designed.confirmed, lmi_gamma=solution.gamma, weights=_weights(natural, solution)
        ),
        solver=solution.solver,
        solve=ended - started - certify,
        certify=certify,
    )


def gains_that_ignore(problem: Problem, method: str, why: str, started: float) -> Gains | None:
    """What is left of a design that began then and came to nothing; None: of an unstable plant nothing is."""
    begun, natural = time.perf_counter(), NaturalUnits(problem, exactly=True)
    designed = ignoring(natural)
    if designed is None:
        return None
    status, ended = f"gains that ignore all measurements, because {why}", time.perf_counter()
    return Gains.of(
        problem,
        *natural.back(designed.K, designed.H),
        method=method,
        certificate=_certificate(natural, designed.confirmed, lmi_gamma=None),
        solver=Solver(name="none", version="-", status=status, iterations=0, seconds=begun - started),
        solve=begun - started,
        certify=ended - begun,
    )


def ignoring(natural: NaturalUnits) -> Designed | None:
    """K_ii = A and no measurement: what is left where no answer of a solver is confirmed; None: an unstable plant."""
    problem = natural.problem
    n, modes = problem.n, len(problem.topologies)
    K, H = link_gains(problem, np.tile(np.kron(np.eye(n), problem.plant.A), (modes, 1, 1)), no_measurements(problem))
    M = error_model(problem, *stacked_links(problem, K, H)).M
    p = problem.plant_states
    for spare in _SPARE if problem.plant.spectral_radius < 1.0 else ():
        W_inverse = np.asarray(np.linalg.inv(reachable(problem, spare)), dtype=np.float64)
        Q = np.tile((1.0 - spare) * W_inverse / n, (modes, n, 1, 1))
        P = block_diagonal(spare * W_inverse[:p, :p], (Q + Q.swapaxes(2, 3)) / 2.0)
        verdict = _prove(natural, K, H)(P, least_gamma(M, P) * (1.0 + 1e-9))
        if verdict.holds:
            return Designed(K, H, Confirmed(P, "structured", 0.0, verdict))
    return None


def reachable(problem: Problem, spare: float) -> Array:
    """W with W - A W A' a little more than B B': then W^-1 satisfies (17) for x+ = A x + B w, strictly.

    Where gains ignore all measurements, x and every e_i move like that, with the same w. By the convexity of squares a
    mean of W^-1 over all of them satisfies (17) for them together, and (18) says gamma^2 = n lambda_max(M W M').
    """
    A, B = problem.plant.A, problem.plant.B
    units = natural_units(problem).state
    W, power = B @ B.T + spare * np.diag(units**2), A
    for _ in range(_DOUBLINGS):
        W, power = W + power @ W @ power.T, power @ power
    return np.asarray((W + W.T) / 2.0)


def no_measurements(problem: Problem) -> Array:
    """H_bar of gains that use none."""
    rows = sum(len(node.C) for node in problem.nodes)
    return np.zeros((len(problem.topologies), problem.n * problem.nx, rows))


def first_confirmed(
    natural: NaturalUnits, method: str, answers: Iterator[LmiSolution], budget: Budget
) -> tuple[LmiSolution, Designed, float]:
    """The first answer whose gamma the check confirms at most _NEAR above the LMI's; else the best that it confirms.

    `answers` are those for natural.problem; gamma of the one that is returned is that of the problem that was given.
    With the seconds that the checks took. Unattainable: no answer, or none that is confirmed. KeyboardInterrupt,
    TimeIsUp: none yet.
    """
    seconds, best, refused = 0.0, None, None
    while True:
        try:
            with looking(budget.check):
                budget.check()
                following = next(answers, None)
        except (KeyboardInterrupt, TimeIsUp):
            if best is None:
                raise
            break
        if following is None:
            break
        solution, begun = following._replace(gamma=natural.output * following.gamma), time.perf_counter()
        try:
            with looking(budget.check_last):
                designed = (_moved_inwards(natural, solution) if method in MOVABLE else None) or _confirm(
                    natural, solution
                )
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


def _prove(natural: NaturalUnits, K: LinkMatrices, H: LinkMatrices) -> Prove:
    """Of the problem that was given, from P and gamma in natural units."""
    given = natural.back(K, H)

    def prove(P: Array, gamma: float) -> Verdict:
        return Prover(natural.given, *given, P=natural.P_back(P)).theorem1(natural.output * gamma)

    return prove


def _confirm(natural: NaturalUnits, solution: LmiSolution) -> Designed:
    """The solver's own gains; their P and gamma backed off until the check confirms them; or Unattainable."""
    problem = natural.problem
    K, H = links(problem, solution)
    confirmed = back_off(problem, K, H, block_diagonal(solution.R, solution.Q), _prove(natural, K, H))
    if not confirmed.verdict.holds:
        raise unconfirmed(problem, solution, confirmed.verdict.failure)
    return Designed(K, H, confirmed)


def _moved_inwards(natural: NaturalUnits, solution: LmiSolution) -> Designed | None:
    """Gains and P together a little inside the LMI, so that P keeps its form; None: not confirmed that way.

    For an unstable plant the answer itself has something to spare: the LMI was solved with a margin.
    """
    problem = natural.problem
    for t in STEPS_INWARDS if problem.plant.spectral_radius < 1.0 else (0.0,):
        moved = inwards(problem, solution, t) if t else solution
        K, H = links(problem, moved)
        P = block_diagonal(moved.R, moved.Q)
        model = error_model(problem, *stacked_links(problem, K, H))
        if not satisfies_17(model, P):
            continue
        gamma = least_gamma(model.M, P) * (1.0 + 1e-9 + t / 100.0)  # so that (18) is strict
        verdict = _prove(natural, K, H)(P, gamma)
        if verdict.holds:
            return Designed(K, H, Confirmed(P, "structured", t, verdict))
    return None


def _weights(natural: NaturalUnits, solution: LmiSolution) -> Weights | None:
    """The multipliers, which prove nothing yet: designer.undercut makes of them what does, if anything can be made."""
    if solution.weights is None:
        return None
    problem = natural.given
    return Weights.of(np.eye(problem.nx), natural.V_back(solution.weights), problem.mode_names)


def _certificate(
    natural: NaturalUnits, confirmed: Confirmed, *, lmi_gamma: float | None, weights: Weights | None = None
) -> Certificate:
    """Of the problem that was given."""
    problem, P, verdict = natural.given, natural.P_back(confirmed.P), confirmed.verdict
    nx, p = problem.nx, problem.plant_states
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
        lmi_weights=weights,
        holds=verdict.holds,
        verified=f"(17) and (18) of Theorem 1 in every mode, for the numbers stored here: {verdict.arithmetic}",
        margins=verdict.margins,
    )


def _theorem2(problem: Problem) -> Iterator[LmiSolution]:
    from designer.lmi import theorem2  # cvxpy takes seconds to import, so only who solves pays for it

    return theorem2.answers(problem, unit=_LARGER)


def _theorem2_reduced(problem: Problem) -> Iterator[LmiSolution]:
    from designer.lmi import theorem2

    return theorem2.answers(problem, reduced=True, unit=_LARGER)


def _decomposed(problem: Problem) -> Iterator[LmiSolution]:
    from designer.lmi import decomposed

    return decomposed.answers(problem)


METHODS: dict[str, Callable[[Problem], Iterator[LmiSolution]]] = {
    "theorem2": _theorem2,  # (36)(37) as printed
    "theorem2-reduced": _theorem2_reduced,  # the same for the state [x; e]: faster, gamma equal or slightly lower
    "decomposed": _decomposed,  # the same optimum as theorem2-reduced, node by node: for large networks
}

# Methods whose gains may be moved a little together with P: their P stays small enough to store for large networks.
# The others are the paper's, and their gains stay as the solver gave them.
MOVABLE = frozenset({"decomposed"})
_LARGER = 2.0  # than natural units: of what was tried, so the P of the literal LMI is the most often provable
_SPARE = (1e-6, 1e-4, 1e-2)  # of P, for x and for strictness
_DOUBLINGS = 60
_NEAR = 5e-4  # a certified gamma this little above the LMI's, relatively, is taken at once
STEPS_INWARDS = (0.0, 1e-6, 3e-6, 1e-5, 2e-5, 5e-5, 1e-4, 2e-4, 5e-4, 1e-3)
