"""Theorem 1 again, without a solver: do the stored gains and the stored P satisfy (17) and (18) for the stored gamma?

The arithmetic is float64 with an allowance for its own rounding, so that "holds" is a statement about the exact
matrices, not about the computed ones. A matrix S that should be positive definite is computed as S_float, with
every entry off by at most `allowance` (see `_allowance`). No symmetric matrix of such errors lies below
-diag(row sums of allowance), by Gershgorin's theorem, so S_float with its diagonal lowered by these sums is given
to Cholesky: if that runs to its end with the diagonal lowered once more by the rounding of Cholesky itself, S is
positive definite (Rump, BIT Numerical Mathematics 46, 2006: a symmetric matrix whose floating-point Cholesky ends
is at most (m + 1) u trace away from a positive semidefinite one).
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from agent.contract.arrays import Array
from agent.contract.errors import InputError, listed
from agent.contract.gains import Gains
from agent.contract.problem import Problem
from designer.error_model import ErrorModel, error_model, stacked_gains, stacks
from designer.gain import Operator

ARITHMETIC = "float64, Cholesky with an a-priori allowance for rounding"
_U = 2.0**-53


class Verdict(NamedTuple):
    """Whether the certificate holds; where it does not, the first inequality that fails, and by how much."""

    holds: bool
    gamma: float
    arithmetic: str
    failure: str | None
    margins: dict[str, float]  # (17) and (18) of each mode: the least eigenvalue after scaling, less the allowance


def verify(gains: Gains) -> Verdict:
    """Check Theorem 1, or the exact gain, for everything as it stands in the gains file."""
    if gains.certificate.kind == "exact":
        from designer.exact_certificate import verify_exact  # it is built on this module

        return verify_exact(gains)
    K_bar, H_bar = stacked_gains(gains)
    return check(gains.problem, K_bar, H_bar, P=lyapunov_matrix(gains), gamma=gains.certificate.gamma)


def check(problem: Problem, K_bar: Array, H_bar: Array, *, P: Array, gamma: float) -> Verdict:
    """Theorem 1 for K_bar (modes, n nx, n nx), H_bar (modes, n nx, sum ny) and P (modes, n_eta, n_eta)."""
    model = error_model(problem, K_bar, H_bar)
    size = _magnitudes(problem, K_bar, H_bar)
    P = (P + P.swapaxes(-1, -2)) / 2.0  # x'Px sees the symmetric part only
    margins: dict[str, float] = {}
    failure = None
    for s, mode in enumerate(problem.mode_names):
        matrices = {
            "(17)": (inequality_17(model, s, P), inequality_17(size, s, np.abs(P), sign=1.0)),
            "(18)": (inequality_18(model, s, P, gamma), inequality_18(size, s, np.abs(P), gamma, sign=1.0)),
        }
        for name, (S, magnitude) in matrices.items():
            positive, margin = _positive_definite(S, _allowance(magnitude, problem))
            margins[f"{name} mode {mode}"] = margin
            if not positive and failure is None:
                failure = f'inequality {name} fails in mode "{mode}": its least scaled eigenvalue is {margin:.3g}'
                failure += " after the allowance for rounding, and must be positive"
    return Verdict(failure is None, gamma, ARITHMETIC, failure, margins)


def lyapunov_matrix(gains: Gains) -> Array:
    """P(s) over eta = [x; e_1; ...; e_n] from the stored certificate, (modes, n_eta, n_eta)."""
    problem, certificate = gains.problem, gains.certificate
    nx, p = problem.nx, problem.nx if problem.carries_plant else 0
    n_eta = p + problem.n * nx
    P = np.zeros((len(problem.mode_names), n_eta, n_eta))
    for s, mode in enumerate(problem.mode_names):
        if certificate.form == "full":
            P[s] = _stored(certificate.P or {}, mode, f"P of mode {mode}", n_eta)
            continue
        if p:
            P[s, :nx, :nx] = _stored({"R": certificate.R} if certificate.R is not None else {}, "R", "R", nx)
        for i, node in enumerate(problem.node_names):
            part = slice(p + i * nx, p + (i + 1) * nx)
            P[s, part, part] = _stored((certificate.Q or {}).get(mode, {}), node, f"Q of mode {mode}", nx)
    return P


def least_gamma(M: Array, P: Array) -> float:
    """The infimum of the gamma that satisfy (18): the root of max_s lambda_max(M P(s)^-1 M'); P positive definite."""
    return math.sqrt(max(float(np.linalg.eigvalsh(M @ np.linalg.solve(P_s, M.T)).max()) for P_s in P))


def inequality_17(model: ErrorModel, s: int, P: Array, *, sign: float = -1.0) -> Array:
    """Minus the matrix of (17) for mode s, (n_eta + nw, n_eta + nw); sign = +1 adds where (17) subtracts."""
    operator = Operator(model)
    S = sign * operator.joint(operator.bar(P))[s]
    S[: model.size, : model.size] += P[s]
    S[model.size :, model.size :] += np.eye(model.nw)
    return np.asarray((S + S.T) / 2.0)


def inequality_18(model: ErrorModel, s: int, P: Array, gamma: float, *, sign: float = -1.0) -> Array:
    """P(s) - M'M / gamma^2: positive definite if and only if (18) holds, by the Schur complement; (32)."""
    return np.asarray(P[s] + sign * (model.M.T @ model.M) / gamma**2)


def _magnitudes(problem: Problem, K_bar: Array, H_bar: Array) -> ErrorModel:
    """An error model of the sums of absolute values: what rounding errors in the model's entries are relative to."""
    bar, nx = stacks(problem), problem.nx
    model = error_model(problem, K_bar, H_bar)
    p, K, H, n = model.plant_states, np.abs(K_bar), np.abs(model.H), problem.n
    A, B = np.abs(model.A), np.abs(model.B)
    ones = np.tile(np.eye(nx), (n, 1))
    if p:
        A[:, p:, :p] = (np.abs(bar.A) + K) @ ones
    A[:, p:, p:] = K + H @ np.abs(bar.C_beta)
    for i in range(n):
        rows = slice(i * nx, (i + 1) * nx)
        A[:, p:, p:][:, rows, rows] += (K @ ones)[:, rows]
    B[:, p:] = np.abs(bar.B) + H @ np.abs(bar.D_beta)
    links = model.links
    if links is not None:
        V = 2.0 * np.abs(links.V)  # columns of e_j are differences
        V += np.abs(V).max()
        links = replace(links, V=V)
    return replace(model, A=A, B=B, H=H, R=np.abs(model.R), M=np.abs(model.M), links=links)


def _allowance(magnitude: Array, problem: Problem) -> Array:
    """A bound on the rounding error of every entry of a computed matrix, (m, m), underflow aside.

    An entry is a sum of products of stored numbers, with at most `depth` roundings on the way of each: in two inner
    products over eta, in the entries of script A, B and F_i on both sides (sums over nodes and measurements), in
    P_bar (a sum over modes) and in the sum over losses; a few scalings are in the 32. So its error is at most
    depth u / (1 - depth u) times the same sum of absolute values: `magnitude`, which is doubled because it is
    computed in floating point too.
    """
    n, measurements = problem.n, sum(len(node.C) for node in problem.nodes)
    depth = 2 * problem.nx * (n + 1) + 2 * (n + measurements) + len(problem.topologies) + n + 32
    return np.asarray(2.0 * depth * _U * magnitude)


def _positive_definite(S: Array, allowance: Array) -> tuple[bool, float]:
    """Whether every symmetric matrix within `allowance` of S is positive definite; and the margin, which is signed.

    S is first scaled to a diagonal near 1 by powers of two, which is exact.
    """
    diagonal = np.diag(S)
    if not (diagonal > 0.0).all():
        return False, float(diagonal.min())
    scale = np.exp2(np.round(-np.log2(diagonal) / 2.0))
    S, allowance = S * scale * scale[:, None], allowance * scale * scale[:, None]
    order = len(S)
    lowered = S - np.diag(allowance.sum(axis=1) + 2.0 * (order + 2) * _U * float(np.trace(S)))
    try:
        np.linalg.cholesky(lowered)
    except np.linalg.LinAlgError:
        return False, min(float(np.linalg.eigvalsh(lowered).min()), 0.0)
    return True, float(np.linalg.eigvalsh(lowered).min())


def _stored(matrices: dict[str, Array], name: str, what: str, size: int) -> Array:
    if name not in matrices:
        raise InputError(f'certificate: {what} lacks "{name}"; there is {listed(matrices) or "nothing"}')
    if matrices[name].shape != (size, size):
        rows, columns = matrices[name].shape
        raise InputError(f'certificate: {what}: "{name}" is {rows} x {columns}; it must be {size} x {size}')
    return matrices[name]
