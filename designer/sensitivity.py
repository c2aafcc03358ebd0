"""How the recursion of the exact gain moves with the gains: one sweep backwards, one covariance forwards.

By the envelope theorem the worst w = Gamma eta may be held fixed while a gain moves. What is left is linear: a
covariance X of eta, started by covariances V of w that are put in at chosen steps and modes, carried forward by
the closed loop, collects the derivative of sum trace(V (B'Y_bar B)); docs/theory.md, "The gradient".
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from agent.contract.arrays import Array
from agent.contract.problem import Problem
from designer.error_model import error_model, stacks
from designer.gain import Operator, horizon_gain, horizon_holds


class Sweep(NamedTuple):
    """The recursion at g, from the end of the horizon backwards: row 0 is the last step."""

    Y_bar: Array  # (T, modes, n_eta, n_eta)
    Gamma: Array  # (T, modes, nw, n_eta): the worst w is Gamma eta
    W_inverse: Array  # (T, modes, nw, nw): (g I - B'Y_bar B)^-1
    log_det: float  # sum over steps and modes of log det (I - B'Y_bar B / g)


def sweep(operator: Operator, g: float, horizon: int) -> Sweep | None:
    """Y <- A'Y_bar A + sum alpha_i F_i'Y_bar F_i + A'Y_bar B W^-1 B'Y_bar A; None where a W is not positive."""
    Y, size, log_det = operator.MM, operator.size, 0.0
    shape = (horizon, len(Y))
    Y_bars = np.empty((*shape, size, size))
    Gammas, inverses = np.empty((*shape, operator.nw, size)), np.empty((*shape, operator.nw, operator.nw))
    for k in range(horizon):
        Y_bars[k] = operator.bar(Y)
        S = operator.joint(Y_bars[k])
        try:
            L = np.linalg.cholesky(operator.eye_w - S[:, size:, size:] / g)
        except np.linalg.LinAlgError:
            return None
        log_det += 2.0 * float(np.log(L.diagonal(axis1=1, axis2=2)).sum())
        L_inverse = np.linalg.inv(L)
        inverses[k] = L_inverse.swapaxes(1, 2) @ L_inverse / g
        Gammas[k] = inverses[k] @ S[:, size:, :size]
        Y = S[:, :size, :size] + S[:, :size, size:] @ Gammas[k]
    return Sweep(Y_bars, Gammas, inverses, log_det)


class Slope(NamedTuple):
    """The derivative of sum trace(V B'Y_bar B) over the steps and modes where V was put in."""

    K_bar: Array  # (modes, n nx, n nx)
    H_bar: Array  # (modes, n nx, sum ny)
    g: float  # minus the energy of the w that follow what was put in


class Inputs:
    """What the gains multiply: K_bar in_K and H_bar in_H are their parts of the rows of e in [A B], by (6)-(11)."""

    def __init__(self, problem: Problem) -> None:
        bar, nx = stacks(problem), problem.nx
        ones = np.tile(np.eye(nx), (problem.n, 1))
        zeros = np.zeros((len(bar.D), nx))
        self.in_K_T = np.hstack([-ones, np.eye(len(ones)), np.zeros((len(ones), problem.nw))]).T
        self.in_H_T = np.hstack([zeros, -bar.C_beta, -bar.D]).T
        lossy = np.flatnonzero(bar.alpha > 0.0)
        E = [bar.E[i] @ ones for i in lossy]  # (sum ny, nx): C_i in the rows of node i
        roots = np.sqrt(bar.alpha[lossy])
        self.lossy = -np.array([root * E_i.T for root, E_i in zip(roots, E, strict=True)]) if E else None


def slope(operator: Operator, inputs: Inputs, swept: Sweep, V: Array) -> Slope:
    """Carry X forward and collect; V (T, modes, nw, nw) has its rows in the order of the sweep."""
    horizon, modes, size, _ = swept.Y_bar.shape
    p = operator.p
    X = np.zeros((modes, size, size))  # covariance of eta, by mode
    joint = np.zeros((horizon, modes, size + operator.nw, size + operator.nw))  # of [eta; w]
    spent = 0.0
    for k in range(horizon - 1, -1, -1):
        GX = swept.Gamma[k] @ X
        GXG = GX @ swept.Gamma[k].swapaxes(1, 2)
        spent += float(np.trace(GXG, axis1=1, axis2=2).sum())
        joint[k, :, :size, :size], joint[k, :, size:, :size] = X, GX
        joint[k, :, :size, size:], joint[k, :, size:, size:] = GX.swapaxes(1, 2), GXG + V[k]
        X_next = operator.AB @ joint[k] @ operator.AB_T
        if len(operator.lossy):
            FX = operator.F.reshape(modes, -1, p) @ X[:, :p, :p]
            X_next[:, p:, p:] += FX.reshape(modes, size - p, -1) @ operator.F.swapaxes(1, 2)
        X = (operator.transition.T @ X_next.reshape(modes, -1)).reshape(X.shape)
    rows = 2.0 * (swept.Y_bar[:, :, p:] @ (operator.AB @ joint)).sum(axis=0)  # (modes, n nx, n_eta + nw)
    K_slope, H_slope = rows @ inputs.in_K_T, rows @ inputs.in_H_T
    if inputs.lossy is not None:
        FX = operator.F.reshape(modes, -1, p) @ joint[:, :, :p, :p]
        YFX = 2.0 * (swept.Y_bar[:, :, p:, p:] @ FX.reshape(horizon, modes, size - p, -1)).sum(axis=0)
        YFX = YFX.reshape(modes, size - p, -1, p).swapaxes(1, 2)  # (modes, lossy, n nx, nx)
        H_slope = H_slope + (YFX @ inputs.lossy).sum(axis=1)
    return Slope(np.asarray(K_slope), np.asarray(H_slope), -spent)


class GainSlope(NamedTuple):
    """gamma_T and its derivative by every entry of K_bar and H_bar."""

    gamma: float
    K_bar: Array  # (modes, n nx, n nx)
    H_bar: Array  # (modes, n nx, sum ny)


def gain_slope(problem: Problem, K_bar: Array, H_bar: Array, *, horizon: int) -> GainSlope:
    """The gradient of gamma_T where one direction is critical alone; elsewhere one of the subgradients.

    At g = gamma_T^2 one W is singular, with null vector u. V = u u' put in there gives the derivative of u'W u by
    the gains, and the energy of the w that follow, with that of u, is its derivative by g.
    """
    operator = Operator(error_model(problem, K_bar, H_bar))
    g, swept = critical_sweep(operator, horizon)
    k, s, u = critical(swept)
    V = np.zeros_like(swept.W_inverse)
    V[k, s] = np.outer(u, u)
    slopes = slope(operator, Inputs(problem), swept, V)
    gamma = math.sqrt(g)
    scale = 1.0 / ((1.0 - slopes.g) * 2.0 * gamma)
    return GainSlope(gamma, scale * slopes.K_bar, scale * slopes.H_bar)


def critical_sweep(operator: Operator, horizon: int) -> tuple[float, Sweep]:
    """gamma_T^2 and the sweep there, over the first horizon that comes within 1e-8 of it.

    Later steps raise gamma_T by less than can be told: their W turns singular within rounding of the same g.
    """
    low, _ = horizon_gain(operator, horizon)
    first, last = 0, horizon
    while last - first > 1:
        middle = (first + last) // 2
        holds, _ = horizon_holds(operator, low * (1.0 - 1e-8), middle)
        first, last = (middle, last) if holds else (first, middle)
    _, g = horizon_gain(operator, last, width=1e-13)
    swept = sweep(operator, g, last)
    assert swept is not None  # the recursion held at g
    return g, swept


def critical(swept: Sweep) -> tuple[int, int, Array]:
    """The row, mode and direction in which W is nearest to singular."""
    eigenvalues = np.linalg.eigvalsh(swept.W_inverse)[..., -1]
    k, s = np.unravel_index(int(eigenvalues.argmax()), eigenvalues.shape)
    return int(k), int(s), np.asarray(np.linalg.eigh(swept.W_inverse[k, s])[1][:, -1])
