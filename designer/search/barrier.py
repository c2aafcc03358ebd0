"""The log-det barrier of the exact gain over a horizon T, a smooth function of the gains; and its gradient.

With y = log g,

    J(K, H, y) = y - mu sum over steps and modes of log det (I - B'Y_bar B / g)

is finite exactly where gamma_T^2 < g, and costs one sweep and one covariance: gamma_T itself is never searched for.
B'Y_bar B is the block of w in `Operator.joint`; docs/theory.md, section 6.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from agent.contract.arrays import Array
from agent.contract.problem import Problem
from designer.gain.exact import Operator
from designer.gain.sensitivity import Inputs, Slope, Sweep, slope, sweep
from designer.model.error_model import (
    ErrorModel,
    Indices,
    StackedGains,
    error_model,
    measurement_slices,
    rows_total,
    stacks,
)
from designer.model.units import natural_units
from designer.search import bfgs
from designer.search.starts import node_regression

_DAMPING = 0.1  # added to a Hessian with 1 on its diagonal: only part of the Hessian is known


class Entries:
    """The entries of K_bar and H_bar that the topologies allow, as one vector, in natural units.

    K_ij is in units of x per x and H_ij in units of x per y: a w of unit energy reaches one unit of x. Where gains are
    unbiased, K_ii is not free: a_ii K_ii = A - sum over j != i of a_ij K_ij.
    """

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        nx, columns, modes = problem.nx, measurement_slices(problem), len(problem.topologies)
        self.K = np.zeros((modes, problem.n * nx, problem.n * nx), dtype=bool)
        self.H = np.zeros((modes, problem.n * nx, rows_total(problem)), dtype=bool)
        for s in range(modes):
            for i in range(problem.n):
                rows = slice(i * nx, (i + 1) * nx)
                for j in problem.neighbours(s, i):
                    self.K[s, rows, j * nx : (j + 1) * nx] = not problem.unbiased or j != i
                    self.H[s, rows, columns[j]] = True
        self.units = np.concatenate([np.broadcast_to(units, at.shape)[at] for units, at in self._units()])

    def pack(self, K_bar: Array, H_bar: Array) -> Array:
        """All K entries, then all H entries."""
        return np.asarray(np.concatenate([K_bar[self.K], H_bar[self.H]]) / self.units)

    def pack_slope(self, K_bar: Array, H_bar: Array) -> Array:
        """The derivative by the vector, from those by K_bar and H_bar."""
        if self.problem.unbiased:
            K_bar = K_bar - np.tile(self._own(K_bar), (1, 1, self.problem.n))
        return np.asarray(np.concatenate([K_bar[self.K], H_bar[self.H]]) * self.units)

    def unpack(self, v: Array) -> StackedGains:
        """The inverse of `pack`, zero elsewhere."""
        K_bar, H_bar = np.zeros(self.K.shape), np.zeros(self.H.shape)
        split = np.count_nonzero(self.K)
        K_bar[self.K], H_bar[self.H] = np.split(v * self.units, [split])
        if self.problem.unbiased:
            n, nx = self.problem.n, self.problem.nx
            own = np.tile(self.problem.plant.A, (n, 1)) - K_bar.reshape(-1, n * nx, n, nx).sum(axis=2)
            for i in range(n):
                rows = slice(i * nx, (i + 1) * nx)
                K_bar[:, rows, rows] = own[:, rows]
        return K_bar, H_bar

    def of_node(self, s: int, i: int) -> Indices:
        """Where the vector has [K_ij H_ij] of node i in mode s, row by row."""
        own = np.zeros((len(self.K), self.problem.n, 1), dtype=bool)
        own[s, i] = True
        rows = np.repeat(own, self.problem.nx, axis=1)  # (modes, n nx, 1)
        of_K = np.broadcast_to(rows, self.K.shape)[self.K]
        of_H = np.broadcast_to(rows, self.H.shape)[self.H]
        K, H = np.flatnonzero(of_K), len(of_K) + np.flatnonzero(of_H)
        return np.hstack([K.reshape(self.problem.nx, -1), H.reshape(self.problem.nx, -1)]).reshape(-1)

    def _units(self) -> list[tuple[Array, NDArray[np.bool_]]]:
        """What every entry of K_bar and of H_bar is measured in, and which are free."""
        bar, x = stacks(self.problem), np.tile(natural_units(self.problem).state, self.problem.n)
        y = np.hypot(np.linalg.norm(bar.C * x, axis=1), np.linalg.norm(bar.D, axis=1))
        return [(x[:, None] / x, self.K), (x[:, None] / np.where(y > 0.0, y, 1.0), self.H)]

    def _own(self, K_bar: Array) -> Array:
        """The blocks (i, i), one below the other, (modes, n nx, nx)."""
        n, nx = self.problem.n, self.problem.nx
        return np.concatenate([K_bar[:, i * nx : (i + 1) * nx, i * nx : (i + 1) * nx] for i in range(n)], axis=1)


class Barrier:
    """J and what it is made of, for one problem and horizon; x = [v; y] holds the gains' entries and y = log g."""

    def __init__(self, problem: Problem, horizon: int) -> None:
        self.problem, self.horizon = problem, horizon
        self.entries, self.inputs = Entries(problem), Inputs(problem)
        self.heard = {
            (s, i): (node_regression(problem, s, i), self.entries.of_node(s, i))
            for s in range(len(problem.topologies))
            for i in range(problem.n)
        }

    def model(self, v: Array) -> ErrorModel:
        """The error model of the gains v."""
        return error_model(self.problem, *self.entries.unpack(v))

    def operator(self, v: Array) -> Operator:
        """The same, in the shapes of the recursions."""
        return Operator(self.model(v))

    def descent(self, mu: float) -> bfgs.Function:
        """J(v, y), whose minimum goes to that of log gamma_T^2 as mu goes to 0."""

        def J(x: Array) -> tuple[float, Array]:
            log_det, gradient = self._log_det(x)
            gradient = -mu * gradient
            gradient[-1] += 1.0
            return float(x[-1]) - mu * log_det, gradient

        return J

    def centre(self, y: float, ridge: float) -> bfgs.Function:
        """The same with g held, and the size of the gains in place of y: -sum of log det + ridge |v|^2 / 2.

        The sum is least where the responses of all horizons together are small: for gains that decay fast.
        """

        def J(v: Array) -> tuple[float, Array]:
            log_det, gradient = self._log_det(np.append(v, y))
            return ridge / 2.0 * float(v @ v) - log_det, ridge * v - gradient[:-1]

        return J

    def inverse_hessian(self, x: Array, mu: float, *, ridge: float = 0.0) -> Array:
        """Where BFGS begins: the inverse of part of the Hessian of J + ridge |v|^2 / 2 by [v; y].

        The part is what remains if Y_bar and the moments of [eta; w] do not move with the gains, and of that a block
        for each mode and node: the sum over steps of 2 mu Y_bar (x) E r r', r being what K_ij and H_ij multiply.
        Other units of x and y scale it as they scale v, so the steps of BFGS do not depend on them.
        """
        inverse, found = np.eye(len(x)), self._swept(x)
        if found is None:
            return inverse
        swept, slopes = found
        for (s, i), (heard, at) in self.heard.items():
            first, moments = self.inputs.p + i * self.problem.nx, slopes.moments[:, s]
            rows = slice(first, first + self.problem.nx)
            gram = heard.mean @ moments @ heard.mean.T + sum(V @ moments @ V.T for V in heard.noises)
            known = 2.0 * mu * np.einsum("kab,kcd->acbd", swept.Y_bar[:, s, rows, rows], gram, optimize=True)
            hessian = known.reshape(len(at), -1) * np.outer(self.entries.units[at], self.entries.units[at])
            hessian += ridge * np.eye(len(at))
            roots = np.sqrt(np.where(hessian.diagonal() > 0.0, hessian.diagonal(), 1.0))
            sizes = np.outer(roots, roots)
            inverse[np.ix_(at, at)] = np.linalg.inv(hessian / sizes + _DAMPING * np.eye(len(at))) / sizes
        return inverse

    def _log_det(self, x: Array) -> tuple[float, Array]:
        """The sum of log det (I - B'Y_bar B / g) and its gradient in [v; y]; minus infinity where gamma_T^2 >= g."""
        found = self._swept(x)
        if found is None:
            return -math.inf, np.zeros_like(x)
        swept, slopes = found
        g, count = math.exp(x[-1]), math.prod(swept.W_inverse.shape[:3])
        traces = float(np.trace(swept.W_inverse, axis1=2, axis2=3).sum())
        down = self.entries.pack_slope(slopes.K_bar, slopes.H_bar)
        return swept.log_det, np.append(-down, g * (traces - slopes.g) - count)

    def _swept(self, x: Array) -> tuple[Sweep, Slope] | None:
        """The sweep at [v; y] and the slopes of -sum of log det; None where gamma_T^2 >= g."""
        v, y = x[:-1], float(x[-1])
        if abs(y) > 300.0 or np.abs(v).max() > 1e50:  # squares overflow
            return None
        model = self.model(v)
        operator = Operator(model)
        swept = sweep(operator, math.exp(y), self.horizon)
        return None if swept is None else (swept, slope(model, operator, self.inputs, swept, swept.W_inverse))
