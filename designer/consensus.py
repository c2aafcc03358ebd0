"""Kalman-consensus gains: a start for the descent that needs no solver, for any size of network.

In every mode node i predicts as if its neighbourhood never changed: the Riccati equation of the sensors that it
hears, with the losses taken as more noise; and it draws its estimate towards those of its neighbours.
"""

from __future__ import annotations

import numpy as np

from agent.contract.arrays import Array
from agent.contract.problem import Problem
from designer.error_model import measurement_slices, rows_total

_MOST_STEPS = 1000


def consensus_gains(problem: Problem, *, weight: float) -> tuple[Array, Array]:
    """K_bar (modes, n nx, n nx) and H_bar (modes, n nx, sum ny); the neighbours' estimates share `weight`."""
    nx, A, columns = problem.nx, problem.plant.A, measurement_slices(problem)
    K_bar = np.zeros((len(problem.topologies), problem.n * nx, problem.n * nx))
    H_bar = np.zeros((len(problem.topologies), problem.n * nx, rows_total(problem)))
    spread = _plant_covariance(problem)
    for s in range(len(problem.topologies)):
        for i in range(problem.n):
            heard, rows = problem.neighbours(s, i), slice(i * nx, (i + 1) * nx)
            others = len(heard) - 1
            for j in heard:
                share = 1.0 if not others else 1.0 - weight if j == i else weight / others
                K_bar[s, rows, j * nx : (j + 1) * nx] = share * A
            at = np.concatenate([np.arange(columns[j].start, columns[j].stop) for j in heard])
            H_bar[s][rows, at] = _predictor_gain(problem, heard, spread)
    return K_bar, H_bar


def _predictor_gain(problem: Problem, heard: tuple[int, ...], spread: Array) -> Array:
    """L = (A P C' + B D')(C P C' + D D' + losses)^-1 of the nodes `heard`, (nx, their measurements), C with beta."""
    A, B, nodes, beta = problem.plant.A, problem.plant.B, problem.nodes, problem.beta
    C = np.vstack([beta[j] * nodes[j].C for j in heard])
    D = np.vstack([nodes[j].D for j in heard])
    noise, first = D @ D.T, 0
    for j in heard:
        rows = slice(first, first + len(nodes[j].C))
        noise[rows, rows] += beta[j] * (1.0 - beta[j]) * (nodes[j].C @ spread @ nodes[j].C.T)
        first = rows.stop
    P = B @ B.T
    for _ in range(_MOST_STEPS):
        innovation, cross = C @ P @ C.T + noise, A @ P @ C.T + B @ D.T
        L = cross @ np.linalg.pinv(innovation, rcond=1e-10, hermitian=True)
        P_next = A @ P @ A.T + B @ B.T - L @ cross.T
        if np.abs(P_next - P).max() <= 1e-10 * np.abs(P).max():
            break
        P = (P_next + P_next.T) / 2.0
    return np.asarray(L)


def _plant_covariance(problem: Problem) -> Array:
    """X = A X A' + B B': where white w keeps the plant; the sum by doubling, A is stable."""
    power, X = problem.plant.A, problem.plant.B @ problem.plant.B.T
    while np.abs(power).max() > 1e-12:
        X = X + power @ X @ power.T
        power = power @ power
    return np.asarray(X)
