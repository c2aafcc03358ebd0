"""The check of a certificate of kind "exact": gamma from a horizon T and a P, in float64 with allowances.

(17) is one inequality between P(s) now and P(t) one step later. With two different P it reads

    [P_next(s), 0; 0, I] - [A B]'P_bar[A B] - (losses) > 0,   called P -> P_next below.

The proof has three parts, docs/theory.md says why they suffice:
1. P -> P, which is (17);
2. M'M/g = P_0 -> P_1 -> ... -> P_T, so gamma_T^2 <= g: the recursion of the exact gain, every P_k a little too large;
3. L^T(M'M) <= tau^2 P, with every power of L a little too large.
Then gamma^2 >= g + tau^2. Each step starts from stored numbers, so its rounding is bounded as that of (17) is.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from agent.contract.arrays import Array
from agent.contract.errors import InputError
from agent.contract.gains import Gains
from agent.contract.problem import Problem
from designer.certificate import ARITHMETIC, Verdict, _allowance, _magnitudes, lyapunov_matrix
from designer.error_model import error_model, stacked_gains
from designer.gain import Operator

_U = 2.0**-53
_TOWARDS = 1.0 - 1e-12  # g is chosen this factor below gamma^2 - tau^2, which is itself rounded


class _Step:
    """P -> P_next for all modes: the matrices, and bounds on the rounding of their entries."""

    def __init__(self, problem: Problem, K_bar: Array, H_bar: Array) -> None:
        self.problem = problem
        self.operator = Operator(error_model(problem, K_bar, H_bar))
        self.sizes = Operator(_magnitudes(problem, K_bar, H_bar))

    def joint(self, P: Array) -> tuple[Array, Array]:
        """[A B]'P_bar[A B] with its losses, (modes, n_eta + nw, n_eta + nw), and its sums of absolute values."""
        return self.operator.joint(self.operator.bar(P)), self.sizes.joint(self.sizes.bar(np.abs(P)))

    def corner_above(self, P: Array) -> Array:
        """A matrix that is not below L(P), for P positive semidefinite."""
        n = self.operator.size
        S, magnitude = self.joint(P)
        return _raised(S[:, :n, :n], magnitude[:, :n, :n], _allowance(magnitude[:, :n, :n], self.problem))

    def above(self, P: Array) -> Array | None:
        """P_next that is mostly enough: what the recursion gives, raised by its rounding; None where W fails."""
        n = self.operator.size
        S, magnitude = self.joint(P)
        W = np.eye(S.shape[1] - n) - S[:, n:, n:]
        if not np.linalg.eigvalsh(W).min() > 0.0:
            return None
        grown = S[:, :n, :n] + S[:, :n, n:] @ np.linalg.solve(W, S[:, n:, :n])
        worst_w = np.abs(np.linalg.solve(W, S[:, n:, :n]))
        both = np.concatenate([np.broadcast_to(np.eye(n), grown.shape), worst_w], axis=1)
        magnitude[:, n:, n:] += np.eye(len(W[0]))
        lost = _allowance(magnitude, self.problem)
        diagonal = np.arange(S.shape[1])
        lost[:, diagonal, diagonal] += _cholesky_loss(len(S[0])) * magnitude[:, diagonal, diagonal]
        lost = 16.0 * both.swapaxes(1, 2) @ lost @ both  # what is lost in W and A'P_bar B reaches P_next through w
        return _raised(grown, magnitude[:, :n, :n], lost)

    def margins(self, P: Array, P_next: Array) -> list[tuple[bool, float]]:
        """For every mode: whether the inequality holds in exact arithmetic, and by how much."""
        n = self.operator.size
        S, magnitude = self.joint(P)
        S, unit = -S, np.eye(S.shape[1] - n)
        for matrix, part in ((S, P_next), (magnitude, np.abs(P_next))):
            matrix[:, :n, :n] += part
            matrix[:, n:, n:] += unit
        return [_positive(S[s], magnitude[s], self.problem) for s in range(len(S))]


def verify_exact(gains: Gains) -> Verdict:
    """Check everything as it stands in the gains file."""
    proved = gains.certificate
    if proved.horizon is None or proved.horizon < 1:
        raise InputError(f'certificate: horizon is {proved.horizon}; kind "exact" needs the number of its steps')
    K_bar, H_bar = stacked_gains(gains)
    P = lyapunov_matrix(gains)
    return check_exact(gains.problem, K_bar, H_bar, P=P, gamma=proved.gamma, horizon=proved.horizon)


def check_exact(problem: Problem, K_bar: Array, H_bar: Array, *, P: Array, gamma: float, horizon: int) -> Verdict:
    """Whether gamma is proved by P (modes, n_eta, n_eta) and T = horizon."""
    step = _Step(problem, K_bar, H_bar)
    P = (P + P.swapaxes(-1, -2)) / 2.0
    margins: dict[str, float] = {}
    failure: str | None = None
    for name, held, margin in _parts(step, P, gamma, horizon):
        margins[name] = min(margin, margins.get(name, margin))
        if not held:
            failure = f"{name} fails: its least scaled eigenvalue is {margin:.3g} after the allowance for rounding"
            break
    return Verdict(failure is None, gamma, ARITHMETIC, failure, margins)


def _parts(step: _Step, P: Array, gamma: float, horizon: int) -> Iterator[tuple[str, bool, float]]:
    """Every inequality of the three parts: its name, whether it holds, its margin."""
    modes = step.problem.mode_names
    for mode, (held, margin) in zip(modes, step.margins(P, P), strict=True):
        yield f"(17) mode {mode}", held, margin
    least = float(np.linalg.eigvalsh(P).min())
    if not least > 0.0:
        yield "P > 0", False, least
        return
    MM = step.operator.MM
    MM = _raised(MM, np.abs(MM), _allowance(np.abs(MM), step.problem))
    Z = MM
    for _ in range(horizon):
        Z = step.corner_above(Z)
    tau2 = _relative(Z, P)
    for mode, Z_s, P_s in zip(modes, Z, P, strict=True):
        matrix = tau2 * P_s - Z_s
        held, margin = _positive(matrix, tau2 * np.abs(P_s) + np.abs(Z_s), step.problem)
        yield f"tail mode {mode}", held, margin
    g = (gamma**2 - tau2) * _TOWARDS
    if not g > 0.0:
        yield "gamma^2 above the tail", False, float(gamma**2 - tau2)
        return
    P_k = MM / g * (1.0 + 4.0 * _U)
    for _ in range(horizon):
        P_next = step.above(P_k)
        pairs = step.margins(P_k, P_next) if P_next is not None else [(False, 0.0)] * len(modes)
        for mode, (held, margin) in zip(modes, pairs, strict=True):
            yield f"recursion mode {mode}", held, margin
        if P_next is None:
            return
        P_k = P_next


def _positive(S: Array, magnitude: Array, problem: Problem) -> tuple[bool, float]:
    """Whether every symmetric matrix within the allowance of S is positive definite; and the margin.

    As in designer.certificate, but scaled by the magnitudes: where S is small by cancellation, its rounding is not.
    """
    scale = _scale(magnitude)
    both = scale * scale[:, None]
    S, magnitude = S * both, magnitude * both
    loss = _allowance(magnitude, problem).sum(axis=1) + _cholesky_loss(len(S)) * magnitude.diagonal().max()
    lowered = S - np.diag(loss)
    margin = float(np.linalg.eigvalsh(lowered).min())
    try:
        np.linalg.cholesky(lowered)
    except np.linalg.LinAlgError:
        return False, min(margin, 0.0)
    return True, margin


def _raised(S: Array, magnitude: Array, allowance: Array) -> Array:
    """S plus more than any symmetric error within the allowance, (modes, n_eta, n_eta); by Gershgorin, scaled."""
    S = (S + S.swapaxes(1, 2)) / 2.0
    scale = _scale(magnitude)
    diagonal = np.arange(S.shape[1])
    S[:, diagonal, diagonal] += 1.01 * (allowance @ scale[:, :, None])[:, :, 0] / scale
    return np.asarray(S)


def _scale(magnitude: Array) -> Array:
    """Powers of two that bring the diagonal near 1, (..., order); 1 where it is 0."""
    diagonal = np.diagonal(magnitude, axis1=-2, axis2=-1)
    return np.asarray(np.exp2(np.round(-np.log2(np.where(diagonal > 0.0, diagonal, 1.0)) / 2.0)))


def _cholesky_loss(order: int) -> float:
    """How far a matrix of diagonal 1, whose Cholesky ends, may be from a positive semidefinite one (Rump, 2006)."""
    return 4.0 * order * (order + 2) * _U


def _relative(Z: Array, P: Array) -> float:
    """A little more than the least tau^2 with Z <= tau^2 P."""
    L = np.linalg.cholesky(P)
    half = np.linalg.solve(L, np.linalg.solve(L, Z).swapaxes(1, 2))
    largest = float(np.linalg.eigvalsh((half + half.swapaxes(1, 2)) / 2.0).max())
    return largest * (1.0 + 1e-6) + np.finfo(float).tiny
