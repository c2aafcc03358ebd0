"""What white w leaves in the errors: the mean square in the steady state, from coupled Lyapunov equations.

X(s) = E[eta eta'; r = s] follows X <- carry([X 0; 0 p(s) I]), where p is how often mode s is there in the long run,
from the initial mode. Where the errors are mean-square stable that has one fixed point; for a chain that has a period
it is the mean over time. docs/theory.md, section 7.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from agent.contract.arrays import Array
from designer.decay import Decay, decay, solution
from designer.gain.exact import Operator
from designer.model.error_model import ErrorModel

SETTLED = 1e-6  # what is off by more, relative to the total, is not stated
_DOUBLINGS = 60  # 2^60 steps
_ROUNDING = 2.0**-52


class SteadyState(NamedTuple):
    """E|z - z_hat_i|^2 of every node, as it counts, under white w of unit covariance, (n,); and what may be off."""

    nodes: Array
    error: float  # of the total, relative; computed, from what is left of the equation

    @property
    def total(self) -> float:
        """E|z_tilde|^2."""
        return float(self.nodes.sum())


@np.errstate(over="ignore", invalid="ignore")
def steady_state(model: ErrorModel, *, initial: int) -> SteadyState | None:
    """Of white w with covariance I; r(0) = `initial`. None: not mean-square stable, or not found to SETTLED."""
    operator = Operator(model)
    decays = decay(operator.corner, model.modes, operator.units, operator.model.moves)
    if not decays.dies_out:
        return None
    size, both = model.size, np.outer(operator.units, operator.units)
    joint = np.zeros((model.modes, size + model.nw, size + model.nw))
    joint[:, size:, size:] = long_run(operator.transition, initial)[:, None, None] * operator.eye_w
    fresh = operator.carry(joint) * both
    joint[:, size:, size:] = 0.0

    def carried(X: Array) -> Array:
        joint[:, :size, :size] = X / both
        following = operator.carry(joint) * both
        return np.asarray((following + following.swapaxes(1, 2)) / 2.0)

    X = solution(carried, fresh)
    if X is None:
        return None
    per_node = _weighed(model, X.sum(axis=0) / both)
    off, total = _off(decays, operator, X, fresh + carried(X) - X), float(per_node.sum())
    if per_node.min() < 0.0 or not off <= SETTLED * total:  # or what cancels in M leaves rounding alone
        return None
    return SteadyState(per_node, off / total if total > 0.0 else 0.0)


def long_run(transition: Array, initial: int) -> Array:
    """How often the chain is in every mode in the long run, (modes,), from mode `initial`."""
    chain = (transition + np.eye(len(transition))) / 2.0  # spends as long everywhere, and has no period
    for _ in range(_DOUBLINGS):
        chain = chain @ chain
        chain /= chain.sum(axis=1, keepdims=True)
    return np.asarray(chain[initial])


def _weighed(model: ErrorModel, X: Array) -> Array:
    """E|z - z_hat_i|^2, (n,), where eta has the covariance X (n_eta, n_eta)."""
    squares = np.einsum("ij,jk,ik->i", model.M, X, model.M)
    return np.asarray(squares.reshape(len(model.rows), -1).sum(axis=1))


def _off(found: Decay, operator: Operator, X: Array, rest: Array) -> float:
    """By how much tr(M'M X) may be off where X, in natural units, leaves `rest` of its equation.

    It is off by tr(Y rest), Y - L(Y) = M'M. Where M'M <= c (Z - L(Z)), Y <= c Z.
    """
    assert found.total is not None
    assert found.rest is not None
    both = np.outer(operator.units, operator.units)
    L = np.linalg.cholesky(found.rest / both)
    M = np.broadcast_to((operator.M / operator.units).T, (len(L), operator.size, len(operator.M)))
    c = float(np.linalg.norm(np.linalg.solve(L, M), 2, axis=(1, 2)).max()) ** 2
    values, vectors = np.linalg.eigh((rest + rest.swapaxes(1, 2)) / 2.0)
    left = (vectors * np.abs(values)[:, None]) @ vectors.swapaxes(1, 2)
    return c * float(np.vdot(found.total / both, left + operator.size * _ROUNDING * X))
