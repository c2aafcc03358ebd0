"""What is legal in a problem, and a user may not have meant."""

from __future__ import annotations

import numpy as np

from agent.contract.errors import counted, listed
from agent.contract.problem import Problem

_ROUNDED = 1e-6  # of the largest eigenvalue, and at all: less is 0, of which floats keep half the digits


def notes(problem: Problem) -> list[str]:
    """Each a sentence: a matrix of continuous time, a column of w that is several things at once."""
    return [*_continuous(problem), *_shared(problem)]


def _continuous(problem: Problem) -> list[str]:
    found = np.linalg.eigvals(problem.plant.A)
    real, size = found.real, float(np.abs(found).max())
    if (real < 0.0).all():
        what = "every eigenvalue of A has a negative real part"
    elif size > _ROUNDED and (real <= _ROUNDED * size).all():  # integrators, or oscillators
        what = "no eigenvalue of A has a positive real part"
    elif (real < -1.0).any():
        what = f"the real part {real.min():.4g} of an eigenvalue of A is below -1"
    else:
        return []
    return [
        f"{what}, as of a continuous-time model; A must be of x(k+1) = A x(k) + B w(k), exp(A T) of a plant that is "
        "sampled every T"
    ]


def _shared(problem: Problem) -> list[str]:
    """What gamma is where a column of w is several things at once."""
    moves = np.any(problem.plant.B != 0.0, axis=0)
    disturbs = np.array([np.any(node.D != 0.0, axis=0) for node in problem.nodes])
    shared = [int(column) for column in np.flatnonzero(disturbs.sum(axis=0) + moves > 1) if disturbs[:, column].any()]
    if not shared:
        return []
    column = shared[0]
    of = [name for name, there in zip(problem.node_names, disturbs[:, column], strict=True) if there]
    roles = ["moves the plant"] if moves[column] else []
    roles.append(f"is the noise of {'node' if len(of) == 1 else 'nodes'} {listed(of)}")
    more = f" (and {counted(len(shared) - 1, 'more column')} of the kind)" if len(shared) > 1 else ""
    return [
        f"column {column + 1} of w {' and '.join(roles)}{more}: gamma is for disturbances that are one and the same; "
        "noises that are independent need a column of their own in B and every D"
    ]
