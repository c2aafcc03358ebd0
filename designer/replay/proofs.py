"""Proofs 1 and 2 of a replay: every logged number follows from logged numbers. No step of a node is repeated here.

All steps of a block are compared at once; every comparison is a `Check` with a relative gap for each number.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agent.contract import schedule
from agent.contract.arrays import Array
from agent.contract.gains import Gains
from agent.contract.problem import Problem
from designer.error_model import ErrorModel, Stacks, error_model, measurement_slices, stacked_gains, stacks
from designer.replay.log import Log
from designer.replay.topics import Numbers

FLOOR = 1e-140  # magnitudes below it count as this: their squares underflow in the free run's bound
MEASURED = ("[]", "numbers")  # what a measurement of a node that sees its losses is

Flags = NDArray[np.bool_]


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

    def owner(self, width: int) -> Numbers:
        """The node of each column of a stacked vector with `width` numbers for each node."""
        return np.repeat(np.arange(self.problem.n), width)

    @property
    def y_owner(self) -> Numbers:
        return np.repeat(np.arange(self.problem.n), [node.C.shape[0] for node in self.problem.nodes])

    def magnitude(self, s: int, x: Array, x_hat: Array, w: Array, y: Array) -> Array:
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
        if self.stand_in is not None:
            own = reach.reshape(-1, n, self.problem.nx)
            of_e += np.einsum("kic,irc->kir", own, self.stand_in[s]).reshape(of_e.shape)
        return np.asarray(np.maximum(np.hstack([of_x, of_e]) if self.model.plant_states else of_e, FLOOR))


class Inputs(NamedTuple):
    """What drives the model. With a simulated plant: modes, theta, w, phi, and u = 0.

    Without one the errors are unknown, and estimates are compared instead: with x = 0, w = 0 and e_i = -x_hat_i,
    (8) reads e(k+1) = (K_bar - H_bar C_bar_beta) e(k) - H_bar u(k), where u is the logged y. Where a node sees its
    losses u is 0 for what did not arrive, and theta says what did; of hidden losses theta counts as beta.
    """

    mode: Numbers  # (steps,)
    theta: Array  # (steps, n)
    w: Array  # (steps, nw)
    u: Array  # (steps, sum ny)
    phi: Flags  # (steps, links): which messages were used, of the lossy links alone


class Drawn(NamedTuple):
    """What the run's seed gives."""

    mode: Numbers  # (steps,)
    theta: Array  # (steps, n)
    w: Array  # (steps, nw)
    phi: Flags  # (steps, links)


def draw(log: Log, central: Central) -> Drawn:
    problem, steps = log.gains.problem, log.steps
    losses = schedule.Losses(problem, seed=log.seed)
    disturbance = schedule.DisturbanceSource(problem, seed=log.seed, worst_case=log.gains.worst_case)
    return Drawn(
        np.fromiter(islice(schedule.modes(problem, seed=log.seed), steps), dtype=np.int64, count=steps),
        np.array([losses.at(k) for k in range(steps)]).reshape(steps, problem.n),
        np.array([disturbance.at(k) for k in range(steps)]).reshape(steps, problem.nw),
        _drawn_deliveries(log, central),
    )


def _drawn_deliveries(log: Log, central: Central) -> Flags:
    drawn = np.empty((log.steps, len(central.links[0])), dtype=bool)
    if drawn.size:
        deliveries = schedule.Deliveries(log.gains.problem, seed=log.seed)
        drawn[:] = [deliveries.at(k)[central.links] for k in range(log.steps)]
    return drawn


def logged_inputs(log: Log, central: Central, drawn: Drawn) -> Inputs:
    """The inputs as logged, NaN and -1 where missing; phi as drawn where it is not logged."""
    phi = _used_messages(log, central, drawn)
    if log.has_plant:
        return Inputs(log.mode, log.theta, log.w, np.zeros_like(log.y), phi)
    problem = log.gains.problem
    theta = np.where([node.seen for node in problem.nodes], log.measured, problem.beta)
    u = np.where(log.measured[:, central.y_owner] == 0.0, 0.0, log.y)
    return Inputs(log.mode, theta, np.zeros((log.steps, problem.nw)), u, phi)


def _used_messages(log: Log, central: Central, drawn: Drawn) -> Flags:
    """phi of step k, (steps, links), by `heard` in the receiver's estimate of step k + 1; as drawn where that lacks."""
    receivers, senders = central.links
    if not len(receivers):
        return drawn.phi
    told = log.heard[1:, receivers]
    used = np.vstack([log.senders.members(), np.zeros((1, log.gains.problem.n), dtype=bool)])[told, senders]
    return np.vstack([np.where(told >= 0, used, drawn.phi[:-1]), drawn.phi[-1:]])


def logged_plant(log: Log) -> Array:
    """x(k) as logged, (steps, nx); 0 where there is no simulated plant."""
    return log.x if log.has_plant else np.zeros_like(log.x)


def logged_states(log: Log, central: Central) -> Array:
    """eta(k) as logged, (steps, n_eta): [x; e_1; ...; e_n], or the errors alone where x drops out."""
    x = logged_plant(log)
    errors = np.tile(x, log.gains.problem.n) - log.x_hat
    return np.hstack([x, errors]) if central.model.plant_states else errors


def start_checks(log: Log, central: Central) -> Iterator[Check]:
    """x(0) = 0 and x_hat_i(0) = 0."""
    x, x_hat = log.x[:1], log.x_hat[:1]
    plant = np.full(x.shape[1], -1)
    yield numbers(1, "x", 0, plant, x, np.zeros_like(x), np.abs(x))
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

    The innovation of a node that sees its losses is 0 where its measurement is empty. `hears` (steps, n) are the
    positions in `log.senders` of those whose messages of each step every node was to use.
    """
    problem, M, nx, nz = central.problem, central.problem.plant.M, central.problem.nx, central.problem.nz
    x_hat, y, z_hat = log.x_hat[now], log.y[now], log.z_hat[now]
    for i, (node, columns) in enumerate(zip(problem.nodes, measurement_slices(problem), strict=True)):
        x_hat_i, y_i = x_hat[:, i * nx : (i + 1) * nx], y[:, columns]
        C_i = central.C_nu[columns, i * nx : (i + 1) * nx]
        expected, magnitude = y_i - x_hat_i @ C_i.T, np.abs(y_i) + np.abs(x_hat_i) @ np.abs(C_i).T
        if node.seen:
            nothing = log.measured[now, i] == 0.0
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


def step_checks(log: Log, central: Central, inputs: Inputs, eta: Array, now: slice) -> Iterator[Check]:
    """Proof 2: eq. (10) from the logged eta(k) gives the logged e(k+1); shown as x_hat(k+1) = x(k+1) - e(k+1)."""
    problem, model, nx = central.problem, central.model, central.problem.nx
    p, x = model.plant_states, logged_plant(log)
    now = slice(now.start, min(now.stop, log.steps - 1))  # the last step has no successor
    mode, w, u = inputs.mode[now], inputs.w[now], inputs.u[now]
    predicted, magnitude = np.full_like(eta[now], np.nan), np.ones_like(eta[now])
    for s in range(len(problem.topologies)):
        at = np.flatnonzero(mode == s)
        state, d_theta = eta[now][at], inputs.theta[now][at] - model.beta
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
