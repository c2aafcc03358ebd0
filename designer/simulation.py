"""Thousands of runs at once, for the mean over runs that gamma is about.

Run r of an ensemble with base seed S has the draws of a live run with seed S + r (agent/contract/schedule.py), so its
numbers are those of that run's recording, but for rounding. What is simulated is the plant and the error of every
node, e_i = x - x_hat_i, as it follows from eqs. (1)-(5) with the losses and deliveries of the step itself:

    nu_j = theta_j C_j x + D_j w - beta_j C_j x_hat_j = beta_j C_j e_j + D_j w + (theta_j - beta_j) C_j x,
    nu_j = theta_j (C_j e_j + D_j w)                              where node j sees its losses,
    e_i+ = (A - sum_j a_ij K_ij) x + B w + sum_j a_ij (K_ij e_j - H_ij nu_j)
           + sum over lost messages of a_ij (K_ij (e_i - e_j) + H_ij nu_j).

e is not computed as x - x_hat: an unstable plant would leave nothing of it but the rounding of x. Where the gains are
unbiased, the first bracket is 0; where also every loss is seen, x is not needed and stays 0.

This shares no arithmetic with the error model of designer/model/error_model.py, nor with agent/filter.py.
docs/theory.md, section 8, says what the ensemble can show and what not.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agent.contract.arrays import Array
from agent.contract.errors import InputError
from agent.contract.gains import Gains
from agent.contract.problem.disturbance import White
from agent.contract.schedule import DELIVERIES, DISTURBANCE, LOSSES, MODES, DisturbanceSource, Stream, normal
from designer.gain.exact import Operator
from designer.gain.noise import steady_state
from designer.model.error_model import error_model, measurement_slices, model_of_gains, stacked_gains
from designer.start import left_by_start
from designer.workers import each

CONFIDENCE = 0.99  # that the intervals of all steps hold at once
CHUNK = 1024  # runs side by side; the figures do not depend on how many processes share the chunks
NUMBERS = 2**22  # drawn at once, about

Indices = NDArray[np.intp]


class LossyMessage(NamedTuple):
    """What node i hears from node j in one mode, over a link that loses messages."""

    link: int  # its place in the problem's list
    i: slice  # of e
    j: slice
    y_j: slice  # of the innovations
    K: Array  # a_ij K_ij, (nx, nx)
    H: Array  # a_ij H_ij, (nx, ny_j)


@dataclass(frozen=True, eq=False)
class Network:
    """What a step needs, as arrays; measurements and errors of all nodes side by side, nodes in file order."""

    to_e: Array  # (modes, n nx, nx + n nx + sum ny + nw): from [x; e; nu; w], where every message arrives
    lossy: list[list[LossyMessage]]  # for each mode
    A: Array  # (nx, nx)
    B: Array  # (nx, nw)
    M: Array  # (nz, nx)
    weights: Array  # (n, 1)
    C: Array  # (sum ny, nx)
    Ce: Array  # (sum ny, n nx): diag{C_1, ..., C_n}
    D: Array  # (sum ny, nw)
    seen: NDArray[np.bool_]  # (sum ny,)
    owner: Indices  # (sum ny,): the node of each measurement
    carries_plant: bool
    beta: Array  # (n,)
    rho: Array  # (links,)
    cumulative: Array  # (modes, modes): Pi, summed along its rows
    initial: int
    x: Array  # (nx,): at the first step, and so are the errors
    w: Array | float  # w(0), w(1), ..., (steps, nw), or the deviation of white noise


class State(NamedTuple):
    """Where all runs are at one step."""

    mode: Indices  # (runs,): r(k)
    x: Array  # (runs, nx); stays 0 where the errors do not depend on it
    e: Array  # (runs, n nx)
    w: Array  # (runs, nw): w(k)


class Tally(NamedTuple):
    """|z_tilde(k)|^2 of some runs, at every step."""

    runs: int
    mean: Array  # (steps,)
    squares: Array  # (steps,): sum over the runs of the squared distances from the mean
    largest: Array  # (steps, some): the largest ones
    others: Array  # (steps,): sum of all the others
    inputs: Array  # (steps, nx + n nx + nw): sum over the runs of the squares of x, e and w
    peaks: Array  # (runs,): max over k of |z_tilde(k)|


@dataclass(frozen=True, eq=False)
class Ensemble:
    """What many runs say of sup_k E|z_tilde(k)|^2 <= gamma^2 energy. Arrays have one row for each step.

    [low, high] is the interval of the central limit theorem, with the deviation of the sample. Products of random
    matrices have heavy tails: where few runs carry most of the mean, a sample that lacks them has mean and deviation
    both too small. Where few runs are small, it is the lower end that is wrong. So nothing is refuted by it.

    `least` is a lower bound of E|z_tilde(k)|^2 for any number of runs and any distribution (Anderson 1969). The
    distribution function of the sample lies below the true one by more than sqrt(log(1 / d) / (2 runs)) anywhere with
    probability d at most (Dvoretzky, Kiefer, Wolfowitz; Massart). So the true mean is at least that of the sample in
    which so large a share of the runs, those with the largest values, count as 0. gamma is refuted where even that is
    above the bound.

    Both hold for all steps at once with the confidence CONFIDENCE: each step gets its share of what is left to 1.
    """

    gamma: float
    mean: Array  # over the runs of |z_tilde(k)|^2
    low: Array
    high: Array
    least: Array
    energy: Array  # mean energy of w before the step, known exactly
    rounding: Array  # sqrt E|z_tilde(k)|^2 that rounding may have made; 0 where nothing depends on it
    peaks: Array  # (runs,): max over k of |z_tilde(k)| of single runs
    start: float = 0.0  # sqrt E|z_tilde(k)|^2 that the initial error alone leaves at most

    @property
    def bound(self) -> Array:
        """gamma^2 energy; with an initial error (gamma sqrt(energy) + start)^2."""
        return np.asarray(
            (self.gamma * np.sqrt(self.energy) + self.start) ** 2 if self.start else self.gamma**2 * self.energy
        )

    @property
    def closest(self) -> int | None:
        """The step with the largest mean relative to the bound; None where w is 0."""
        before = int(np.argmax(self.energy > 0.0))  # the first steps, at which there is no energy yet
        if not self.energy[before] > 0.0:
            return None
        return before + int(np.argmax(self.mean[before:] / self.bound[before:]))

    @property
    def refuted_at(self) -> int | None:
        """The first step at which even `least` is above the bound, by more than rounding; None: there is none."""
        above = self.least > (np.sqrt(self.bound * (1.0 + 1e-9)) + self.rounding) ** 2
        return int(np.argmax(above)) if above.any() else None


def simulate(
    gains: Gains,
    *,
    runs: int,
    steps: int,
    seed: int = 0,
    w: Array | None = None,
    dask: str | None = None,
    processes: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> Ensemble:
    """`runs` runs of `steps` steps, seeds `seed`, `seed` + 1, ...; `w` (rows, nw) replaces the problem's disturbance.

    `dask` and `processes` as in designer/workers.py; `progress` is told after each part how many runs are done.
    """
    if runs < 2:
        raise InputError(f"runs is {runs}; an interval for the mean takes at least 2")
    network = network_of(gains, steps=steps, w=w)
    parts = [range(first, min(first + CHUNK, seed + runs)) for first in range(seed, seed + runs, CHUNK)]
    ignored = math.ceil(math.sqrt(runs * math.log(steps / (1.0 - CONFIDENCE)) / 2.0))
    found: Tally | None = None
    for part in each(partial(tally_runs, network, steps, ignored), parts, dask=dask, processes=processes):
        found = part if found is None else _together(found, part, ignored)
        if progress is not None:
            progress(found.runs)
    assert found is not None
    start = left_by_start(gains.problem, gains.K, gains.H) if network.x.any() else 0.0
    if start is None:
        raise InputError(f"what the initial error of {gains.problem.name} leaves at most is not proved")
    ensemble = _ensemble(gains.certificate.gamma, found, _energy(network, steps), start)
    if ensemble.refuted_at is None:
        return ensemble
    return replace(ensemble, rounding=_rounding(gains, network, found))


def steady(gains: Gains) -> float | None:
    """What E|z_tilde|^2 comes to under the problem's white noise; None: there is none, or the errors do not settle."""
    problem, model = gains.problem, model_of_gains(gains.problem, gains.K, gains.H)
    if not isinstance(problem.disturbance, White):
        return None
    found = steady_state(model, initial=problem.mode_index(problem.markov.initial))
    return None if found is None else problem.disturbance.deviation**2 * found.total


def network_of(gains: Gains, *, steps: int, w: Array | None = None) -> Network:
    """The arrays of a gains file; `w` (rows, nw), and 0 afterwards, takes the place of the problem's disturbance."""
    problem, plant = gains.problem, gains.problem.plant
    n, nx, modes, rows = problem.n, problem.nx, len(problem.topologies), measurement_slices(problem)
    K_bar, H_bar = stacked_gains(gains)
    bias = np.tile(plant.A, (n, 1)) - K_bar.reshape(modes, n * nx, n, nx).sum(axis=2)
    if problem.unbiased:
        bias = np.zeros_like(bias)
    Ce = np.zeros((rows[-1].stop, n * nx))
    for j, node in enumerate(problem.nodes):
        Ce[rows[j], j * nx : (j + 1) * nx] = node.C
    cumulative = np.cumsum(problem.markov.transition, axis=1)
    many = [len(node.C) for node in problem.nodes]
    return Network(
        to_e=np.concatenate([bias, K_bar, -H_bar, np.tile(plant.B, (modes, n, 1))], axis=2),
        lossy=_lossy_messages(gains, K_bar, H_bar, rows),
        A=plant.A,
        B=plant.B,
        M=plant.M,
        weights=problem.weights[:, None],
        C=np.vstack([node.C for node in problem.nodes]),
        Ce=Ce,
        D=np.vstack([node.D for node in problem.nodes]),
        seen=np.repeat([node.seen for node in problem.nodes], many),
        owner=np.repeat(np.arange(n), many),
        carries_plant=problem.carries_plant,
        beta=problem.beta,
        rho=np.array([link.delivery_probability for link in problem.links or ()]),
        cumulative=cumulative / cumulative[:, -1:],
        initial=problem.mode_index(problem.markov.initial),
        x=problem.initial_error,
        w=_disturbance(gains, steps) if w is None else _padded(w, steps),
    )


def _lossy_messages(gains: Gains, K_bar: Array, H_bar: Array, rows: list[slice]) -> list[list[LossyMessage]]:
    problem, nx = gains.problem, gains.problem.nx
    messages: list[list[LossyMessage]] = [[] for _ in problem.topologies]
    for number, link in enumerate(problem.links or ()):
        i, j = problem.node_index(link.receiver), problem.node_index(link.sender)
        at_i, at_j = slice(i * nx, (i + 1) * nx), slice(j * nx, (j + 1) * nx)
        for s, found in enumerate(messages):
            if j in problem.neighbours(s, i):
                K, H = K_bar[s, at_i, at_j], H_bar[s, at_i, rows[j]]
                found.append(LossyMessage(number, at_i, at_j, rows[j], K, H))
    return messages


def _rounding(gains: Gains, network: Network, found: Tally) -> Array:
    """What rounding may have made of sqrt E|z_tilde(k)|^2 at most, (steps,), from the sizes of what was added up.

    Entry i of [x; e] is off by d_i(j) in step j, |d_i(j)| <= m u times the sum of the absolute values that it is made
    of, m the number of roundings on the way of a term. What is left of d(j) in z_tilde(k) has no more than n_eta times
    the sum of L^(k-1-j)(M'M)_ii E d_i(j)^2 for its mean square (Cauchy and Schwarz), since what is drawn after step j
    does not depend on d(j); and roots of mean squares add up at most (Minkowski).
    """
    model = error_model(gains.problem, *stacked_gains(gains))
    operator, steps = Operator(model), len(found.mean)
    with np.errstate(over="ignore", invalid="ignore"):
        off = _added_up(network, np.sqrt(found.inputs / found.runs))[:, -model.size :] * _roundings(network) * 2.0**-53
        Y, left = np.asarray(operator.MM), np.zeros(steps)
        for m in range(steps - 1):
            weights = model.size * Y.diagonal(axis1=1, axis2=2).max(axis=0)
            left[m + 1 :] += np.sqrt(off[: steps - 1 - m] ** 2 @ weights)
            Y = operator.corner(Y)
    return np.where(np.isnan(left), np.inf, left)


def _added_up(network: Network, sizes: Array) -> Array:
    """The root mean square of the absolute values that add up to [x; e] in a step, (steps, nx + n nx), at most.

    `sizes` (steps, nx + n nx + nw): the roots of the mean squares of x, e and w.
    """
    nx, n_e = len(network.A), network.Ce.shape[1]
    x, e, w = sizes[:, :nx], sizes[:, nx : nx + n_e], sizes[:, nx + n_e :]
    nu = x @ np.abs(network.C).T + e @ np.abs(network.Ce).T + w @ np.abs(network.D).T
    of_e = np.hstack([x, e, nu, w]) @ np.abs(network.to_e).max(axis=0).T
    for message in (message for of_mode in network.lossy for message in of_mode):
        both = e[:, message.i] + e[:, message.j]
        of_e[:, message.i] += both @ np.abs(message.K).T + nu[:, message.y_j] @ np.abs(message.H).T
    return np.hstack([x @ np.abs(network.A).T + w @ np.abs(network.B).T, of_e])


def _roundings(network: Network) -> int:
    """That a term meets at most: in nu, in the sum for e, in what lost messages add, and in the numbers themselves."""
    return 2 * int(network.to_e.shape[2]) + 3 * max(map(len, network.lossy)) + 10


def _disturbance(gains: Gains, steps: int) -> Array | float:
    """What the problem says of w: all of it, or the deviation of white noise."""
    if isinstance(gains.problem.disturbance, White):
        return gains.problem.disturbance.deviation
    source = DisturbanceSource(gains.problem, seed=0, worst_case=gains.worst_case)  # no chance in it: any seed will do
    return np.array([source.at(k) for k in range(steps)]).reshape(steps, -1)


def _padded(w: Array, steps: int) -> Array:
    padded = np.zeros((steps, w.shape[1]))
    padded[: len(w)] = w[:steps]
    return padded


def _energy(network: Network, steps: int) -> Array:
    """E sum over j < k of |w(j)|^2, (steps,)."""
    if isinstance(network.w, float):
        return np.asarray(network.w**2 * network.B.shape[1] * np.arange(steps))
    return np.asarray(np.concatenate([[0.0], np.cumsum((network.w**2).sum(axis=1))[:-1]]))


def tally_runs(network: Network, steps: int, ignored: int, seeds: Sequence[int]) -> Tally:
    """|z_tilde(k)|^2 = sum over nodes of |weight M e_i(k)|^2 in runs with these seeds; `ignored` are set apart."""
    runs, nx, ignored = len(seeds), len(network.A), min(ignored, len(seeds))
    mean, squares, others, peaks = np.empty(steps), np.empty(steps), np.empty(steps), np.zeros(runs)
    inputs = np.empty((steps, nx + network.Ce.shape[1] + network.B.shape[1]))
    largest = np.empty((steps, ignored))
    with np.errstate(over="ignore", invalid="ignore"):  # errors may grow beyond float64, and count as infinite
        for k, state in enumerate(states(network, seeds, steps=steps)):
            size = ((state.e.reshape(runs, -1, nx) @ network.M.T * network.weights) ** 2).reshape(runs, -1).sum(axis=1)
            size[np.isnan(size)] = np.inf
            np.maximum(peaks, size, out=peaks)
            mean[k] = size.mean()
            squares[k] = ((size - mean[k]) ** 2).sum()
            largest[k], others[k] = _set_apart(size, ignored)
            inputs[k] = np.concatenate([(part**2).sum(axis=0) for part in state[1:]])
    return Tally(runs, mean, squares, largest, others, inputs, np.sqrt(peaks))


def _set_apart(sizes: Array, many: int) -> tuple[Array, Array]:
    """Of sizes (..., runs) the `many` largest ones, (..., many), and the sum of the others, (...)."""
    first = max(0, sizes.shape[-1] - many)
    ordered = np.partition(sizes, first, axis=-1) if first else sizes
    return ordered[..., first:], ordered[..., :first].sum(axis=-1)


def _together(one: Tally, other: Tally, ignored: int) -> Tally:
    """The tally of both, by the formula of Chan, Golub and LeVeque for the squared distances."""
    with np.errstate(over="ignore", invalid="ignore"):
        runs, gap = one.runs + other.runs, other.mean - one.mean
        largest, others = _set_apart(np.hstack([one.largest, other.largest]), ignored)
        return Tally(
            runs,
            one.mean + gap * (other.runs / runs),
            one.squares + other.squares + gap**2 * (one.runs * other.runs / runs),
            largest,
            one.others + other.others + others,
            one.inputs + other.inputs,
            np.concatenate([one.peaks, other.peaks]),
        )


def states(network: Network, seeds: Sequence[int], *, steps: int) -> Iterator[State]:
    """The states of steps 0, 1, ..., steps - 1 of the runs with these seeds, from the initial error on."""
    runs, owner, hidden = len(seeds), network.owner, ~network.seen
    r = np.full(runs, network.initial)
    x = np.tile(network.x, (runs, 1))
    e = np.tile(x, network.Ce.shape[1] // x.shape[1])
    for mode_draw, theta, delivered, w in _draws(network, seeds, steps):
        yield State(r, x, e, w)
        arrived = theta[:, owner].astype(np.float64)
        beta = network.beta[owner]
        nu = np.where(network.seen, arrived, beta) * (e @ network.Ce.T)
        nu += np.where(network.seen, arrived, 1.0) * (w @ network.D.T)
        nu += hidden * (arrived - beta) * (x @ network.C.T)
        inputs = np.hstack([x, e, nu, w])
        e_next = np.empty_like(e)
        for s in np.unique(r):
            at = np.flatnonzero(r == s)
            e_next[at] = inputs[at] @ network.to_e[s].T
            for message in network.lossy[s]:
                lost = at[~delivered[at, message.link]]
                e_i, e_j = e[lost, message.i], e[lost, message.j]
                e_next[lost, message.i] += (e_i - e_j) @ message.K.T + nu[lost, message.y_j] @ message.H.T
        if network.carries_plant:
            x = x @ network.A.T + w @ network.B.T
        e = e_next
        r = (network.cumulative[r] <= mode_draw).sum(axis=1)


class Draws(NamedTuple):
    """What chance, or the problem, gives all runs for one step."""

    mode: Array  # (runs, 1), in [0, 1)
    theta: NDArray[np.bool_]  # (runs, n)
    delivered: NDArray[np.bool_]  # (runs, links)
    w: Array  # (runs, nw)


def _draws(network: Network, seeds: Sequence[int], steps: int) -> Iterator[Draws]:
    """The draws of the runtime for these seeds, step after step."""
    n, links, nw = len(network.beta), len(network.rho), network.B.shape[1]
    white = isinstance(network.w, float)
    widths = {MODES: 1, LOSSES: n, DELIVERIES: links, DISTURBANCE: 2 * nw if white else 0}
    streams = {
        stream: [Stream(seed=seed, stream=stream, width=width) for seed in seeds] for stream, width in widths.items()
    }
    block = max(1, NUMBERS // (len(seeds) * sum(widths.values())))
    for first in range(0, steps, block):
        many = min(block, steps - first)
        uniform = {
            stream: np.stack([one.uniform(first, many) for one in streams[stream]], axis=1)  # (many, runs, width)
            if width
            else np.empty((many, len(seeds), 0))
            for stream, width in widths.items()
        }
        for k in range(many):
            if isinstance(network.w, float):
                w = network.w * normal(uniform[DISTURBANCE][k])
            else:
                w = np.tile(network.w[first + k], (len(seeds), 1))
            yield Draws(uniform[MODES][k], uniform[LOSSES][k] < network.beta, uniform[DELIVERIES][k] < network.rho, w)


def _ensemble(gamma: float, found: Tally, energy: Array, start: float = 0.0) -> Ensemble:
    runs, steps = found.runs, len(found.mean)
    quantile = NormalDist().inv_cdf(1.0 - (1.0 - CONFIDENCE) / (2.0 * steps))
    with np.errstate(over="ignore", invalid="ignore"):
        half = quantile * np.sqrt(found.squares / (runs - 1) / runs)
        mean = np.where(np.isnan(found.mean), np.inf, found.mean)
        low = np.where(np.isnan(half), 0.0, np.maximum(mean - half, 0.0))
        high = np.where(np.isnan(half), np.inf, mean + half)
    return Ensemble(gamma, mean, low, high, found.others / runs, energy, np.zeros(steps), found.peaks, start)
