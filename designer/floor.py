"""The floor: below which gamma no network of linear filters gets, whatever its topology and memory.

Let w be such that every node's mean measurement, beta_i C_i x + D_i w, is 0 at every step. A filter that is linear in
what the sensors deliver, with gains that may depend on the modes but not on which measurements were lost, then has
the mean estimate 0, so E|z_tilde|^2 >= |1 kron M x|^2 = n |M x|^2. The floor is the largest of these per energy of w.
Without losses it holds for every causal filter, linear or not: nothing at all is heard.
"""

from __future__ import annotations

import math

import numpy as np

from agent.contract.arrays import Array
from agent.contract.problem import Problem

_SETTLED = 1e-12
_MOST_STEPS = 10_000
_DEPENDENT = 1e-10  # a combination of scaled measurements smaller than this is no measurement


def floor(problem: Problem) -> float:
    """sqrt(n lambda_max(M P M')), P = S S' the limit of the predictor Riccati equation of all sensors with C_beta.

    { x(k) : y(0..k-1) = 0, energy of w <= 1 } = { S_k v : |v| <= 1 }. One step: x = S v and w with C S v + D w = 0
    give A S v + B w, so S_(k+1) = [A S, B] N with N an orthonormal basis of the kernel of [C S, D]. That is the
    Riccati equation with w shared by plant and sensors, and needs no inverse of D D'.
    """
    plant, beta = problem.plant, problem.beta
    C = np.vstack([beta_i * node.C for beta_i, node in zip(beta, problem.nodes, strict=True)])
    D = np.vstack([node.D for node in problem.nodes])
    S, reached = np.zeros((problem.nx, problem.nx)), 0.0
    for _ in range(_MOST_STEPS):
        kernel = _kernel(np.hstack([C @ S, D]))
        step = np.hstack([plant.A @ S, plant.B])
        left, sizes, _ = np.linalg.svd(step @ kernel, full_matrices=False)
        sizes[sizes <= _DEPENDENT * np.linalg.norm(step)] = 0.0  # rounding of the kernel moves no state
        S_next = np.zeros_like(S)
        S_next[:, : len(sizes)] = left * sizes
        change = np.abs(S_next @ S_next.T - S @ S.T).max()
        S = S_next
        reached = max(reached, float(np.linalg.norm(plant.M @ S, ord=2)))  # every step is a floor of its own
        if change <= _SETTLED * np.abs(S @ S.T).max():
            break
    return math.sqrt(problem.n) * reached


def _kernel(rows: Array) -> Array:
    """An orthonormal basis of { v : rows v = 0 }, its vectors in columns; rows are scaled first."""
    lengths = np.linalg.norm(rows, axis=1)
    scaled = rows[lengths > 0.0] / lengths[lengths > 0.0, None]
    if not len(scaled):
        return np.eye(rows.shape[1])
    _, sizes, right = np.linalg.svd(scaled)
    return np.asarray(right[int((sizes > _DEPENDENT).sum()) :].T)
