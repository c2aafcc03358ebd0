"""The w that are worst: as a policy that sees the past, as a fixed sequence, and along one realised path."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agent.contract.arrays import Array
from agent.contract.gains import Gains
from agent.contract.problem.disturbance import WorstCase
from designer.gain.exact import Operator
from designer.gain.sensitivity import critical, critical_sweep
from designer.model.error_model import ErrorModel, model_of_gains, realised

_SETTLED = 1e-4  # twice the horizon adds less to the worst gain, relatively
_MOST_ROWS = 256  # of the largest matrix whose eigenvalues are sought, T nw: about a second
_MOST_NUMBERS = 2e7  # that the mean responses to every w(j) may take: 160 MB


class Policy(NamedTuple):
    """Wait for mode s0 with w = 0, then give w = u in that step, and w = Gamma[k, r] eta in the steps after it.

    Its |z_tilde|^2 one step after the last row is gamma^2 of its energy, in the mean.
    """

    gamma: float  # gamma_T
    mode: int  # s0
    u: Array  # (nw,)
    Gamma: Array  # (steps, modes, nw, n_eta)


def worst_policy(model: ErrorModel, *, horizon: int) -> Policy:
    """The policy that attains gamma_T, T = horizon, to 1e-8; Gamma = W^-1 B'Y_bar A at g = gamma_T^2."""
    operator = Operator(model)
    g, swept = critical_sweep(operator, horizon)
    k, s, u = critical(swept)
    return Policy(math.sqrt(g), s, u, swept.Gamma[:k][::-1])


class Disturbance(NamedTuple):
    """The worst w that is fixed beforehand, of energy 1; |z_tilde|^2 peaks one step after its last row."""

    gain: float  # sqrt of E|z_tilde|^2
    w: Array  # (T, nw)
    within: int  # the steps that it was sought over


def worst_disturbance(model: ErrorModel, *, initial: int, horizon: int) -> Disturbance:
    """max over T <= horizon of lambda_max(E[G_T'G_T]), G_T from w(0..T-1) to z_tilde(T), from r(0) = initial.

    Block (j, l), j < l, of E[G_T'G_T] is E[eta_j(l)'A'Y_bar B], where eta_j is what w(j) left in the state, whose mean
    in every mode moves by A alone (chance has mean 0), and Y = L^(T-1-l)(M'M) weighs what is left of it at T; block
    (l, l) is B'Y_bar B. Both are blocks of `Operator.joint`, chance within; docs/theory.md, section 7.
    """
    operator, nw, size = Operator(model), model.B.shape[2], model.A.shape[1]
    joints, Y = [], np.asarray(operator.MM)  # joints[m]: [A B]'Y_bar [A B] with m steps to go afterwards
    for _ in range(horizon):
        joints.append(operator.joint(operator.bar(Y)))
        Y = joints[-1][:, :size, :size]
    left = _traces_of_w(operator, model, initial, horizon)
    best = Disturbance(0.0, np.zeros((1, nw)), horizon)
    for T in range(1, horizon + 1):
        gram = np.zeros((T * nw, T * nw))
        for k in range(T):
            at = slice(k * nw, (k + 1) * nw)
            means, occupied = left[k]
            gram[at, at] = np.tensordot(occupied, joints[T - 1 - k][:, size:, size:], axes=1)
            gram[: k * nw, at] = (means.swapaxes(1, 2) @ joints[T - 1 - k][:, :size, size:]).sum(axis=0)
        eigenvalues, vectors = np.linalg.eigh(gram, UPLO="U")
        if eigenvalues[-1] > best.gain**2:
            best = Disturbance(math.sqrt(eigenvalues[-1]), vectors[:, -1].reshape(T, nw), horizon)
    return best


def worst_for(gains: Gains) -> Disturbance:
    """The worst fixed w of gains from their initial mode."""
    problem = gains.problem
    return worst_fixed(model_of_gains(problem, gains.K, gains.H), initial=problem.mode_index(problem.markov.initial))


def worst_fixed(model: ErrorModel, *, initial: int) -> Disturbance:
    """The worst fixed w from r(0) = initial, over a horizon that is doubled until the gain has settled.

    At the longest horizon that is affordable the search ends, settled or not; `gain` is true of `w` in any case.
    """
    most = int(min(_MOST_ROWS / model.nw, (2.0 * _MOST_NUMBERS / (model.modes * model.size * model.nw)) ** 0.5))
    horizon = max(1, min(8, most))
    worst = worst_disturbance(model, initial=initial, horizon=horizon)
    while horizon < most:
        horizon = min(2 * horizon, most)
        before, worst = worst, worst_disturbance(model, initial=initial, horizon=horizon)
        if worst.gain <= before.gain * (1.0 + _SETTLED):
            break
    return worst


def with_worst_case(gains: Gains) -> Gains:
    """The gains with the sequence of the disturbance kind "worst-case" where their problem asks for that one."""
    if not isinstance(gains.problem.disturbance, WorstCase):
        return gains
    return gains.model_copy(update={"worst_case": worst_for(gains).w})


def _traces_of_w(operator: Operator, model: ErrorModel, initial: int, horizon: int) -> list[tuple[Array, Array]]:
    """For every step k: E[eta_j(k); r(k) = s] for all j < k and unit w(j), (modes, n_eta, k nw), and P(r(k) = s)."""
    modes, size, _ = model.B.shape
    means, occupied = np.zeros((modes, size, 0)), np.eye(modes)[initial]
    steps = [(means, occupied)]
    for _ in range(horizon - 1):
        moved = np.concatenate([model.A @ means, occupied[:, None, None] * model.B], axis=2)
        means = (operator.transition.T @ moved.reshape(modes, -1)).reshape(moved.shape)
        occupied = occupied @ operator.transition
        steps.append((means, occupied))
    return steps


def path_gain(
    model: ErrorModel, modes: Sequence[int], theta: Array, delivered: NDArray[np.bool_] | None = None
) -> Array:
    """gamma_path(k), (steps + 1,), of one realised run: modes r(0), r(1), ..., theta (steps, n), and where links
    are lossy delivered (steps, n, n).

    |z_tilde(k)|^2 <= gamma_path(k)^2 sum over j < k of |w(j)|^2 in that very run, with no expectation:
    X <- A_k X A_k' + B_k B_k' from 0, the realised losses in A_k and B_k, and gamma_path(k)^2 = lambda_max(M X M').
    """
    X, size = np.zeros_like(model.A[0]), model.size
    gains = [0.0]
    for k, (s, theta_k) in enumerate(zip(modes, theta, strict=True)):
        AB = realised(model, s, theta_k, None if delivered is None else delivered[k])
        A_k, B_k = AB[:, :size], AB[:, size:]
        X = A_k @ X @ A_k.T + B_k @ B_k.T
        gains.append(math.sqrt(max(float(np.linalg.eigvalsh(model.M @ X @ model.M.T).max()), 0.0)))
    return np.array(gains)
