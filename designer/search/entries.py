"""The gains as one vector: the entries that the topologies allow, in units in which they are of the order of 1."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from agent.contract.arrays import Array
from agent.contract.problem import Problem
from designer.model.error_model import Indices, StackedGains, measurement_slices, rows_total, stacks
from designer.model.units import natural_units


class Entries:
    """The entries of K_bar and H_bar that the topologies allow, as one vector, in natural units.

    K_ij is in units of x per x and H_ij in units of x per y: a w of unit energy reaches one unit of x. Where gains are
    unbiased, K_ii is not free: a_ii K_ii = A - sum over j != i of a_ij K_ij. Entries of K_ij that are `held` (nx, nx)
    stay 0; they have their places in the vector, where they count for nothing.
    """

    def __init__(self, problem: Problem, held: NDArray[np.bool_] | None = None) -> None:
        self.problem, self.held = problem, held
        nx, columns, modes = problem.nx, measurement_slices(problem), len(problem.topologies)
        self.K = np.zeros((modes, problem.n * nx, problem.n * nx), dtype=bool)
        self.H = np.zeros((modes, problem.n * nx, rows_total(problem)), dtype=bool)
        for s in range(modes):
            for i in range(problem.n):
                rows = slice(i * nx, (i + 1) * nx)
                for j in problem.neighbours(s, i):
                    self.K[s, rows, j * nx : (j + 1) * nx] = not problem.unbiased or j != i
                    self.H[s, rows, columns[j]] = True
        self._at_K, self._at_H = np.flatnonzero(self.K), np.flatnonzero(self.H)
        self.units = np.concatenate([np.broadcast_to(units, at.shape)[at] for units, at in self._units()])

    def pack(self, K_bar: Array, H_bar: Array) -> Array:
        """All K entries, then all H entries."""
        return self.in_units(np.concatenate([K_bar[self.K], H_bar[self.H]]))

    def in_units(self, gains: Array) -> Array:
        """The vector of such entries."""
        return np.asarray(np.divide(gains, self.units, out=np.zeros_like(gains), where=self.units > 0.0))

    def pack_slope(self, K_bar: Array, H_bar: Array) -> Array:
        """The derivative by the vector, from those by K_bar and H_bar."""
        if self.problem.unbiased:
            K_bar = K_bar - np.tile(self._own(K_bar), (1, 1, self.problem.n))
        return np.asarray(np.concatenate([K_bar[self.K], H_bar[self.H]]) * self.units)

    def unpack(self, v: Array) -> StackedGains:
        """The inverse of `pack`, zero elsewhere."""
        K_bar, H_bar = np.zeros(self.K.shape), np.zeros(self.H.shape)
        gains = v * self.units
        K_bar.reshape(-1)[self._at_K], H_bar.reshape(-1)[self._at_H] = np.split(gains, [len(self._at_K)])
        if self.problem.unbiased:
            n, nx = self.problem.n, self.problem.nx
            own = np.tile(self.problem.plant.A, (n, 1)) - K_bar.reshape(-1, n * nx, n, nx).sum(axis=2)
            for i in range(n):
                rows = slice(i * nx, (i + 1) * nx)
                K_bar[:, rows, rows] = own[:, rows]
        return K_bar, H_bar

    @cached_property
    def nodes(self) -> dict[tuple[int, int], Indices]:
        """Where the vector has [K_ij H_ij] of node i in mode s, row by row, by (s, i)."""
        (s_K, row_K, _), (s_H, row_H, _) = np.nonzero(self.K), np.nonzero(self.H)
        nx, n = self.problem.nx, self.problem.n
        owner = np.concatenate([s_K * n + row_K // nx, s_H * n + row_H // nx])
        row = np.concatenate([row_K, row_H]) % nx
        order = np.lexsort((row, owner))  # stable: K before H
        ends = np.searchsorted(owner[order], np.arange(1, len(self.K) * n))
        return {divmod(k, n): at for k, at in enumerate(np.split(order, ends))}

    def _units(self) -> list[tuple[Array, NDArray[np.bool_]]]:
        """What every entry of K_bar and of H_bar is measured in, and which are free."""
        bar, x = stacks(self.problem), np.tile(natural_units(self.problem).state, self.problem.n)
        y = np.hypot(np.linalg.norm(bar.C * x, axis=1), np.linalg.norm(bar.D, axis=1))
        of_K = x[:, None] / x
        if self.held is not None:
            of_K[np.tile(self.held, (self.problem.n, self.problem.n))] = 0.0
        return [(of_K, self.K), (x[:, None] / np.where(y > 0.0, y, 1.0), self.H)]

    def _own(self, K_bar: Array) -> Array:
        """The blocks (i, i), one below the other, (modes, n nx, nx)."""
        n, nx = self.problem.n, self.problem.nx
        return np.concatenate([K_bar[:, i * nx : (i + 1) * nx, i * nx : (i + 1) * nx] for i in range(n)], axis=1)
