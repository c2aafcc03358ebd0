"""What a P of (17) and (18) proves of single runs, with a probability: gamma and P."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from agent.contract.arrays import Array
from agent.contract.errors import InputError
from agent.contract.gains import Gains, LinkMatrices
from agent.contract.problem import Problem
from designer.coordinates import Coordinates
from designer.gain.energy import energy_matrix
from designer.gain.exact import Operator
from designer.model.error_model import model_of_gains

if TYPE_CHECKING:
    from designer.proof.prover import Prover

_ROUNDED = 1e-6  # relative: room for a proof
_FEW = 60  # states of the errors up to which a P is sought


class SingleRun(NamedTuple):
    """gamma that P proves by (17) and (18); P (modes, n_eta, n_eta) is of [T x; T e], or of [x; e] where T is None."""

    gamma: float
    P: Array
    T: Array | None = None


def single_run(gains: Gains) -> SingleRun | None:
    """The least gamma that the certificate's P proves by (17) and (18), and P: for what holds of single runs.

    V = eta'P(r)eta minus the energy so far is a supermartingale by (17), and |z_tilde|^2 <= gamma^2 V by (18), so the
    inequality of Ville bounds how often |z_tilde| is large. A certificate of kind "exact" proves a smaller gamma by
    other means, which says nothing of single runs; its P, or one that is made here, is taken all the same. None where
    there is none.
    """
    from designer.proof.certificate import lyapunov_matrix, stored_P  # it loads ball arithmetic

    try:
        if gains.certificate.by_theorem1 is not None:
            return SingleRun(gains.certificate.by_theorem1, lyapunov_matrix(gains))
        P = stored_P(gains)
    except InputError:
        return None
    return single_run_of(gains.problem, gains.K, gains.H, gains.certificate.gamma, P)


def single_run_of(
    problem: Problem, K: LinkMatrices, H: LinkMatrices, gamma: float, P: Array | None
) -> SingleRun | None:
    """The same of gains whose exact gain is about gamma; where there is no P, the better of two that are made."""
    from designer.proof.prover import Prover

    made, provers = Prover(problem, K, H), [Prover(problem, K, H, P=P)]
    if P is None:
        provers, operator = [made], Operator(model_of_gains(problem, K, H))
        if operator.size <= _FEW:
            provers.insert(0, Prover(problem, K, H, P=energy_matrix(operator, gamma), T=made.T))
    found = [least_of_P(problem, prover) for prover in provers]
    return min((each for each in found if each is not None), key=lambda each: each.gamma, default=None)


def least_of_P(problem: Problem, prover: Prover) -> SingleRun | None:
    """The least gamma with (17) and (18) for the P of a prover, proved; or None."""
    p, P = problem.plant_states, prover.P
    coordinates = None if prover.T is None else Coordinates.of(problem)
    M_i = problem.plant.M if coordinates is None else coordinates.problem.plant.M
    if P is None:
        return None
    try:
        M = np.zeros((problem.n * problem.nz, P.shape[1]))
        M[:, p:] = np.kron(np.diag(problem.weights), M_i)
        square = max(np.linalg.eigvalsh(M @ np.linalg.solve((P_s + P_s.T) / 2.0, M.T))[-1] for P_s in P)
    except np.linalg.LinAlgError:
        return None
    if not 0.0 < square < np.inf:
        return None
    gamma = float(np.sqrt(square) * (1.0 + _ROUNDED))
    return SingleRun(gamma, P, prover.T) if prover.theorem1(gamma).holds else None
