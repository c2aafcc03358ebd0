"""A certificate of kind "exact" proved: gamma from a horizon T and a P, in ball arithmetic; docs/theory.md, section 4.

1. (17) for P, and P > 0: the error system is mean-square stable, and E eta'P eta grows by |w|^2 a step at most.
2. The tail: L^T(M'M) < tau^2 P, with some tau < gamma.
3. The recursion of the exact gain from M'M over T steps at g = gamma^2 - tau^2: every W > 0, so gamma_T^2 <= g.

Then the exact gain is at most sqrt(g + tau^2) = gamma. Both sequences, of 2 and of 3, rise with what they start from.
So after every step the matrix of balls is replaced by one of numbers that is provably not below it: what is proved is
proved of more than the truth, and radii do not add up over the horizon. Where a part fails, the same with matrices
that are not above the truth shows whether it is false.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from flint import arb, arb_mat

from agent.contract.arrays import Array
from agent.contract.gains import LinkMatrices
from agent.contract.problem import Problem
from designer.proof.ball_model import BallModel
from designer.proof.balls import UNDECIDED, Sign, above, below, diagonal, floats, identity, part, sign
from designer.proof.findings import Finding, Verdict, decided
from designer.proof.by_balls import inequality_17, symmetric

Modes = tuple[str, ...]
Rounding = Callable[[arb_mat], arb_mat]  # above or below

_ROOM = 1e-6  # tau^2 stands this much above its computed value, relative to it,
_LEAST_TAIL = 1e-20  # and this much of gamma^2 besides


def check_exact(problem: Problem, K: LinkMatrices, H: LinkMatrices, *, P: Array, gamma: float, horizon: int) -> Verdict:
    """Whether gamma is proved for the gains of (5) by P (modes, n_eta, n_eta) and T = horizon."""

    def findings() -> list[Finding]:
        model, P_balls, modes, gamma2 = BallModel(problem, K, H), symmetric(P), problem.mode_names, arb(gamma) ** 2
        found = inequality_17(model, modes, P)
        found += [Finding("P > 0", mode, sign(P_s, diagonal(P_s))) for mode, P_s in zip(modes, P_balls, strict=True)]
        if not _proved(found):
            return found
        tail, tau2 = _tail(model, modes, P_balls, gamma2, horizon)
        found += tail
        if not _proved(found):
            return found
        return found + _recursion(model, modes, (gamma2 - tau2).lower(), horizon)

    return decided(findings, gamma)


def _tail(model: BallModel, modes: Modes, P: list[arb_mat], gamma2: arb, horizon: int) -> tuple[list[Finding], arb]:
    """tau^2 P - L^T(M'M) > 0 in every mode, and tau^2, which is not above gamma^2."""
    Z = _powers(model, horizon, above)
    tau2 = arb(min(_relative(Z, P) * (1.0 + _ROOM) + _LEAST_TAIL * float(gamma2), float(gamma2.lower())))
    at = f" after {horizon} steps against tau^2 = {float(tau2):.6g}, gamma^2 = {float(gamma2):.6g}"
    found = [Finding("tail", mode, _less(Z_s, tau2, P_s), at) for mode, Z_s, P_s in zip(modes, Z, P, strict=True)]
    if not _proved(found):
        lower = _powers(model, horizon, below)
        found = [
            finding._replace(sign=finding.sign._replace(refuted=_less(Z_s, tau2, P_s).refuted))
            for finding, Z_s, P_s in zip(found, lower, P, strict=True)
        ]
    return found, tau2


def _recursion(model: BallModel, modes: Modes, g: arb, horizon: int) -> list[Finding]:
    """W > 0 in every mode at each of T steps, up to the first that fails."""
    found = _sweep(model, modes, g, horizon, above)
    if _proved(found):
        return found
    truth = _sweep(model, modes, g, horizon, below)[-1]
    failed = truth if truth.sign.refuted else found[-1]._replace(sign=found[-1].sign._replace(refuted=False))
    return [*found[:-1], failed]


def _sweep(model: BallModel, modes: Modes, g: arb, horizon: int, rounded: Rounding) -> list[Finding]:
    """Y <- L(Y) + A'Y_bar B W^-1 B'Y_bar A from M'M, W = g I - B'Y_bar B, with Y rounded to one side after a step."""
    found: list[Finding] = []
    Y = [rounded(model.MM)] * len(modes)
    sizes = np.full(model.nw, float(g))
    for step in range(1, horizon + 1):
        at = f" at step {step} of {horizon}, counted from the last, with g = gamma^2 - tau^2 = {float(g):.6g}"
        Y_next = []
        for mode, S in zip(modes, model.joint(Y), strict=True):
            W, cross = identity(model.nw) * g - part(S, model.w, model.w), part(S, model.eta, model.w)
            found.append(Finding("recursion", mode, sign(W, sizes), at))
            if not found[-1].sign.proved:
                return found
            try:
                grown = part(S, model.eta, model.eta) + cross * W.solve(cross.transpose())
            except ZeroDivisionError:  # too few bits
                found[-1] = found[-1]._replace(sign=UNDECIDED)
                return found
            Y_next.append(rounded(grown))
        Y = Y_next
    return found


def _powers(model: BallModel, horizon: int, rounded: Rounding) -> list[arb_mat]:
    """L^T(M'M), rounded to one side after every step."""
    Z = [rounded(model.MM) for _ in model.modes]
    for _ in range(horizon):
        Z = [rounded(part(S, model.eta, model.eta)) for S in model.joint(Z)]
    return Z


def _less(Z: arb_mat, tau2: arb, P: arb_mat) -> Sign:
    """The sign of tau^2 P - Z."""
    bound = P * tau2
    return sign(bound - Z, diagonal(bound))


def _relative(Z: list[arb_mat], P: list[arb_mat]) -> float:
    """The least tau^2 with Z <= tau^2 P in every mode, computed; infinity where floats do not tell."""
    P_middle, Z_middle = np.array([floats(P_s) for P_s in P]), np.array([floats(Z_s) for Z_s in Z])
    if not (np.isfinite(P_middle).all() and np.isfinite(Z_middle).all()):
        return np.inf
    try:
        with np.errstate(all="ignore"):
            L = np.linalg.cholesky(P_middle)
            half = np.linalg.solve(L, Z_middle)
            relative = np.linalg.solve(L, half.swapaxes(1, 2))
            return max(float(np.linalg.eigvalsh((relative + relative.swapaxes(1, 2)) / 2.0).max()), 0.0)
    except np.linalg.LinAlgError:
        return np.inf


def _proved(found: list[Finding]) -> bool:
    return all(finding.sign.proved for finding in found)
