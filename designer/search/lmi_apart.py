"""Gains of an LMI where M cancels: it is solved in the coordinates in which M does not (designer.coordinates).

Its optimum is the same there, and a solver finds it. Back among the states the gains are rounded. Where that would move
z by much, those of their entries that no file could hold are set to 0 first; and where it leaves nothing that is
stable, then. P goes back with them, and where it proves nothing any more, as its numbers are too large beside each
other, the exact gain is what is proved of the gains.
"""

from __future__ import annotations

from contextlib import suppress

import numpy as np
from numpy.typing import NDArray

from agent.contract.arrays import Array
from agent.contract.errors import Unattainable
from agent.contract.gains import Certificate, Gains, LinkMatrices
from agent.contract.problem import Problem
from designer.coordinates import Coordinates
from designer.lmi.lmi_design import design_by_lmi
from designer.model.units import NaturalUnits
from designer.patience import Budget
from designer.proof.certificate import prover_of
from designer.search.exact_design import certify

_ABOVE = (1e-9, 1e-6, 1e-4, 1e-3)  # by this part of itself gamma may be larger than in those coordinates
_MOST = 2.0**43  # times 2^-53, and the natural unit of z: so much may a rounding move z
_HELD = "entries that no file could hold are 0"


def design_apart(problem: Problem, method: str, budget: Budget | None = None) -> Gains | None:
    """None: M does not cancel, or nothing is proved of what comes of it."""
    coordinates = Coordinates.of(problem)
    if coordinates is None:
        return None
    natural, budget = NaturalUnits(problem, coordinates), Budget() if budget is None else budget
    try:
        there = design_by_lmi(natural.problem, method, budget)
    except Unattainable:
        return None
    assert natural.magnified is not None
    assert natural.held is not None
    claim = _brought_back(there.certificate, coordinates.T / natural.state[:, None], natural.output)
    same = {"problem": problem, "problem_digest": problem.digest(), "certificate": claim}
    status = f"{there.solver.status}; {_HELD}"
    without = _without(there.K, natural.held), there.solver.model_copy(update={"status": status})
    offered = [(there.K, there.solver), without]
    if _most(there.K, natural.magnified) > _MOST:
        offered.reverse()
    for K_there, solver in offered:
        K, H = natural.back(K_there, there.H)
        with suppress(Unattainable):
            return _proved(there.model_copy(update={**same, "K": K, "H": H, "solver": solver}), budget)
    return None


def _most(K: LinkMatrices, magnified: Array) -> float:
    every = (K_ij for of_mode in K.values() for row in of_mode.values() for K_ij in row.values())
    return max(float(np.abs(K_ij * magnified).max()) for K_ij in every)


def _without(K: LinkMatrices, held: NDArray[np.bool_]) -> LinkMatrices:
    return {
        mode: {i: {j: np.where(held, 0.0, K_ij) for j, K_ij in row.items()} for i, row in of_mode.items()}
        for mode, of_mode in K.items()
    }


def _brought_back(certificate: Certificate, T: Array, unit: float) -> Certificate:
    """What is said with P of [T x; T e] and of z in units of `unit`, with T'P T of every block, and of z itself."""

    def back(P: Array) -> Array:
        whole = np.kron(np.eye(len(P) // len(T)), T)
        found = whole.T @ P @ whole
        return np.asarray((found + found.T) / 2.0)

    R, Q, P, lmi_gamma = certificate.R, certificate.Q, certificate.P, certificate.lmi_gamma
    weights = certificate.lmi_weights
    return certificate.model_copy(
        update={
            "R": None if R is None else back(R),
            "Q": Q and {mode: {i: back(Q_i) for i, Q_i in of_mode.items()} for mode, of_mode in Q.items()},
            "P": P and {mode: back(P_s) for mode, P_s in P.items()},
            "gamma": unit * certificate.gamma,
            "lmi_gamma": None if lmi_gamma is None else unit * lmi_gamma,
            "lmi_weights": weights and weights.model_copy(update={"states": weights.states @ T}),
        }
    )


def _proved(gains: Gains, budget: Budget) -> Gains:
    """With about the gamma that is claimed, by its P; or else with the exact gain."""
    claim, prover = gains.certificate, prover_of(gains)
    for part in _ABOVE:
        verdict = prover.theorem1(claim.gamma * (1.0 + part))
        if verdict.holds:
            proved = claim.model_copy(update={"gamma": verdict.gamma, "margins": verdict.margins})
            return gains.model_copy(update={"certificate": proved})
    exact = certify(gains.problem, gains.K, gains.H, budget=budget).model_copy(update={"lmi_gamma": claim.lmi_gamma})
    return gains.model_copy(update={"certificate": exact})
