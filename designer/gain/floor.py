"""The floor: below which gamma no network of linear filters gets, whatever its topology and memory.

Let w be fixed beforehand such that every node's mean measurement is 0 at every step: C_i x + D_i w = 0 where node i
sees its losses, or has none, and beta_i C_i x + D_i w = 0 where losses are hidden. Take any filters that are linear in
what the sensors deliver, with gains that may depend on the modes, on the losses that are seen and on which messages
arrived, but not on losses that are hidden. Then every estimate has mean 0 given all that the gains depend on, so
E|z_tilde|^2 >= |1 kron M x|^2 = n |M x|^2. The floor is the largest of these per energy of w. Links that lose messages
do not change it. Where no loss is hidden it holds for every causal filter, linear or not: nothing at all is heard.

The floor is infinite where some w moves M x without bound and nobody sees it: an unstable part of the plant that
all sensors together do not show.
"""

from __future__ import annotations

import math

import numpy as np

from agent.contract.arrays import Array
from agent.contract.problem import Problem
from designer.coordinates import Coordinates
from designer.model.units import NaturalUnits
from designer.patience import look

_SETTLED = 1e-12
_ROUNDED = 1e-6
_MOST_STEPS = 10_000
_DEPENDENT = 1e-10  # a combination of scaled measurements smaller than this is no measurement
_BOUNDLESS = 1e100  # a detectable plant does not grow by so much
_GROWN = 1.001  # the least growth over half of all steps that is not convergence: sqrt k, of an integrator, has 1.4


def floor(problem: Problem) -> float:
    """|weights| sqrt(lambda_max(M P M')), P = S S' the limit of the Riccati equation of all sensors; or infinity.

    { x(k) : y(0..k-1) = 0, energy of w <= 1 } = { S_k v : |v| <= 1 }. One step: x = S v and w with C S v + D w = 0
    give A S v + B w, so S_(k+1) = [A S, B] N with N an orthonormal basis of the kernel of [C S, D]. That is the
    Riccati equation with w shared by plant and sensors, and needs no inverse of D D'. C is beta_i C_i where hidden.
    In natural units: what is small beside what depends on them otherwise.
    """
    natural = NaturalUnits(problem, Coordinates.of(problem), exactly=True)
    problem, plant = natural.problem, natural.problem.plant
    C = np.vstack([node.C if node.seen else node.arrival_probability * node.C for node in problem.nodes])
    D = np.vstack([node.D for node in problem.nodes])
    S, reached = np.zeros((problem.nx, problem.nx)), [0.0]
    for _ in range(_MOST_STEPS):
        look()
        kernel = _kernel(np.hstack([C @ S, D]))
        step = np.hstack([plant.A @ S, plant.B])
        left, sizes, _ = np.linalg.svd(step @ kernel, full_matrices=False)
        sizes[sizes <= _DEPENDENT * np.linalg.norm(step)] = 0.0  # rounding of the kernel moves no state
        S_next = np.zeros_like(S)
        S_next[:, : len(sizes)] = left * sizes
        change = np.abs(S_next @ S_next.T - S @ S.T).max()
        S = S_next
        reached.append(max(reached[-1], float(np.linalg.norm(plant.M @ S, ord=2))))  # each step is a floor of its own
        settled = change <= _SETTLED * np.abs(S @ S.T).max()
        if settled or np.abs(S).max() > _BOUNDLESS * np.abs(plant.B).max():
            break
    grows = reached[-1] > _GROWN * reached[len(reached) // 2]
    if not settled and grows and not _detectable(plant.A, C):
        return math.inf
    return natural.output * float(np.linalg.norm(problem.weights)) * reached[-1]


def floor_below(problem: Problem, gamma: float) -> float | None:
    """The floor; None where it is above a gamma that is proved, so that rounding made it."""
    found = floor(problem)
    return found if found <= gamma * (1.0 + _ROUNDED) else None


def _detectable(A: Array, C: Array) -> bool:
    """Whether C shows every eigenvector of A whose eigenvalue is not inside the unit circle."""
    scaled = C / np.maximum(np.linalg.norm(C, axis=1), np.finfo(float).tiny)[:, None]
    unstable = [root for root in np.linalg.eigvals(A) if abs(root) > 1.0 - _DEPENDENT]
    sizes = [np.linalg.svd(np.vstack([A - root * np.eye(len(A)), scaled]), compute_uv=False) for root in unstable]
    return all(size[-1] > 1e-8 * size[0] for size in sizes)


def _kernel(rows: Array) -> Array:
    """An orthonormal basis of { v : rows v = 0 }, its vectors in columns; rows are scaled first."""
    lengths = np.linalg.norm(rows, axis=1)
    scaled = rows[lengths > 0.0] / lengths[lengths > 0.0, None]
    if not len(scaled):
        return np.eye(rows.shape[1])
    _, sizes, right = np.linalg.svd(scaled)
    return np.asarray(right[int((sizes > _DEPENDENT).sum()) :].T)
