"""Theorem 1 of Zhu et al. 2020, for certificates of kind "lyapunov": (17) and (18) proved in every mode, P stored."""

from __future__ import annotations

import numpy as np
from flint import arb, arb_mat

from agent.contract.arrays import Array
from agent.contract.gains import LinkMatrices
from agent.contract.problem import Problem
from designer.proof.ball_model import BallModel
from designer.proof.balls import blocks, diagonal, exact, of_blocks, part, sign
from designer.proof.findings import Finding, Verdict, decided


def check(problem: Problem, K: LinkMatrices, H: LinkMatrices, *, P: Array, gamma: float) -> Verdict:
    """Theorem 1 for the gains of (5), P (modes, n_eta, n_eta) and gamma."""

    def findings() -> list[Finding]:
        model, modes = BallModel(problem, K, H), problem.mode_names
        return inequality_17(model, modes, P) + _inequality_18(model, modes, P, gamma)

    return decided(findings, gamma)


def inequality_17(model: BallModel, modes: tuple[str, ...], P: Array) -> list[Finding]:
    """diag{P(s), I} - [A B]'P_bar[A B] - noise > 0: minus the matrix of (17)."""
    weighed = np.tile(np.eye(model.size + model.nw), (len(modes), 1, 1))
    weighed[:, : model.size, : model.size] = P
    found = []
    for mode, S, whole in zip(modes, model.joint(symmetric(P), _blocks(model, P)), symmetric(weighed), strict=True):
        found.append(Finding("(17)", mode, sign(whole - S, diagonal(whole))))
    return found


def _inequality_18(model: BallModel, modes: tuple[str, ...], P: Array, gamma: float) -> list[Finding]:
    """P(s) - M'M / gamma^2 > 0: (18), by the Schur complement; (32)."""
    MM = model.MM * (1 / arb(gamma) ** 2)
    found, blocks_of_P = [], _blocks(model, P)
    for mode, P_s in zip(modes, symmetric(P), strict=True):
        S, sizes = P_s - MM, diagonal(P_s)
        signs = [sign(part(S, block, block), sizes[block]) for block in blocks_of_P]
        found.append(Finding("(18)", mode, of_blocks(signs)))
    return found


def _blocks(model: BallModel, P: Array) -> list[list[int]]:
    """The blocks of P(s), the same for every mode; the states of a node, which M'M may join, stay together."""
    joined = (P != 0.0).any(axis=0)
    for e_i in model.e:
        joined[np.ix_(e_i, e_i)] = True
    return blocks(joined)


def symmetric(P: Array) -> list[arb_mat]:
    """(P + P')/2 of every mode, as x'Px sees P."""
    return [exact(P_s) if (P_s == P_s.T).all() else (exact(P_s) + exact(P_s.T)) * arb(0.5) for P_s in P]
