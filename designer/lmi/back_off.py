"""From a solver's answer, which lies on the boundary of (17), to a P and a gamma that can be proved.

A solver's P satisfies (17) with nothing to spare, or misses it by its tolerance. Take any P0 with
P0 - L(P0) >= W/2 > 0, L of `Operator.corner`. Then (1 - t)(P + tau P0) has, on the diagonal of (17), t I more in w and
tau W/2 more in eta; the cross terms that P0 brings are outweighed if
tau <= t / (2 lambda_max(B'P0_bar B + 2 C'W^-1 C)), C = A'P0_bar B, where B'P0_bar B and C stand for the corners of
`Operator.joint`. So (17) becomes strict, and gamma grows by about t/2 of itself.

Candidates are screened by Cholesky in floats; the first that passes is proved, or the next is tried.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Literal, NamedTuple

import numpy as np

from agent.contract.arrays import Array
from agent.contract.gains import LinkMatrices
from agent.contract.problem import Problem
from designer.gain.exact import Operator
from designer.model.error_model import ErrorModel, error_model, stacked_links
from designer.proof.findings import Verdict
from designer.proof.prover import Prover

Form = Literal["structured", "full"]
Prove = Callable[[Array, float], Verdict]  # that P proves gamma

_ABOVE = 1.0 + 1e-9  # gamma stands this factor above the infimum of (18), so that (18) is strict
_MOST_STEPS = 5000
_GROWN = 1e100  # no stable error system of numbers that a solver takes grows so far before it shrinks


class Confirmed(NamedTuple):
    """The P that was tried last, in which form it is, how far it was backed off, and what the check says of it."""

    P: Array  # (modes, n_eta, n_eta)
    form: Form
    t: float
    verdict: Verdict


def back_off(problem: Problem, K: LinkMatrices, H: LinkMatrices, P: Array, prove: Prove | None = None) -> Confirmed:
    """The first P(t), from t = 0 upwards, whose gamma is proved; if none is, the one tried last.

    First with P0 = diag{R0, 0}, which keeps the form diag{R, Q(s)} of Theorem 1; then with a full P0. `prove` is for
    gains that are told, with P and gamma, in other units.
    """
    model = error_model(problem, *stacked_links(problem, K, H))
    if prove is None:

        def prove(P: Array, gamma: float) -> Verdict:
            return Prover(problem, K, H, P=P).theorem1(gamma)

    for form, t, candidate in _candidates(model, _lifted(P)):
        if satisfies_17(model, candidate):
            confirmed = _confirmed(prove, model, candidate, form, t)
            if confirmed.verdict.holds:
                return confirmed
    return _confirmed(prove, model, candidate, form, t)


def _confirmed(prove: Prove, model: ErrorModel, P: Array, form: Form, t: float) -> Confirmed:
    return Confirmed(P, form, t, prove(P, least_gamma(model.M, P) * _ABOVE))


def _candidates(model: ErrorModel, P: Array) -> Iterator[tuple[Form, float, Array]]:
    yield "structured", 0.0, P
    P0 = plant_lyapunov(model, P)
    if P0 is not None:
        for t in (1e-8, 1e-7, 1e-6, 3e-6, 1e-5, 3e-5, 1e-4):
            yield "structured", t, relaxed(model, P, P0, t)
    P0 = coupled_lyapunov(model, P)
    if P0 is not None:
        for t in (1e-8, 1e-7, 1e-6, 1e-5, 3e-5, 1e-4, 1e-3, 1e-2, 1e-1):
            yield "full", t, relaxed(model, P, P0, t)


def least_gamma(M: Array, P: Array) -> float:
    """The infimum of the gamma that satisfy (18): the root of max_s lambda_max(M P(s)^-1 M'); P positive definite."""
    return math.sqrt(max(float(np.linalg.eigvalsh(M @ np.linalg.solve(P_s, M.T)).max()) for P_s in P))


def inequality_17(model: ErrorModel, P: Array) -> Array:
    """Minus the matrix of (17) for every mode, (modes, n_eta + nw, n_eta + nw), in floats."""
    operator = Operator(model)
    S = -operator.joint(operator.bar(P))
    S[:, : model.size, : model.size] += P
    S[:, model.size :, model.size :] += np.eye(model.nw)
    return np.asarray((S + S.swapaxes(1, 2)) / 2.0)


def satisfies_17(model: ErrorModel, P: Array) -> bool:
    """Whether floats take (17) for true: a cheap screen, no proof."""
    return all(positive(P_s) for P_s in P) and all(positive(S) for S in inequality_17(model, P))


def coupled_lyapunov(model: ErrorModel, W: Array) -> Array | None:
    """P0 = W + L(W) + ... + L^k(W), as soon as L^(k+1)(W) <= W/2, so that P0 - L(P0) >= W/2; None: no such k.

    The sum converges if and only if the error system is mean-square stable.
    """
    operator, term, P0 = Operator(model), W, W.copy()
    for _ in range(_MOST_STEPS):
        term = operator.corner(term)
        if np.abs(term).max() > _GROWN * np.abs(W).max():
            return None
        if positive(W / 2.0 - term):
            return P0
        P0 = P0 + term
    return None


def plant_lyapunov(model: ErrorModel, P: Array) -> Array | None:
    """P0 = diag{R0, 0} with R0 - A'R0 A >= R/2 for the plant alone, (modes, n_eta, n_eta); or None."""
    p = model.plant_states
    if not p:
        return None
    A, R = model.A[0, :p, :p], P[0, :p, :p]
    term, R0 = R, R.copy()
    for _ in range(_MOST_STEPS):
        term = A.T @ term @ A
        if positive(R / 2.0 - term):
            P0 = np.zeros_like(P)
            P0[:, :p, :p] = R0
            return P0
        R0 = R0 + term
    return None


def relaxed(model: ErrorModel, P: Array, P0: Array, t: float) -> Array:
    """(1 - t)(P + tau P0) with the tau of this module's first lines, for W = P."""
    operator, n = Operator(model), model.size
    S = operator.joint(operator.bar(P0))
    grown = S[:, n:, n:] + 2.0 * S[:, n:, :n] @ np.linalg.solve(P, S[:, :n, n:])
    worst = float(np.linalg.eigvalsh((grown + grown.swapaxes(1, 2)) / 2.0).max())
    tau = t / (2.0 * worst) if worst > 0.0 else t
    return np.asarray((1.0 - t) * (P + tau * P0))


def _lifted(P: Array) -> Array:
    """P itself where it is positive definite, else P + shift I: a solver may leave R a rounding below 0."""
    if all(positive(P_s) for P_s in P):
        return P
    eigenvalues = np.linalg.eigvalsh(P)
    shift = 2.0 * max(-float(eigenvalues.min()), 0.0) + 1e-9 * float(np.abs(eigenvalues).max())
    return np.asarray(P + (shift or 1.0) * np.eye(P.shape[-1]))


def positive(P: Array) -> bool:
    """Whether P is positive definite, by Cholesky and without an allowance for rounding."""
    try:
        np.linalg.cholesky(P)
    except np.linalg.LinAlgError:
        return False
    return True
