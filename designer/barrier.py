"""The log-det barrier of the exact gain over a horizon T, a smooth function of the gains; and its gradient.

With y = log g,

    J(K, H, y) = y - mu sum over steps and modes of log det (I - B'Y_bar B / g)

is finite exactly where gamma_T^2 < g, and costs one sweep and one covariance: gamma_T itself is never searched for.
B'Y_bar B is the block of w in `Operator.joint`; docs/theory.md, section 6.
"""

from __future__ import annotations

import math

import numpy as np

from agent.contract.arrays import Array
from agent.contract.problem import Problem
from designer import bfgs
from designer.error_model import ErrorModel, StackedGains, error_model, measurement_slices, rows_total
from designer.gain import Operator
from designer.sensitivity import Inputs, slope, sweep

_RIDGE = math.sqrt(10.0)


class Entries:
    """The entries of K_bar and H_bar that the topologies allow, as one vector.

    Where gains are unbiased, K_ii is not free: a_ii K_ii = A - sum over j != i of a_ij K_ij.
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

    def pack(self, K_bar: Array, H_bar: Array) -> Array:
        """All K entries, then all H entries."""
        return np.concatenate([K_bar[self.K], H_bar[self.H]])

    def pack_slope(self, K_bar: Array, H_bar: Array) -> Array:
        """The derivative by the vector, from those by K_bar and H_bar."""
        if self.problem.unbiased:
            K_bar = K_bar - np.tile(self._own(K_bar), (1, 1, self.problem.n))
        return self.pack(K_bar, H_bar)

    def unpack(self, v: Array) -> StackedGains:
        """The inverse of `pack`, zero elsewhere."""
        K_bar, H_bar = np.zeros(self.K.shape), np.zeros(self.H.shape)
        split = np.count_nonzero(self.K)
        K_bar[self.K], H_bar[self.H] = v[:split], v[split:]
        if self.problem.unbiased:
            n, nx = self.problem.n, self.problem.nx
            own = np.tile(self.problem.plant.A, (n, 1)) - K_bar.reshape(-1, n * nx, n, nx).sum(axis=2)
            for i in range(n):
                rows = slice(i * nx, (i + 1) * nx)
                K_bar[:, rows, rows] = own[:, rows]
        return K_bar, H_bar

    def _own(self, K_bar: Array) -> Array:
        """The blocks (i, i), one below the other, (modes, n nx, nx)."""
        n, nx = self.problem.n, self.problem.nx
        return np.concatenate([K_bar[:, i * nx : (i + 1) * nx, i * nx : (i + 1) * nx] for i in range(n)], axis=1)


class Barrier:
    """J and what it is made of, for one problem and horizon; x = [v; y] holds the gains' entries and y = log g."""

    def __init__(self, problem: Problem, horizon: int) -> None:
        self.problem, self.horizon = problem, horizon
        self.entries, self.inputs = Entries(problem), Inputs(problem)

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

    def centre(self, y: float, scale: float) -> bfgs.Function:
        """The same with g held, and the size of the gains in place of y: -sum of log det + 10 |v|^2 / scale^2.

        The sum is least where the responses of all horizons together are small: for gains that decay fast. Without
        the 10, gains of a flat minimum shrink so slowly that the search ends first.
        """

        def J(v: Array) -> tuple[float, Array]:
            log_det, gradient = self._log_det(np.append(v, y))
            ridge = _RIDGE * v / scale
            return float(ridge @ ridge) - log_det, 2.0 * _RIDGE * ridge / scale - gradient[:-1]

        return J

    def _log_det(self, x: Array) -> tuple[float, Array]:
        """The sum of log det (I - B'Y_bar B / g) and its gradient in [v; y]; minus infinity where gamma_T^2 >= g."""
        v, y = x[:-1], float(x[-1])
        swept = None
        if abs(y) < 300.0 and np.abs(v).max() < 1e50:  # beyond, squares overflow
            model, g = self.model(v), math.exp(y)
            operator = Operator(model)
            swept = sweep(operator, g, self.horizon)
        if swept is None:
            return -math.inf, np.zeros_like(x)
        slopes = slope(model, operator, self.inputs, swept, swept.W_inverse)
        traces = float(np.trace(swept.W_inverse, axis1=2, axis2=3).sum())
        count = swept.Gamma.shape[0] * swept.Gamma.shape[1] * operator.nw
        down = self.entries.pack_slope(slopes.K_bar, slopes.H_bar)
        return swept.log_det, np.append(-down, g * (traces - slopes.g) - count)
