"""What drives the model: modes, losses, deliveries and disturbance, as they are logged and as the seed gives them."""

from __future__ import annotations

from itertools import islice
from typing import NamedTuple

import numpy as np

from agent.contract import schedule
from agent.contract.arrays import Array
from designer.replay.central import Central, Flags
from designer.replay.log import Log
from designer.replay.topics import Numbers


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
    theta, w = np.empty((steps, problem.n)), np.empty((steps, problem.nw))
    for k in range(steps):
        theta[k], w[k] = losses.at(k), disturbance.at(k)
    mode = np.fromiter(islice(schedule.modes(problem, seed=log.seed), steps), dtype=np.int64, count=steps)
    return Drawn(mode, theta, w, _drawn_deliveries(log, central))


def _drawn_deliveries(log: Log, central: Central) -> Flags:
    drawn = np.empty((log.steps, len(central.links[0])), dtype=bool)
    if drawn.size:
        deliveries = schedule.Deliveries(log.gains.problem, seed=log.seed)
        for k in range(log.steps):
            drawn[k] = deliveries.at(k)[central.links]
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


def logged_states(log: Log, central: Central, now: slice) -> Array:
    """eta(k) as logged at some steps, (steps, n_eta): [x; e_1; ...; e_n], or the errors alone where x drops out."""
    x = logged_plant(log)[now]
    errors = np.tile(x, log.gains.problem.n) - log.x_hat[now]
    return np.hstack([x, errors]) if central.model.plant_states else errors
