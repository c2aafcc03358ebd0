"""The centralised model (10)(11) of a gains file as a replay needs it: with bounds on its rounding."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from agent.contract.arrays import Array
from agent.contract.gains import Gains, LinkMatrices
from agent.contract.problem import Problem
from designer.model.error_model import ErrorModel, Stacks, error_model, stacked_links, stacks
from designer.replay.topics import Numbers

FLOOR = 1e-140  # magnitudes below it count as this: their squares underflow in the free run's bound

Flags = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Central:
    """The centralised model (10)(11) of a gains file, and the absolute values that bound its rounding errors."""

    problem: Problem
    model: ErrorModel
    bar: Stacks
    K_bar: Array  # (modes, n nx, n nx)
    H_bar: Array  # (modes, n nx, sum ny)

    @classmethod
    def of(cls, gains: Gains) -> Central:
        return cls.of_links(gains.problem, gains.K, gains.H)

    @classmethod
    def of_links(cls, problem: Problem, K: LinkMatrices, H: LinkMatrices) -> Central:
        """Of gains that are in no file yet."""
        K_bar, H_bar = stacked_links(problem, K, H)
        return cls(problem, error_model(problem, K_bar, H_bar), stacks(problem), K_bar, H_bar)

    @cached_property
    def C_nu(self) -> Array:
        """(sum ny, n nx): what x_hat takes off a measurement: beta_i C_i, or C_i where node i sees its losses."""
        seen = np.array([node.seen for node in self.problem.nodes])[self.y_owner]
        return np.asarray(np.where(seen[:, None], self.bar.C, self.bar.C_beta))

    @cached_property
    def links(self) -> tuple[Numbers, Numbers]:
        """Receivers and senders of the lossy links, in the order of the problem."""
        index, links = self.problem.node_names.index, self.problem.links or ()
        ends = np.array([(index(link.receiver), index(link.sender)) for link in links], dtype=np.int64).reshape(-1, 2)
        return ends[:, 0], ends[:, 1]

    def delivered(self, phi: Flags) -> Flags | None:
        """(n, n) from the values of the lossy links, (links,); None where there are none."""
        if not len(phi):
            return None
        delivered = np.ones((self.problem.n, self.problem.n), dtype=bool)
        delivered[self.links] = phi
        return delivered

    @cached_property
    def stand_in(self) -> Array | None:
        """(modes, n, nx, nx): in absolute values, by what a node multiplies its own estimate beside a_ii K_ii.

        a_ij |K_ij| of the lossy links, where it stands in for a message; where gains are unbiased |A| and a_ij |K_ij|
        of all neighbours. None where there is nothing of the kind.
        """
        problem, n, nx = self.problem, self.problem.n, self.problem.nx
        counts = np.ones((n, n)) if problem.unbiased else (problem.delivery < 1.0).astype(float)
        np.fill_diagonal(counts, 0.0)
        if not problem.unbiased and not counts.any():
            return None
        blocks = np.abs(self.K_bar).reshape(-1, n, nx, n, nx)
        of_others = np.einsum("sirjc,ij->sirc", blocks, counts)
        return np.asarray(of_others + (np.abs(problem.plant.A) if problem.unbiased else 0.0))

    @cached_property
    def touches(self) -> Array:
        """(modes, n_eta, n_eta): 1 where an entry of eta(k) may enter one of eta(k+1), else 0."""
        model, p = self.model, self.model.plant_states
        touches = model.A != 0.0
        touches[:, p:] |= np.abs(model.H) @ np.abs(model.R[:, : model.size]) != 0.0
        links = model.links
        if links is not None:
            nx = self.problem.nx
            for s, i, columns, V_l in zip(links.mode, links.receiver, links.columns, links.V, strict=True):
                rows, here = touches[s, p + i * nx : p + (i + 1) * nx], columns < model.size
                rows[:, columns[here]] |= V_l[:, here] != 0.0
        return np.asarray(touches, dtype=np.float64)

    def start(self, has_plant: bool) -> tuple[Array, Array]:
        """x(0) and eta(0), (nx,) and (n_eta,): where the plant is not known, x counts as 0 throughout."""
        x = self.problem.initial_error if has_plant else np.zeros(self.problem.nx)
        return x, np.tile(x, self.model.size // self.problem.nx)

    def owner(self, width: int) -> Numbers:
        """The node of each column of a stacked vector with `width` numbers for each node."""
        return np.repeat(np.arange(self.problem.n), width)

    @property
    def y_owner(self) -> Numbers:
        return np.repeat(np.arange(self.problem.n), [node.C.shape[0] for node in self.problem.nodes])

    def magnitude(self, s: int, x: Array, x_hat: Array, w: Array, y: Array, *, stand_in: Array | None = None) -> Array:
        """What adds up to eta(k+1) in mode s at most, in absolute values, (steps, n_eta).

        For x: |A||x| + |B||w|. For e_i, that and, over the neighbours j, a_ij |K_ij| (|x| + |x_hat_j|)
        + a_ij |H_ij| (|y_j| + |C_j| (|x| + |x_hat_j|) + |D_j||w|), and `stand_in` times |x| + |x_hat_i|: an upper bound
        both of what the node adds up in its step and of what (10) adds up, up to the factor that `tolerance` derives,
        because |e_j| <= |x| + |x_hat_j|.
        """
        x, x_hat, w, y = (np.nan_to_num(np.abs(values)) for values in (x, x_hat, w, y))
        plant, n = self.problem.plant, self.problem.n
        of_x = x @ np.abs(plant.A).T + w @ np.abs(plant.B).T
        reach = np.tile(x, n) + x_hat
        of_y = y + reach @ np.abs(self.bar.C).T + w @ np.abs(self.bar.D).T
        of_e = np.tile(of_x, n) + reach @ np.abs(self.K_bar[s]).T + of_y @ np.abs(self.H_bar[s]).T
        if stand_in is None and self.stand_in is not None:
            stand_in = self.stand_in[s]
        if stand_in is not None:
            own = reach.reshape(-1, n, self.problem.nx)
            of_e += np.einsum("kic,irc->kir", own, stand_in).reshape(of_e.shape)
        return np.asarray(np.maximum(np.hstack([of_x, of_e]) if self.model.plant_states else of_e, FLOOR))
