"""Proofs 3 and 5 of a replay: the model running freely from step 0, and the path inequality."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from agent.contract.arrays import Array
from designer.model.error_model import realised
from designer.replay.central import FLOOR, Central, Flags
from designer.replay.inputs import Drawn, Inputs, logged_plant
from designer.replay.log import Log
from designer.replay.proofs import Check, numbers


class Realised(NamedTuple):
    """Eq. (10) in one step, with the losses and deliveries that there were."""

    A: Array  # (n_eta, n_eta)
    B: Array  # (n_eta, nw)
    H: Array  # (n nx, sum ny): by which an input to the innovations acts; without what was not delivered


class FreeBlock(NamedTuple):
    """The free run at the steps `first`, `first` + 1, ..."""

    first: int
    x: Array  # (steps, nx): the plant from x(0)
    eta: Array  # (steps, n_eta): eta(k) from eta(0) by (10)
    reach: Array  # (steps, n_eta): a relative rounding error of t in every step so far moves eta by t reach at most
    path: Array  # (steps,): gamma_path(k), nan where it overflowed
    start: Array  # (steps,): |M eta(k)| without w


def complete(inputs: Inputs, drawn: Drawn, log: Log, central: Central) -> Inputs:
    """Inputs without holes: what is not logged comes from the seed, or from what the node made of it."""
    mode = np.where((inputs.mode >= 0) & (inputs.mode < len(log.gains.problem.topologies)), inputs.mode, drawn.mode)
    if log.has_plant:
        theta = np.where(np.isnan(inputs.theta), drawn.theta, inputs.theta)
        return inputs._replace(mode=mode, theta=theta, w=np.where(np.isnan(inputs.w), drawn.w, inputs.w))
    y = log.innovation + log.x_hat @ central.C_nu.T  # as if it had arrived: then the innovation is the logged one
    theta = np.where(np.isnan(inputs.theta), 1.0, inputs.theta)
    return inputs._replace(mode=mode, theta=theta, u=np.where(np.isnan(inputs.u), y, inputs.u))


def free_run(log: Log, central: Central, inputs: Inputs, *, block: int) -> Iterator[FreeBlock]:
    """eta(k+1) = script A_k eta(k) + script B_k w(k) from eta(0), with two covariances beside it.

    Path gain: X(k+1) = A_k X(k) A_k' + B_k B_k' from X(0) = 0 gives
    gamma_path(k)^2 = lambda_max(M X(k) M'). It is carried as a factor, X = S S' with S(k+1) = [A_k S(k), B_k], so that
    what cancels in M costs no more digits of M S than of z_tilde itself.

    Rounding: where each step errs by d_j with |d_j| <= t m_j entry by entry, the free run is off by
    sum_j Phi(k, j+1) d_j after k steps. With Y(k+1) = A_k Y(k) A_k' + diag(m_k)^2 the inequality of Cauchy and
    Schwarz bounds entry i of it by t sqrt(k n_eta Y_ii(k)) = t reach_i(k).
    """
    model, plant, p, size = central.model, central.problem.plant, central.model.plant_states, central.model.size

    @lru_cache(maxsize=64)  # small networks have few different ones, large ones no room for many
    def transition(s: int, theta: bytes, phi: bytes) -> Realised:
        delivered = central.delivered(np.frombuffer(phi, dtype=bool))
        AB = realised(model, s, np.frombuffer(theta), delivered)
        return Realised(AB[:, :size], AB[:, size:], _delivered_gains(central, s, delivered))

    x, eta = central.start(log.has_plant)
    start, Y, diagonal = eta, np.diag(eta**2), np.arange(size)
    S = np.zeros((size, 0))
    for first in range(0, log.steps, block):
        steps = range(first, min(first + block, log.steps))
        keys = [(int(inputs.mode[k]), inputs.theta[k].tobytes(), inputs.phi[k].tobytes()) for k in steps]
        xs, etas, reach = np.empty((len(steps), len(x))), np.empty((len(steps), size)), np.empty((len(steps), size))
        for row, k in enumerate(steps):
            of_step = transition(*keys[row])
            xs[row], etas[row] = x, eta
            eta = of_step.A @ eta + of_step.B @ inputs.w[k]
            eta[p:] -= of_step.H @ inputs.u[k]
            x = eta[:p] if p else plant.A @ x + plant.B @ inputs.w[k]
        squares = _magnitudes(log, central, inputs, xs, etas, first) ** 2
        outputs, starts = np.empty((len(steps), len(model.M), len(model.M))), np.empty(len(steps))
        for row in range(len(steps)):
            A_k, B_k, _ = transition(*keys[row])
            F = model.M @ S
            outputs[row] = F @ F.T
            starts[row], start = np.linalg.norm(model.M @ start), A_k @ start
            reach[row] = Y[diagonal, diagonal] * (max(first + row, 1) * size)
            S = _short(np.hstack([A_k @ S, B_k]))
            Y = A_k @ Y @ A_k.T
            Y[diagonal, diagonal] += squares[row]
        yield FreeBlock(first, xs, etas, np.sqrt(np.maximum(reach, FLOOR**2)), largest(outputs), starts)


def _short(S: Array) -> Array:
    """A factor of the same S S' with fewer columns, once there are many more than rows."""
    if S.shape[1] <= 2 * S.shape[0] or not np.isfinite(S).all():
        return S
    return np.asarray(np.linalg.qr(S.T, mode="r")).T


def _delivered_gains(central: Central, s: int, delivered: Flags | None) -> Array:
    """H_bar of mode s, its blocks times phi_ij, (n nx, sum ny)."""
    if delivered is None:
        return np.asarray(central.H_bar[s])
    by_row = np.repeat(delivered, central.problem.nx, axis=0)
    return np.asarray(central.H_bar[s] * by_row[:, central.y_owner])


def free_check(log: Log, central: Central, block: FreeBlock) -> Check:
    """Proof 3: the free run stays with the log; shown as x_hat(k) = x(k) - e(k), with the logged x."""
    p, steps = central.model.plant_states, slice(block.first, block.first + len(block.eta))
    expected = np.tile(logged_plant(log)[steps], central.problem.n) - block.eta[:, p:]
    owner = central.owner(central.problem.nx)
    return numbers(3, "x_hat", block.first, owner, log.x_hat[steps], expected, block.reach[:, p:])


class Path(NamedTuple):
    """Proof 5 over one block: |z_tilde(k)| <= gamma_path(k) (sum over j < k of |w(j)|^2)^(1/2) + what x(0) leaves.

    At step 1 it reads |M B w(0)| <= |M B| |w(0)| with the B of the first step, so it is an equality where w is one
    number. Later gamma_path(k) |w(0), ..., w(k-1)| is attained by one direction of that vector alone.
    """

    first: int
    error: Array  # (steps,): |z_tilde(k)|, as logged; nan where a message is missing
    bound: Array  # (steps,): gamma_path(k) sqrt(energy of the steps before), and |M eta(k)| without w
    rounding: Array  # (steps,): a relative rounding error of t in every step moves the error by t times this
    start: Array | float = 0.0  # (steps,): |M eta(k)| without w; where the bound is no more, it is an equality


def path_block(central: Central, block: FreeBlock, errors: Array, energy_before: Array) -> Path:
    """`errors` (all steps) are |z_tilde(k)|; `energy_before` (all steps) is the sum over j < k of |w(j)|^2."""
    steps = slice(block.first, block.first + len(block.eta))
    rounding = np.linalg.norm(block.reach @ np.abs(central.model.M).T, axis=1)
    bound = block.path * np.sqrt(energy_before[steps]) + block.start
    return Path(block.first, errors[steps], bound, rounding, block.start)


def _magnitudes(log: Log, central: Central, inputs: Inputs, x: Array, eta: Array, first: int) -> Array:
    """m_k of `free_run` for one block, from the log, and from the free run where the log has holes.

    A measurement that `complete` made of the innovation is off by what those sums round, which is within twice their
    absolute values.
    """
    p, steps = central.model.plant_states, slice(first, first + len(eta))
    x_hat = np.where(np.isnan(log.x_hat[steps]), np.tile(x, central.problem.n) - eta[:, p:], log.x_hat[steps])
    made = 2.0 * (np.abs(inputs.u[steps]) + np.abs(x_hat) @ np.abs(central.C_nu).T)
    y = np.where(np.isnan(log.measured[steps][:, central.y_owner]), made, log.y[steps])
    magnitude = np.empty_like(eta)
    for s in np.unique(inputs.mode[steps]):
        at = inputs.mode[steps] == s
        magnitude[at] = central.magnitude(int(s), x[at], x_hat[at], inputs.w[steps][at], y[at])
    return magnitude


def largest(matrices: Array) -> Array:
    """Square root of the largest eigenvalue of each symmetric matrix, nan where it is not finite."""
    finite = np.isfinite(matrices).all(axis=(1, 2))
    largest = np.full(len(matrices), np.nan)
    largest[finite] = np.sqrt(np.maximum(np.linalg.eigvalsh(matrices[finite])[:, -1], 0.0))
    return largest
