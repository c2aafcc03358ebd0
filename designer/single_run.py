"""What a P of (17) and (18) proves of single runs, with a probability: gamma and P."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from agent.contract.arrays import Array
from agent.contract.errors import InputError
from agent.contract.gains import Gains, LinkMatrices
from agent.contract.problem import Problem
from designer.gain.energy import energy_matrix
from designer.gain.exact import Operator
from designer.model.error_model import error_model, stacked_links

if TYPE_CHECKING:
    from designer.proof.prover import Prover

_ROUNDED = 1e-6  # relative: room for a proof
_FEW = 60  # states of the errors up to which a P is sought


def single_run(gains: Gains) -> tuple[float, Array] | None:
    """The least gamma that the certificate's P proves by (17) and (18), and P: for what holds of single runs.

    V = eta'P(r)eta minus the energy so far is a supermartingale by (17), and |z_tilde|^2 <= gamma^2 V by (18), so the
    inequality of Ville bounds how often |z_tilde| is large. A certificate of kind "exact" proves a smaller gamma by
    other means, which says nothing of single runs; its P, or one that is made here, is taken all the same. None where
    there is none.
    """
    from designer.proof.certificate import lyapunov_matrix, stored_P  # it loads ball arithmetic

    try:
        if gains.certificate.by_theorem1 is not None:
            return gains.certificate.by_theorem1, lyapunov_matrix(gains)
        P = stored_P(gains)
    except InputError:
        return None
    return single_run_of(gains.problem, gains.K, gains.H, gains.certificate.gamma, P)


def single_run_of(
    problem: Problem, K: LinkMatrices, H: LinkMatrices, gamma: float, P: Array | None
) -> tuple[float, Array] | None:
    """The same of gains whose exact gain is about gamma; where there is no P, the better of two that are made."""
    from designer.proof.prover import Prover

    operator = Operator(error_model(problem, *stacked_links(problem, K, H)))
    tried = [P]
    if P is None and operator.size <= _FEW:
        tried = [energy_matrix(operator, gamma), None]
    found = [least_of_P(problem, Prover(problem, K, H, P=each)) for each in tried]
    return min((each for each in found if each is not None), key=lambda each: each[0], default=None)


def least_of_P(problem: Problem, prover: Prover) -> tuple[float, Array] | None:
    """The least gamma with (17) and (18) for the P of a prover, proved, and P; or None."""
    p, P = problem.plant_states, prover.P
    if P is None:
        return None
    try:
        M = np.zeros((problem.n * problem.nz, P.shape[1]))
        M[:, p:] = np.kron(np.diag(problem.weights), problem.plant.M)
        square = max(np.linalg.eigvalsh(M @ np.linalg.solve((P_s + P_s.T) / 2.0, M.T))[-1] for P_s in P)
    except np.linalg.LinAlgError:
        return None
    if not 0.0 < square < np.inf:
        return None
    gamma = float(np.sqrt(square) * (1.0 + _ROUNDED))
    return (gamma, P) if prover.theorem1(gamma).holds else None
