"""What an initial error leaves of z_tilde where there is no w: at most, over all steps and x(0) within it."""

from __future__ import annotations

import itertools
import math

import numpy as np

from agent.contract.arrays import Array
from agent.contract.gains import LinkMatrices
from agent.contract.problem import Problem
from designer.coordinates import Coordinates
from designer.decay import decay
from designer.gain.exact import Operator
from designer.model.error_model import model_of_gains

_MOST_STEPS = 20_000
_CORNERS = 10  # states whose signs are all tried; of more, each entry counts by its absolute value


@np.errstate(over="ignore", invalid="ignore")
def left_by_start(problem: Problem, K: LinkMatrices, H: LinkMatrices) -> float | None:
    """The most that x(0) alone leaves of (E|z_tilde(k)|^2)^(1/2); None where the errors do not die out.

    Y(k) = L^k(M'M) weighs eta(0) after k steps. With Z - L(Z) > 0 and Y(k) <= c Z none of the later ones weighs it by
    more than c Z does, so the search for the largest ends.
    """
    model, s = model_of_gains(problem, K, H), problem.mode_index(problem.markov.initial)
    operator = Operator(model)
    Z = decay(operator.corner, model.modes, operator.units, operator.model.moves).total
    if Z is None:
        return None
    try:
        inverse = np.linalg.inv(np.linalg.cholesky(Z))
    except np.linalg.LinAlgError:
        return None
    tried, of_Z = _tried(problem), _weighed(Z[s], problem)
    Y, most = np.asarray(operator.MM), 0.0
    for _ in range(_MOST_STEPS):
        most = max(most, _largest(_weighed(Y[s], problem), tried))
        c = float(np.linalg.norm(inverse @ Y @ inverse.swapaxes(1, 2), 2, axis=(1, 2)).max())
        if c * _largest(of_Z, tried) <= most:
            return math.sqrt(most)
        Y = operator.corner(Y)
    return None


def corners(problem: Problem) -> Array:
    """The corners of |x_j| <= initial_error_j, of which -x is as good as x, (corners, nx)."""
    if is_many(problem):
        return np.abs(problem.initial_error)[None]
    signs = itertools.product(*([(1.0,)] + [(1.0, -1.0)] * (problem.nx - 1)))
    return np.array(list(signs)) * problem.initial_error


def _tried(problem: Problem) -> Array:
    """The corners in the coordinates of `model_of_gains`; of too many, |T x| is at most |T||x|."""
    coordinates, found = Coordinates.of(problem), corners(problem)
    if coordinates is None:
        return found
    return found @ np.abs(coordinates.T).T if is_many(problem) else coordinates.states(found)


def is_many(problem: Problem) -> bool:
    """Whether there are too many corners: then |x|'|Y||x| at one of them is what none exceeds."""
    return problem.nx > _CORNERS


def _weighed(Y: Array, problem: Problem) -> Array:
    """By how much Y weighs x where eta = [x; x; ...; x], (nx, nx)."""
    parts = len(Y) // problem.nx
    weighed = np.asarray(Y.reshape(parts, problem.nx, parts, problem.nx).sum(axis=(0, 2)))
    return np.abs(weighed) if is_many(problem) else weighed


def _largest(weight: Array, corners: Array) -> float:
    return float(np.einsum("ci,ij,cj->c", corners, weight, corners).max())
