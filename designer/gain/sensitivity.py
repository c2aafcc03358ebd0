"""How the recursion of the exact gain moves with the gains: one sweep backwards, one covariance forwards.

By the envelope theorem the worst w = Gamma eta may be held fixed while a gain moves. What is left is linear: a
covariance X of eta, started by covariances V of w that are put in at chosen steps and modes, carried forward by
the closed loop, collects the derivative of sum trace(V (B'Y_bar B)); docs/theory.md, section 5. Here and in the
docstrings B'Y_bar B, B'Y_bar A and A'Y_bar A are the blocks of `Operator.joint`, chance within.
"""

from __future__ import annotations

import math
from functools import cached_property
from typing import NamedTuple

import numpy as np

from agent.contract.arrays import Array
from agent.contract.problem import Problem
from designer.gain.exact import Operator, horizon_gain, recursion_holds, step
from designer.gain.products import Collected, Pattern
from designer.model.error_model import ErrorModel, Indices, error_model, stacks
from designer.model.links import LinkTerms
from designer.model.mismatch import Real, innovations, real_error_model


class Sweep(NamedTuple):
    """The recursion at g, from the end of the horizon backwards: row 0 is the last step."""

    Y_bar: Array  # (T, modes, n_eta, n_eta)
    Gamma: Array  # (T, modes, nw, n_eta): the worst w is Gamma eta
    W_inverse: Array  # (T, modes, nw, nw): (g I - B'Y_bar B)^-1
    log_det: float  # sum over steps and modes of log det (I - B'Y_bar B / g)
    Y: Array  # (modes, n_eta, n_eta): what weighs eta at the start of the horizon


def sweep(operator: Operator, g: float, horizon: int) -> Sweep | None:
    """The steps from M'M; None where a W is not positive definite."""
    Y, log_det, shape = operator.MM, 0.0, (horizon, len(operator.MM))
    Y_bars = np.empty((*shape, operator.size, operator.size))
    Gammas, inverses = np.empty((*shape, operator.nw, operator.size)), np.empty((*shape, operator.nw, operator.nw))
    for k in range(horizon):
        taken = step(operator, Y, g)
        if taken is None:
            return None
        Y_bars[k], inverses[k], Gammas[k], Y = taken.Y_bar, taken.W_inverse, taken.Gamma, taken.Y
        log_det += float(taken.log_det.sum())
    return Sweep(Y_bars, Gammas, inverses, log_det, np.asarray(Y))


class Slope(NamedTuple):
    """The derivative of sum trace(V B'Y_bar B) over the steps and modes where V was put in, and of trace(X Y_T)."""

    K_bar: Array  # (modes, n nx, n nx)
    H_bar: Array  # (modes, n nx, sum ny)
    g: float  # minus the energy of the w that follow what was put in
    moments: Array | None  # (T, entries): those of [eta; w] that were asked for, as V and X started them


class Inputs:
    """What the gains multiply in (6)-(11), so that a derivative by the error model becomes one by the gains.

    `real`: what is, where that is not what the filters were told; then `carry` says whether x is in eta, as
    `real_error_model` takes it.
    """

    def __init__(self, problem: Problem, real: Real | None = None, *, carry: bool = False) -> None:
        bar, nx = stacks(problem), problem.nx
        self.problem, self.real, self.bar = problem, real, bar
        self.by_e, self.by_w, self.by_x = bar.C_beta, bar.D_beta, None  # the mean innovations
        self.p, self.rho = problem.plant_states, problem.delivery
        if real is not None:
            self.p, self.rho = nx if carry else 0, real.rho
            mean = innovations(problem, problem.beta, real, self.p)
            self.by_e, self.by_w, self.by_x = mean.by_e, mean.by_w, mean.by_x
        self.rho_K = np.kron(self.rho, np.ones((nx, nx)))
        widths = [len(node.C) for node in problem.nodes]
        self.rho_H = np.repeat(np.repeat(self.rho, nx, axis=0), widths, axis=1)

    @cached_property
    def pattern(self) -> Pattern:
        """Where the error model of any gains may have numbers: where that of such gains as cancel nothing has."""
        hears = np.array([topology.adjacency != 0.0 for topology in self.problem.topologies])
        nx, widths = self.problem.nx, [len(node.C) for node in self.problem.nodes]
        numbers = np.random.default_rng(0)
        K = np.repeat(np.repeat(hears, nx, axis=1), nx, axis=2)
        H = np.repeat(np.repeat(hears, nx, axis=1), widths, axis=2)
        some = (np.where(at, numbers.uniform(1.0, 2.0, at.shape), 0.0) for at in (K, H))
        return Pattern(self.model(*some))

    def model(self, K_bar: Array, H_bar: Array) -> ErrorModel:
        """The error model of these gains."""
        if self.real is None:
            return error_model(self.problem, K_bar, H_bar)
        return real_error_model(self.problem, self.problem.beta, self.real, K_bar, H_bar, carry=self.p > 0)

    def gains(self, model: ErrorModel, AB: Array, lossy: Array, V: Array | None) -> tuple[Array, Array]:
        """Derivatives by K_bar and H_bar, from those by the rows of e in [A B], by H of `lossy` and by V of the links.

        K_ij stands in columns x, e_j (times rho_ij) and e_i (times 1 - rho_ij); H_ij in those of e_j and w, and in
        those of x where what is real is something else.
        """
        p, n, nx = self.p, self.problem.n, self.problem.nx
        modes, x, e, w = len(AB), AB[:, :, :p], AB[:, :, p : p + n * nx], AB[:, :, p + n * nx :]
        own = np.stack([e[:, i * nx : (i + 1) * nx, i * nx : (i + 1) * nx] for i in range(n)], axis=1)
        every = np.tile(own.reshape(modes, n * nx, nx), (1, 1, n))
        K = self.rho_K * e + (1.0 - self.rho_K) * every
        if not self.problem.unbiased:
            K -= np.tile(x, (1, 1, n))
        H = lossy - e @ self.by_e.T - w @ self.by_w.T
        if self.by_x is not None:
            H -= x @ self.by_x.T
        H *= self.rho_H
        if V is not None and model.links is not None:
            self._add_links(model.links, model.R, V, K, H)
        return np.asarray(K), np.asarray(H)

    def _add_links(self, links: LinkTerms, R: Array, V: Array, K: Array, H: Array) -> None:
        p, nx, bar = self.p, self.problem.nx, self.bar
        for term, (s, i, j) in enumerate(zip(links.mode, links.receiver, links.sender, strict=True)):
            rows, columns = slice(i * nx, (i + 1) * nx), bar.rows[j]
            if links.with_loss[term]:
                H[s, rows, columns] -= V[term] @ R[columns][:, links.columns[term]].T
                continue
            e_i, e_j, w = V[term, :, p : p + nx], V[term, :, p + nx : p + 2 * nx], V[term, :, p + 2 * nx :]
            K[s, rows, j * nx : (j + 1) * nx] += e_j - e_i
            by_e = self.by_e[columns, j * nx : (j + 1) * nx]
            H[s, rows, columns] -= e_j @ by_e.T + w @ self.by_w[columns].T
            if self.by_x is not None:
                H[s, rows, columns] -= V[term, :, :p] @ self.by_x[columns].T


def slope(
    model: ErrorModel,
    operator: Operator,
    inputs: Inputs,
    swept: Sweep,
    V: Array,
    *,
    X: Array | None = None,
    entries: Indices | None = None,
) -> Slope:
    """Carry X forward and collect; V (T, modes, nw, nw) has its rows in the order of the sweep.

    X (modes, n_eta, n_eta): the covariance of eta at the start, 0 where there is none. `entries`: of the moments
    (modes, n_eta + nw, n_eta + nw) that are wanted, flat.
    """
    horizon, modes, size, _ = swept.Y_bar.shape
    links, collected, by_V = operator.links, Collected(operator.products), None
    X = np.zeros((modes, size, size)) if X is None else X
    joint = np.empty((modes, size + operator.nw, size + operator.nw))  # covariance of [eta; w], by mode
    moments, spent = None if entries is None else np.empty((horizon, len(entries))), 0.0
    for k in range(horizon - 1, -1, -1):
        GX = swept.Gamma[k] @ X
        GXG = GX @ swept.Gamma[k].swapaxes(1, 2)
        spent += float(np.trace(GXG, axis1=1, axis2=2).sum())
        joint[:, :size, :size], joint[:, size:, :size] = X, GX
        joint[:, :size, size:], joint[:, size:, size:] = GX.swapaxes(1, 2), GXG + V[k]
        if moments is not None:
            moments[k] = joint.reshape(-1)[entries]
        if links is not None:
            by_V = links.by_V(swept.Y_bar[k], joint) + (0.0 if by_V is None else by_V)
        X = operator.carry(joint, collected, swept.Y_bar[k])
    return Slope(*inputs.gains(model, *collected.full(model), by_V), -spent, moments)


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
    model = error_model(problem, K_bar, H_bar)
    inputs = Inputs(problem)
    operator = Operator(model, inputs.pattern)
    g, swept = critical_sweep(operator, horizon)
    k, s, u = critical(swept)
    V = np.zeros_like(swept.W_inverse)
    V[k, s] = np.outer(u, u)
    slopes = slope(model, operator, inputs, swept, V)
    gamma = math.sqrt(g)
    scale = 1.0 / ((1.0 - slopes.g) * 2.0 * gamma)
    return GainSlope(gamma, scale * slopes.K_bar, scale * slopes.H_bar)


def critical_sweep(operator: Operator, horizon: int) -> tuple[float, Sweep]:
    """gamma_T^2 and the sweep there, over the first horizon that comes within 1e-8 of it.

    Later steps raise gamma_T by less than can be told: their W turns singular within rounding of the same g.
    """
    low, _ = horizon_gain(operator, horizon, width=1e-10)
    first, last = 0, horizon
    while last - first > 1:
        middle = (first + last) // 2
        holds = recursion_holds(operator, low * (1.0 - 1e-8), middle).holds
        first, last = (middle, last) if holds else (first, middle)
    _, g = horizon_gain(operator, last, width=1e-13)
    swept, above = sweep(operator, g, last), 1e-14
    while swept is None:  # the recursion held at g, but BLAS may round in another order
        above *= 2.0
        swept = sweep(operator, g * (1.0 + above), last)
    return g, swept


def critical(swept: Sweep) -> tuple[int, int, Array]:
    """The row, mode and direction in which W is nearest to singular."""
    eigenvalues = np.linalg.eigvalsh(swept.W_inverse)[..., -1]
    k, s = np.unravel_index(int(eigenvalues.argmax()), eigenvalues.shape)
    return int(k), int(s), np.asarray(np.linalg.eigh(swept.W_inverse[k, s])[1][:, -1])
