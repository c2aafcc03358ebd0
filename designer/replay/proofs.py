"""Proofs 1 and 2 of a replay: every logged number follows from logged numbers. No step of a node is repeated here.

All steps of a block are compared at once; every comparison is a `Check` with a relative gap for each number.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import NamedTuple

import numpy as np

from agent.contract import schedule
from agent.contract.arrays import Array
from agent.contract.gains import Gains
from agent.contract.problem import Problem
from designer.error_model import ErrorModel, Stacks, error_model, measurement_slices, stacked_gains, stacks
from designer.replay.log import Log
from designer.replay.topics import Numbers

FLOOR = 1e-140  # magnitudes below it count as this: their squares underflow in the free run's bound


class Check(NamedTuple):
    """One comparison, for the steps `first`, `first` + 1, ...

    gap = |logged - expected| / magnitude, where the magnitude is the sum of the absolute values of everything that
    is added up to the number; NaN where something is missing. Of names, the gap is 1 where they differ.
    """

    proof: int
    field: str
    first: int
    owner: Numbers  # (columns,): the node of each column, -1 for the plant and the coordinator
    gap: Array  # (steps, columns)
    logged: Array  # (steps, columns); positions in `words` where there are any
    expected: Array
    words: Sequence[str] = ()


def numbers(
    proof: int, field: str, first: int, owner: Numbers, logged: Array, expected: Array, magnitude: Array
) -> Check:
    gap = np.abs(logged - expected) / np.maximum(magnitude, FLOOR)
    return Check(proof, field, first, owner, gap, logged, expected)


def names(field: str, first: int, owner: Numbers, logged: Numbers, expected: Numbers, words: Sequence[str]) -> Check:
    unknown = (logged < 0) | (expected < 0)
    gap = np.where(unknown, np.nan, logged != expected)
    return Check(1, field, first, owner, gap, logged.astype(float), expected.astype(float), words)


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
        K_bar, H_bar = stacked_gains(gains)
        return cls(gains.problem, error_model(gains.problem, K_bar, H_bar), stacks(gains.problem), K_bar, H_bar)

    def owner(self, width: int) -> Numbers:
        """The node of each column of a stacked vector with `width` numbers for each node."""
        return np.repeat(np.arange(self.problem.n), width)

    @property
    def y_owner(self) -> Numbers:
        return np.repeat(np.arange(self.problem.n), [node.C.shape[0] for node in self.problem.nodes])

    def magnitude(self, s: int, x: Array, x_hat: Array, w: Array, y: Array) -> Array:
        """What adds up to eta(k+1) in mode s at most, in absolute values, (steps, n_eta).

        For x: |A||x| + |B||w|. For e_i, that and, over the neighbours j, a_ij |K_ij| (|x| + |x_hat_j|)
        + a_ij |H_ij| (|y_j| + |C_j| (|x| + |x_hat_j|) + |D_j||w|): an upper bound both of what the node adds up
        in (4)(5) and of what (8) adds up, up to a factor of 2, because |e_j| <= |x| + |x_hat_j|.
        """
        x, x_hat, w, y = (np.nan_to_num(np.abs(values)) for values in (x, x_hat, w, y))
        plant, n = self.problem.plant, self.problem.n
        of_x = x @ np.abs(plant.A).T + w @ np.abs(plant.B).T
        reach = np.tile(x, n) + x_hat
        of_y = y + reach @ np.abs(self.bar.C).T + w @ np.abs(self.bar.D).T
        of_e = np.tile(of_x, n) + reach @ np.abs(self.K_bar[s]).T + of_y @ np.abs(self.H_bar[s]).T
        return np.asarray(np.maximum(np.hstack([of_x, of_e]), FLOOR))


class Inputs(NamedTuple):
    """What drives the model. With a simulated plant: modes, theta, w, and u = 0.

    Without one the errors are unknown, and estimates are compared instead: with x = 0, w = 0 and e_i = -x_hat_i,
    (8) reads e(k+1) = (K_bar - H_bar C_bar_beta) e(k) - H_bar u(k), where u is the logged y.
    """

    mode: Numbers  # (steps,)
    theta: Array  # (steps, n)
    w: Array  # (steps, nw)
    u: Array  # (steps, sum ny)


class Drawn(NamedTuple):
    """What the run's seed gives."""

    mode: Numbers  # (steps,)
    theta: Array  # (steps, n)
    w: Array  # (steps, nw)


def draw(log: Log) -> Drawn:
    problem, steps = log.gains.problem, log.steps
    losses = schedule.Losses(problem, seed=log.seed)
    disturbance = schedule.DisturbanceSource(problem, seed=log.seed)
    return Drawn(
        np.fromiter(islice(schedule.modes(problem, seed=log.seed), steps), dtype=np.int64, count=steps),
        np.array([losses.at(k) for k in range(steps)]).reshape(steps, problem.n),
        np.array([disturbance.at(k) for k in range(steps)]).reshape(steps, problem.nw),
    )


def logged_inputs(log: Log) -> Inputs:
    """The inputs as logged, NaN and -1 where missing."""
    if log.has_plant:
        return Inputs(log.mode, log.theta, log.w, np.zeros_like(log.y))
    problem = log.gains.problem
    return Inputs(log.mode, np.tile(problem.beta, (log.steps, 1)), np.zeros((log.steps, problem.nw)), log.y)


def logged_states(log: Log) -> Array:
    """eta(k) = [x; e_1; ...; e_n] as logged, (steps, n_eta); x is 0 where there is no simulated plant."""
    x = log.x if log.has_plant else np.zeros_like(log.x)
    return np.hstack([x, np.tile(x, log.gains.problem.n) - log.x_hat])


def start_checks(log: Log, central: Central) -> Iterator[Check]:
    """x(0) = 0 and x_hat_i(0) = 0."""
    x, x_hat = log.x[:1], log.x_hat[:1]
    plant = np.full(x.shape[1], -1)
    yield numbers(1, "x", 0, plant, x, np.zeros_like(x), np.abs(x))
    yield numbers(1, "x_hat", 0, central.owner(central.problem.nx), x_hat, np.zeros_like(x_hat), np.abs(x_hat))


def input_checks(log: Log, central: Central, drawn: Drawn, now: slice) -> Iterator[Check]:
    """Proof 1: modes, losses and disturbance are the seed's; plant (1) and sensors (2) obey them."""
    problem, plant, first = central.problem, central.problem.plant, now.start
    nowhere = np.full(1, -1)
    yield names("mode", first, nowhere, log.mode[now, None], drawn.mode[now, None], log.modes.texts)
    theta, w, x = log.theta[now], log.w[now], log.x[now]
    yield numbers(1, "arrived", first, central.owner(1), theta, drawn.theta[now], np.ones_like(theta))
    yield numbers(1, "w", first, np.repeat(nowhere, problem.nw), w, drawn.w[now], np.abs(drawn.w[now]))
    x_next = log.x[now.start + 1 : now.stop + 1]
    rows = len(x_next)
    predicted = x @ plant.A.T + w @ plant.B.T
    magnitude = np.abs(x) @ np.abs(plant.A).T + np.abs(w) @ np.abs(plant.B).T
    yield numbers(1, "x", first + 1, np.repeat(nowhere, problem.nx), x_next, predicted[:rows], magnitude[:rows])
    yield numbers(
        1, "z", first, np.repeat(nowhere, problem.nz), log.z[now], x @ plant.M.T, np.abs(x) @ np.abs(plant.M).T
    )
    C = np.vstack([node.C for node in problem.nodes])
    theta_y = theta[:, central.y_owner]
    y = theta_y * (x @ C.T) + w @ central.bar.D.T
    y[:, np.array(log.external)[central.y_owner]] = np.nan  # a real sensor knows nothing of the simulated plant
    magnitude = theta_y * (np.abs(x) @ np.abs(C).T) + np.abs(w) @ np.abs(central.bar.D).T
    yield numbers(1, "y", first, central.y_owner, log.y[now], y, magnitude)


def message_checks(log: Log, central: Central, hears: Numbers, now: slice) -> Iterator[Check]:
    """Proof 1, what each node says of itself: innovation, z_hat, and the mode and neighbours that it used.

    `hears` (modes, n) are the positions in `log.senders` of the neighbours of every node in every mode.
    """
    problem, M, nx, nz = central.problem, central.problem.plant.M, central.problem.nx, central.problem.nz
    x_hat, y, z_hat = log.x_hat[now], log.y[now], log.z_hat[now]
    for i, (node, columns) in enumerate(zip(problem.nodes, measurement_slices(problem), strict=True)):
        x_hat_i, y_i, beta_C = x_hat[:, i * nx : (i + 1) * nx], y[:, columns], node.arrival_probability * node.C
        yield numbers(
            1,
            "innovation",
            now.start,
            np.full(len(node.C), i),
            log.innovation[now][:, columns],
            y_i - x_hat_i @ beta_C.T,
            np.abs(y_i) + np.abs(x_hat_i) @ np.abs(beta_C).T,
        )
        z_hat_i, owner = z_hat[:, i * nz : (i + 1) * nz], np.full(nz, i)
        yield numbers(1, "z_hat", now.start, owner, z_hat_i, x_hat_i @ M.T, np.abs(x_hat_i) @ np.abs(M).T)
    each = central.owner(1)
    used, heard = log.used[now], log.heard[now]
    before = np.concatenate([[-1], log.mode])[now]  # the mode of the step before
    known = (before >= 0) & (before < len(hears))
    expected_mode = np.tile(before[:, None], problem.n)
    expected_heard = np.where(known[:, None], hears[np.where(known, before, 0)], -1)
    if now.start == 0:  # x_hat(0) was not made from anything
        expected_mode[0] = log.modes.number("")
        expected_heard[0] = log.senders.number(())
    yield names("mode", now.start, each, used, expected_mode, log.modes.texts)
    yield names("heard", now.start, each, heard, expected_heard, log.senders.texts)


def neighbours(log: Log) -> Numbers:
    """(modes, n): the position in `log.senders` of the neighbours of node i in mode s."""
    problem = log.gains.problem
    return np.array(
        [
            [log.senders.number(problem.node_names[j] for j in problem.neighbours(s, i)) for i in range(problem.n)]
            for s in range(len(problem.topologies))
        ]
    )


def step_checks(log: Log, central: Central, inputs: Inputs, eta: Array, now: slice) -> Iterator[Check]:
    """Proof 2: eq. (10) from the logged eta(k) gives the logged e(k+1); shown as x_hat(k+1) = x(k+1) - e(k+1)."""
    problem, model, nx = central.problem, central.model, central.problem.nx
    now = slice(now.start, min(now.stop, log.steps - 1))  # the last step has no successor
    mode, w, u = inputs.mode[now], inputs.w[now], inputs.u[now]
    predicted, magnitude = np.full_like(eta[now], np.nan), np.ones_like(eta[now])
    for s in range(len(problem.topologies)):
        at = np.flatnonzero(mode == s)
        state, d_theta = eta[now][at], inputs.theta[now][at] - model.beta
        unknown = np.isnan(state)
        state = np.where(unknown, 0.0, state)
        eta_next = state @ model.A[s].T + w[at] @ model.B[s].T
        taken = (np.hstack([state, w[at]]) @ model.R.T) * d_theta[:, model.owner]  # (steps, sum ny)
        eta_next[:, nx:] -= (taken + u[at]) @ central.H_bar[s].T
        touched = unknown.astype(float) @ (model.A[s] != 0.0).T.astype(float) > 0.0
        predicted[at] = np.where(touched, np.nan, eta_next)
        magnitude[at] = central.magnitude(s, state[:, :nx], log.x_hat[now][at], w[at], log.y[now][at])
    after = slice(now.start + 1, now.stop + 1)
    x_next = eta[after, :nx]
    yield numbers(
        2,
        "x_hat",
        now.start + 1,
        central.owner(nx),
        log.x_hat[after],
        np.tile(x_next, problem.n) - predicted[:, nx:],
        magnitude[:, nx:],
    )
