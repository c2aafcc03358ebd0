"""Both ways over the steps of a recursion, in floats: back with some S(Y) for every step, and forth with its worst w.

As `designer.gain.sensitivity.sweep` and `slope`, for what is no error model: bounds, and models that are off.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from agent.contract.arrays import Array
from designer.decay import is_positive
from designer.patience import look
from designer.proof.cube import joined


class Step(NamedTuple):
    """One step back at some g; the worst w is Gamma eta."""

    Y: Array  # (modes, n_eta, n_eta)
    Gamma: Array  # (modes, nw, n_eta)
    W: Array  # (modes, nw, nw)


class Steps(NamedTuple):
    """All of them: row 0 is the last step."""

    Y: Array  # (T, modes, n_eta, n_eta): what weighs eta after each
    Gamma: Array  # (T, modes, nw, n_eta)
    W_inverse: Array  # (T, modes, nw, nw)


def step(S: Array, n: int, g: float) -> Step | None:
    """From S (modes, n + nw, n + nw) of what weighs eta; None where a W is not positive definite."""
    look()
    W, cross = g * np.eye(S.shape[1] - n) - S[:, n:, n:], S[:, n:, :n]
    if not (np.isfinite(S).all() and is_positive(W)):
        return None
    Gamma = np.asarray(np.linalg.solve(W, cross), dtype=np.float64)
    return Step(S[:, :n, :n] + cross.swapaxes(1, 2) @ Gamma, Gamma, W)


@np.errstate(all="ignore")  # what overflows is None
def back(S: Callable[[Array, int], Array], Y: Array, g: float, horizon: int) -> Steps | None:
    """From Y (modes, n, n); `S` gets what weighs eta, and how many steps were taken. None as from `step`."""
    passed, n = [], Y.shape[1]
    for steps in range(horizon):
        taken = step(S(Y, steps), n, g)
        if taken is None:
            return None
        passed.append((Y, taken.Gamma, np.linalg.inv(taken.W)))
        Y = taken.Y
    return Steps(*(np.array(part) for part in zip(*passed, strict=True)))


def forth(Gamma: Array, W_inverse: Array, carry: Callable[[Array, int], Array]) -> tuple[Array, Array]:
    """The mean of [eta; w][eta; w]' in each step, (T, modes, n + nw, n + nw), and that of eta eta' after all.

    From rest; W^-1 is put in at each, for the derivative of log det W. `carry` gets such a mean, and the row of its
    step.
    """
    X, joint = np.zeros((*Gamma.shape[1:2], *Gamma.shape[3:] * 2)), []
    for k in range(len(Gamma) - 1, -1, -1):
        joint.append(joined(X, Gamma[k], W_inverse[k] / np.abs(W_inverse).max()))
        X = carry(joint[-1], k)
    return np.array(joint[::-1]), X
