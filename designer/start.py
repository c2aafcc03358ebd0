"""What an initial error adds to the guarantee: x(0) anywhere in |x_j(0)| <= initial_error_j, the nodes at 0.

Two sentences, docs/theory.md, section 7. By the P of (17) and (18): E|z_tilde(k)|^2 <= gamma_P^2 (E sum |w|^2 + V),
V = eta(0)'P(r(0))eta(0); proved. And since roots of mean squares add up at most (Minkowski), with the certified gamma,
which may be far below gamma_P: (E|z_tilde(k)|^2)^(1/2) <= gamma (E sum |w|^2)^(1/2) + what x(0) alone leaves; computed.
"""

from __future__ import annotations

import itertools
import math
from fractions import Fraction
from typing import Any, NamedTuple

import numpy as np

from agent.contract.arrays import Array
from agent.contract.gains import LinkMatrices
from agent.contract.problem import Problem
from designer.decay import decay
from designer.gain.exact import Operator
from designer.ladder import rounded_up
from designer.model.error_model import error_model, stacked_links
from designer.proof.certificate import least_of_P
from designer.proof.prover import Prover

_MOST_STEPS = 20_000
_CORNERS = 10  # states whose signs are all tried; of more, each entry counts by its absolute value


class FromStart(NamedTuple):
    """Of gains on a problem with an initial error; None where it was not found."""

    alone: float | None  # (E|z_tilde(k)|^2)^(1/2) at most, at any step, where there is no w; computed
    gamma_P: float | None  # of the P of the certificate, by (17) and (18); proved
    V: float | None  # eta(0)'P eta(0) at most; exact, rounded up

    def document(self) -> dict[str, Any]:
        """For --json."""
        return self._asdict()


def from_start(problem: Problem, K: LinkMatrices, H: LinkMatrices, P: Array | None = None) -> FromStart | None:
    """None where the problem has no initial error. `P`: what the certificate stores; without it, one is made."""
    if problem.plant.initial_error is None:
        return None
    known = least_of_P(problem, Prover(problem, K, H, P=P))
    gamma, V = (None, None) if known is None else (known[0], value_of(problem, known[1]))
    return FromStart(left_by_start(problem, K, H), gamma, V)


@np.errstate(over="ignore", invalid="ignore")
def left_by_start(problem: Problem, K: LinkMatrices, H: LinkMatrices) -> float | None:
    """The most that x(0) alone leaves of (E|z_tilde(k)|^2)^(1/2); None where the errors do not die out.

    Y(k) = L^k(M'M) weighs eta(0) after k steps. With Z - L(Z) > 0 and Y(k) <= c Z none of the later ones weighs it by
    more than c Z does, so the search for the largest ends.
    """
    model, s = error_model(problem, *stacked_links(problem, K, H)), problem.mode_index(problem.markov.initial)
    operator = Operator(model)
    Z = decay(operator.corner, model.modes, operator.units).total
    if Z is None:
        return None
    try:
        inverse = np.linalg.inv(np.linalg.cholesky(Z))
    except np.linalg.LinAlgError:
        return None
    corners, of_Z = _corners(problem), _weighed(Z[s], problem)
    Y, most = np.asarray(operator.MM), 0.0
    for _ in range(_MOST_STEPS):
        most = max(most, _largest(_weighed(Y[s], problem), corners))
        c = float(np.linalg.norm(inverse @ Y @ inverse.swapaxes(1, 2), 2, axis=(1, 2)).max())
        if c * _largest(of_Z, corners) <= most:
            return math.sqrt(most)
        Y = operator.corner(Y)
    return None


def value_of(problem: Problem, P: Array) -> float:
    """eta(0)'P(r(0))eta(0) for the worst x(0) within the initial error: exact, rounded up."""
    P_s, nx = P[problem.mode_index(problem.markov.initial)], problem.nx
    blocks = [[[Fraction(float(entry)) for entry in P_s[i::nx, j::nx].ravel()] for j in range(nx)] for i in range(nx)]
    weights = [[sum(block, Fraction(0)) for block in row] for row in blocks]
    if _is_many(problem):
        weights = [[abs(weight) for weight in row] for row in weights]
    most = max(
        sum((x[i] * x[j] * weights[i][j] for i in range(nx) for j in range(nx)), Fraction(0))
        for x in ([Fraction(float(entry)) for entry in corner] for corner in _corners(problem))
    )
    return math.nextafter(float(most), math.inf)


def _corners(problem: Problem) -> Array:
    """The corners of |x_j| <= initial_error_j, of which -x is as good as x, (corners, nx)."""
    if _is_many(problem):
        return np.abs(problem.initial_error)[None]
    signs = itertools.product(*([(1.0,)] + [(1.0, -1.0)] * (problem.nx - 1)))
    return np.array(list(signs)) * problem.initial_error


def _is_many(problem: Problem) -> bool:
    """Whether there are too many corners: then |x|'|Y||x| at one of them is what none exceeds."""
    return problem.nx > _CORNERS


def _weighed(Y: Array, problem: Problem) -> Array:
    """By how much Y weighs x where eta = [x; x; ...; x], (nx, nx)."""
    parts = len(Y) // problem.nx
    weighed = np.asarray(Y.reshape(parts, problem.nx, parts, problem.nx).sum(axis=(0, 2)))
    return np.abs(weighed) if _is_many(problem) else weighed


def _largest(weight: Array, corners: Array) -> float:
    return float(np.einsum("ci,ij,cj->c", corners, weight, corners).max())


def told(start: dict[str, Any] | None) -> list[str]:
    """`FromStart.document` for people."""
    if start is None:
        return []
    alone, gamma, V = start["alone"], start["gamma_P"], start["V"]
    found = [
        "start      what x(0) within the initial error leaves was not found"
        if alone is None
        else f"start      from x(0) within the initial error sqrt(E|z~|^2) <= gamma sqrt(E sum |w|^2) + {alone:.6g}, "
        "of which the last is computed"
    ]
    if gamma is not None:
        found.append(
            f"           and E|z~|^2 <= {rounded_up(gamma)}^2 (E sum |w|^2 + {rounded_up(V)}), proved by (17) and (18)"
        )
    return found
