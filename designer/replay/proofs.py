"""Proofs 1 and 2 of a replay: every logged number follows from logged numbers. No step of a node is repeated here.

All steps of a block are compared at once; every comparison is a `Check` with a relative gap for each number.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from agent.contract.arrays import Array
from designer.model.error_model import measurement_slices
from designer.replay.central import FLOOR, Central, Flags
from designer.replay.inputs import Drawn, Inputs, logged_plant, logged_states
from designer.replay.log import Log
from designer.replay.topics import Numbers
from designer.replay.verdict import Divergence

MEASURED = ("[]", "numbers")  # what a measurement of a node that sees its losses is


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
    magnitude: Array | None = None  # (steps, columns), of numbers

    def divergence(self, row: int, column: int, node_names: Sequence[str]) -> Divergence:
        """One of its numbers, or names, beside what it should be."""
        owner = int(self.owner[column])
        position = column - int(np.argmax(self.owner == owner))
        logged, expected = float(self.logged[row, column]), float(self.expected[row, column])
        is_vector = not self.words and self.field != "arrived"
        return Divergence(
            step=self.first + row,
            node=node_names[owner] if owner >= 0 else None,
            field=f"{self.field}[{position}]" if is_vector else self.field,
            gap=float(self.gap[row, column]),
            expected=self.words[int(expected)] if self.words else expected,
            logged=self.words[int(logged)] if self.words else logged,
            proof=self.proof,
        )


def numbers(
    proof: int, field: str, first: int, owner: Numbers, logged: Array, expected: Array, magnitude: Array
) -> Check:
    gap = np.abs(logged - expected) / np.maximum(magnitude, FLOOR)
    return Check(proof, field, first, owner, gap, logged, expected, magnitude=magnitude)


def names(field: str, first: int, owner: Numbers, logged: Numbers, expected: Numbers, words: Sequence[str]) -> Check:
    unknown = (logged < 0) | (expected < 0)
    gap = np.where(unknown, np.nan, logged != expected)
    return Check(1, field, first, owner, gap, logged.astype(float), expected.astype(float), words)


def start_checks(log: Log, central: Central) -> Iterator[Check]:
    """x(0) is the initial error, 0 where the problem has none, and x_hat_i(0) = 0."""
    x, x_hat = log.x[:1], log.x_hat[:1]
    plant = np.full(x.shape[1], -1)
    yield numbers(1, "x", 0, plant, x, central.problem.initial_error[None], np.abs(x))
    yield numbers(1, "x_hat", 0, central.owner(central.problem.nx), x_hat, np.zeros_like(x_hat), np.abs(x_hat))


def input_checks(log: Log, central: Central, drawn: Drawn, now: slice) -> Iterator[Check]:
    """Proof 1: modes, losses and disturbance are the seed's; plant (1) and sensors (2) obey them.

    A lost measurement of a node that sees its losses is empty, and the others of it have the plant in them.
    """
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
    seen = np.array([node.seen for node in problem.nodes])
    real = np.array(log.external)  # a real sensor knows nothing of the simulated plant
    if seen.any():
        known = ~np.isnan(theta) & ~np.isnan(log.measured[now]) & seen & ~real
        logged, expected = (np.where(known, flags, -1.0).astype(np.int64) for flags in (log.measured[now], theta))
        yield names("y", first, central.owner(1), logged, expected, MEASURED)
    C = np.vstack([node.C for node in problem.nodes])
    theta_y = np.where(seen, np.where(np.isnan(theta), np.nan, 1.0), theta)[:, central.y_owner]
    y = theta_y * (x @ C.T) + w @ central.bar.D.T
    y[:, real[central.y_owner]] = np.nan
    magnitude = theta_y * (np.abs(x) @ np.abs(C).T) + np.abs(w) @ np.abs(central.bar.D).T
    yield numbers(1, "y", first, central.y_owner, log.y[now], y, magnitude)


def message_checks(log: Log, central: Central, hears: Numbers, now: slice) -> Iterator[Check]:
    """Proof 1, what each node says of itself: innovation, z_hat, and the mode and neighbours that it used.

    The innovation of a node that sees its losses is 0 where its measurement is empty, and in a paced run that of any
    node where it was not there in time. `hears` (steps, n) are the
    positions in `log.senders` of those whose messages of each step every node was to use.
    """
    problem, M, nx, nz = central.problem, central.problem.plant.M, central.problem.nx, central.problem.nz
    x_hat, y, z_hat = log.x_hat[now], log.y[now], log.z_hat[now]
    for i, (node, columns) in enumerate(zip(problem.nodes, measurement_slices(problem), strict=True)):
        x_hat_i, y_i = x_hat[:, i * nx : (i + 1) * nx], y[:, columns]
        C_i = central.C_nu[columns, i * nx : (i + 1) * nx]
        expected, magnitude = y_i - x_hat_i @ C_i.T, np.abs(y_i) + np.abs(x_hat_i) @ np.abs(C_i).T
        nothing = log.told[now, i] == 0
        if node.seen:
            nothing |= log.measured[now, i] == 0.0
        expected[nothing], magnitude[nothing] = 0.0, 0.0
        owner, logged = np.full(len(node.C), i), log.innovation[now][:, columns]
        yield numbers(1, "innovation", now.start, owner, logged, expected, magnitude)
        z_hat_i, owner = z_hat[:, i * nz : (i + 1) * nz], np.full(nz, i)
        yield numbers(1, "z_hat", now.start, owner, z_hat_i, x_hat_i @ M.T, np.abs(x_hat_i) @ np.abs(M).T)
    each = central.owner(1)
    used, heard = log.used[now], log.heard[now]
    before = np.concatenate([[-1], log.mode])[now]  # the mode of the step before
    expected_mode = np.tile(before[:, None], problem.n)
    expected_heard = np.concatenate([np.full((1, problem.n), -1), hears])[now]
    if now.start == 0:  # x_hat(0) was not made from anything
        expected_mode[0] = log.modes.number("")
        expected_heard[0] = log.senders.number(())
    again = log.origin[now] != -1
    expected_mode[again], expected_heard[again] = log.modes.number(""), log.senders.number(())
    yield names("mode", now.start, each, used, expected_mode, log.modes.texts)
    yield names("heard", now.start, each, heard, expected_heard, log.senders.texts)


def to_be_heard(log: Log, central: Central, drawn: Drawn) -> Numbers:
    """(steps, n): the position in `log.senders` of those whose messages of step k node i was to use.

    They are its neighbours in the logged mode, without those whose messages the seed lost; -1 where no mode is logged.
    """
    problem, (receivers, senders) = log.gains.problem, central.links
    known = (log.mode >= 0) & (log.mode < len(problem.topologies))
    heard = np.full((log.steps, problem.n), -1, dtype=np.int64)
    for i in range(problem.n):
        for s in range(len(problem.topologies)):
            neighbours, at = problem.neighbours(s, i), np.flatnonzero(known & (log.mode == s))
            heard[at, i] = log.senders.number(problem.node_names[j] for j in neighbours)
            lossy = np.flatnonzero((receivers == i) & np.isin(senders, neighbours))
            at = at[~drawn.phi[at][:, lossy].all(axis=1)]
            patterns, which = np.unique(drawn.phi[at][:, lossy], axis=0, return_inverse=True)
            for number, phi in enumerate(patterns):
                kept = [problem.node_names[j] for j in neighbours if j not in senders[lossy[~phi]]]
                heard[at[which.reshape(-1) == number], i] = log.senders.number(kept)
    return heard


def step_checks(log: Log, central: Central, inputs: Inputs, now: slice) -> Iterator[Check]:
    """Proof 2: eq. (10) from the logged eta(k) gives the logged e(k+1); shown as x_hat(k+1) = x(k+1) - e(k+1)."""
    problem, model, nx = central.problem, central.model, central.problem.nx
    p, x = model.plant_states, logged_plant(log)
    now = slice(now.start, min(now.stop, log.steps - 1))  # the last step has no successor
    mode, w, u = inputs.mode[now], inputs.w[now], inputs.u[now]
    eta = logged_states(log, central, now)
    predicted, magnitude = np.full_like(eta, np.nan), np.ones_like(eta)
    for s in range(len(problem.topologies)):
        at = np.flatnonzero(mode == s)
        state, d_theta = eta[at], inputs.theta[now][at] - model.beta
        unknown = np.isnan(state)
        state = np.where(unknown, 0.0, state)
        eta_next = state @ model.A[s].T + w[at] @ model.B[s].T
        driven = np.hstack([state, w[at]])
        taken = (driven @ model.R.T) * d_theta[:, model.owner]  # (steps, sum ny)
        eta_next[:, p:] -= (taken + u[at]) @ model.H[s].T
        if model.links is not None:
            eta_next[:, p:] += _by_links(central, s, driven, d_theta, u[at], inputs.phi[now][at])
        touched = unknown.astype(float) @ central.touches[s].T > 0.0
        predicted[at] = np.where(touched, np.nan, eta_next)
        magnitude[at] = central.magnitude(s, x[now][at], log.x_hat[now][at], w[at], log.y[now][at])
    after = slice(now.start + 1, now.stop + 1)
    x_next = x[after]
    yield numbers(
        2,
        "x_hat",
        now.start + 1,
        central.owner(nx),
        log.x_hat[after],
        np.tile(x_next, problem.n) - predicted[:, p:],
        magnitude[:, p:],
    )


def _by_links(central: Central, s: int, driven: Array, d_theta: Array, u: Array, phi: Flags) -> Array:
    """What realised deliveries add to e(k+1) beside the mean, (steps, n nx): the sum of xi_l V_l [eta; w] in mode s.

    driven (steps, n_eta + nw) is [eta; w], d_theta (steps, n) is theta - beta, phi (steps, links). An input u
    (steps, sum ny) to the innovations comes through the same links.
    """
    links, nx, (receivers, senders) = central.model.links, central.problem.nx, central.links
    assert links is not None
    added = np.zeros((len(driven), central.problem.n * nx))
    for term in np.flatnonzero(links.mode == s):
        i, j = links.receiver[term], links.sender[term]
        rows, column = slice(i * nx, (i + 1) * nx), np.flatnonzero((receivers == i) & (senders == j))[0]
        xi = phi[:, column] - links.rho[term]
        change = driven[:, links.columns[term]] @ links.V[term].T
        if links.with_loss[term]:
            xi = xi * d_theta[:, j]
        else:
            change -= u[:, central.model.rows[j]] @ central.H_bar[s][rows, central.model.rows[j]].T
        added[:, rows] += xi[:, None] * change
    return added
