"""What an initial error adds to the guarantee: x(0) anywhere in |x_j(0)| <= initial_error_j, the nodes at 0.

Two sentences, docs/theory.md, section 7. By the P of (17) and (18): E|z_tilde(k)|^2 <= gamma_P^2 (E sum |w|^2 + V),
V = eta(0)'P(r(0))eta(0). And since roots of mean squares add up at most (Minkowski), with the certified gamma, which
may be far below gamma_P: (E|z_tilde(k)|^2)^(1/2) <= gamma (E sum |w|^2)^(1/2) + what x(0) alone leaves. Both are
proved.
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
from designer.coordinates import fractions
from designer.gain.exact import exact_gain
from designer.ladder import rounded_up
from designer.model.error_model import model_of_gains
from designer.single_run import single_run_of

_CORNERS = 10  # states whose signs are all tried; of more, each entry counts by its absolute value


class FromStart(NamedTuple):
    """Of gains on a problem with an initial error; None where it was not found."""

    alone: float | None  # (E|z_tilde(k)|^2)^(1/2) at most, at any step, where there is no w; proved
    gamma_P: float | None  # of the P of the certificate, by (17) and (18); proved
    V: float | None  # eta(0)'P eta(0) at most; exact, rounded up

    def document(self) -> dict[str, Any]:
        """For --json."""
        return self._asdict()


def from_start(problem: Problem, K: LinkMatrices, H: LinkMatrices, P: Array | None = None) -> FromStart | None:
    """None where the problem has no initial error. `P`: what the certificate stores; without it, one is made."""
    if problem.plant.initial_error is None:
        return None
    gamma = exact_gain(model_of_gains(problem, K, H)).high
    known = single_run_of(problem, K, H, gamma, P) if math.isfinite(gamma) else None
    gamma_P, V = (None, None) if known is None else (known.gamma, value_of(problem, known.P, known.T))
    return FromStart(left_by_start(problem, K, H), gamma_P, V)


def left_by_start(problem: Problem, K: LinkMatrices, H: LinkMatrices) -> float | None:
    """The most that x(0) alone leaves of (E|z_tilde(k)|^2)^(1/2), at every step; None: not proved."""
    from designer.proof.prover import Prover  # it loads ball arithmetic
    from designer.proof.undisturbed import Starts

    prover, s = Prover(problem, K, H), problem.mode_index(problem.markov.initial)
    return prover.undisturbed(Starts(s, corners(problem), prover.T, by_size=is_many(problem)))


def corners(problem: Problem) -> Array:
    """The corners of |x_j| <= initial_error_j, of which -x is as good as x, (corners, nx)."""
    if is_many(problem):
        return np.abs(problem.initial_error)[None]
    signs = itertools.product(*([(1.0,)] + [(1.0, -1.0)] * (problem.nx - 1)))
    return np.array(list(signs)) * problem.initial_error


def is_many(problem: Problem) -> bool:
    """Whether there are too many corners: then |x|'|Y||x| at one of them is what none exceeds."""
    return problem.nx > _CORNERS


def value_of(problem: Problem, P: Array, T: Array | None = None) -> float:
    """eta(0)'P(r(0))eta(0) for the worst x(0) within the initial error: exact, rounded up. P is of [T x; T e]."""
    P_s, nx = P[problem.mode_index(problem.markov.initial)], problem.nx
    blocks = [[[Fraction(float(entry)) for entry in P_s[i::nx, j::nx].ravel()] for j in range(nx)] for i in range(nx)]
    weights = [[sum(block, Fraction(0)) for block in row] for row in blocks]
    if T is not None:
        weights = (fractions(T).T @ np.array(weights, dtype=object) @ fractions(T)).tolist()
    if is_many(problem):
        weights = [[abs(weight) for weight in row] for row in weights]
    most = max(
        sum((x[i] * x[j] * weights[i][j] for i in range(nx) for j in range(nx)), Fraction(0))
        for x in ([Fraction(float(entry)) for entry in corner] for corner in corners(problem))
    )
    return math.nextafter(float(most), math.inf)


def told(start: dict[str, Any] | None) -> list[str]:
    """`FromStart.document` for people."""
    if start is None:
        return []
    alone, gamma, V = start["alone"], start["gamma_P"], start["V"]
    found = [
        "start      what x(0) within the initial error leaves was not found"
        if alone is None
        else "start      from x(0) within the initial error sqrt(E|z~|^2) <= gamma sqrt(E sum |w|^2) + "
        f"{rounded_up(alone)}, of which the last is proved too"
    ]
    if gamma is not None:
        found.append(
            f"           and E|z~|^2 <= {rounded_up(gamma)}^2 (E sum |w|^2 + {rounded_up(V)}), proved by (17) and (18)"
        )
    return found
