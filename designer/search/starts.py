"""Gains to start the descent from, made without a solver, for any size of network.

Kalman-consensus gains: in every mode node i predicts as if its neighbourhood never changed, by the Riccati equation
of the sensors that it hears, with lost measurements and messages taken as more noise; and it draws its estimate
towards those of its neighbours. For losses that are seen this Riccati equation is the one of intermittent
observations (Sinopoli et al., IEEE Transactions on Automatic Control 49(9), 2004), for a gain that is constant.

Gains of least variance: the same thought, but for the network as it is. The covariance of all errors under white w is
carried forward, and in every step each node takes the gains that leave the least mean square of its next error.
Where that covariance settles, the error system is mean-square stable, so these are a start for unstable plants too.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from agent.contract.arrays import Array
from agent.contract.problem import Problem
from designer.gain.exact import Operator
from designer.gain.sensitivity import Inputs
from designer.model.error_model import Indices, StackedGains, error_model, measurement_slices, rows_total
from designer.patience import look
from designer.search.entries import Entries

WEIGHT = 0.4  # of the neighbours' estimates together
_MOST_STEPS = 1000
_MOST_DOUBLINGS = 60  # 2^60 steps
_STEPS_OF_NETWORK = 300
_SETTLED_NETWORK = 1e-6
_RESTARTS = 0.01  # so that a mode that the chain leaves for ever has gains of its own too
_STIRRED = 1e-4  # white noise on every error, beside w: so that no direction goes unseen
_BOUNDLESS = 1e100


def consensus_gains(problem: Problem, *, weight: float = WEIGHT) -> StackedGains:
    """Kalman-consensus gains; the neighbours' estimates share `weight`.

    The blocks of each row of K_bar, a_ij K_ij, sum to A: the gains are unbiased.
    """
    nx, A, columns = problem.nx, problem.plant.A, measurement_slices(problem)
    K_bar = np.zeros((len(problem.topologies), problem.n * nx, problem.n * nx))
    H_bar = np.zeros((len(problem.topologies), problem.n * nx, rows_total(problem)))
    spread = _plant_covariance(problem) if problem.carries_plant else np.zeros((nx, nx))
    for s in range(len(problem.topologies)):
        for i in range(problem.n):
            heard, rows = problem.neighbours(s, i), slice(i * nx, (i + 1) * nx)
            others = len(heard) - 1
            for j in heard:
                share = 1.0 if not others else 1.0 - weight if j == i else weight / others
                K_bar[s, rows, j * nx : (j + 1) * nx] = share * A
            at = np.concatenate([np.arange(columns[j].start, columns[j].stop) for j in heard])
            H_bar[s][rows, at] = _predictor_gain(problem, i, heard, spread)
    return K_bar, H_bar


def diffusion_gains(problem: Problem) -> StackedGains:
    """Kalman filters that diffuse: each node corrects by its own measurement, then takes the mean of what it hears.

    Adapt and combine of Cattivelli and Sayed (IEEE Transactions on Automatic Control 55(9), 2010) without an exchange
    of measurements, with constant gains and equal shares c_ij: K_ij = c_ij A / a_ij, H_ij = c_ij L_j / a_ij, where L_j
    is the predictor gain of node j alone. The gains are unbiased.
    """
    nx, columns = problem.nx, measurement_slices(problem)
    K_bar = np.zeros((len(problem.topologies), problem.n * nx, problem.n * nx))
    H_bar = np.zeros((len(problem.topologies), problem.n * nx, rows_total(problem)))
    spread = _plant_covariance(problem) if problem.carries_plant else np.zeros((nx, nx))
    own = [_predictor_gain(problem, j, (j,), spread) for j in range(problem.n)]
    for s in range(len(problem.topologies)):
        for i in range(problem.n):
            heard, rows = problem.neighbours(s, i), slice(i * nx, (i + 1) * nx)
            for j in heard:
                K_bar[s, rows, j * nx : (j + 1) * nx] = problem.plant.A / len(heard)
                H_bar[s, rows, columns[j]] = own[j] / len(heard)
    return K_bar, H_bar


def _predictor_gain(problem: Problem, i: int, heard: tuple[int, ...], spread: Array) -> Array:
    """L = (A P C' + B D')(C P C' + D D' + losses)^-1 of the nodes `heard` by node i, (nx, their measurements).

    C and D stand for the means of what arrives, so with rho beta. What theta and phi do beside that is noise.
    """
    A, B, nodes = problem.plant.A, problem.plant.B, [problem.nodes[j] for j in heard]
    rho, beta = problem.delivery[i, list(heard)], problem.beta[list(heard)]
    mean_D = [b if node.seen else 1.0 for b, node in zip(beta, nodes, strict=True)]
    C = np.vstack([b * node.C for b, node in zip(beta, nodes, strict=True)])  # of the messages
    D = np.vstack([b * node.D for b, node in zip(mean_D, nodes, strict=True)])
    sizes = [len(node.C) for node in nodes]
    arrives, owner = np.repeat(rho, sizes), np.repeat(np.arange(len(nodes)), sizes)
    together = owner[:, None] == owner
    P, BB = B @ B.T, B @ B.T
    for _ in range(_MOST_STEPS):
        look()
        mean = C @ P @ C.T + D @ D.T
        innovation = arrives[:, None] * arrives * mean + (arrives * (1.0 - arrives)) * together * mean
        for j, node in enumerate(nodes):
            lost = node.C @ P @ node.C.T + node.D @ node.D.T if node.seen else node.C @ spread @ node.C.T
            rows = np.ix_(owner == j, owner == j)
            innovation[rows] += rho[j] * beta[j] * (1.0 - beta[j]) * lost
        cross = (A @ P @ C.T + B @ D.T) * arrives
        L = cross @ np.linalg.pinv(innovation, rcond=1e-10, hermitian=True)
        P_next = A @ P @ A.T + BB - L @ cross.T
        if np.abs(P_next - P).max() <= 1e-10 * np.abs(P).max() or np.abs(P_next).max() > _BOUNDLESS:
            break
        P = (P_next + P_next.T) / 2.0
    return np.asarray(L)


def _plant_covariance(problem: Problem) -> Array:
    """X = A X A' + B B': where white w keeps the plant; the sum by doubling, A is stable.

    Near radius 1 that overflows, or A does not decay as it is rounded: what there is before is as good a guess.
    """
    power, X = problem.plant.A, problem.plant.B @ problem.plant.B.T
    for _ in range(_MOST_DOUBLINGS):
        X_next = X + power @ X @ power.T
        if np.abs(power).max() <= 1e-12 or not np.abs(X_next).max() < _BOUNDLESS:
            break
        X, power = X_next, power @ power
    return np.asarray(X)


def ignoring(problem: Problem) -> StackedGains:
    """K_ii = A and nothing else: no loss touches these, and they are stable where the plant is."""
    modes, rows = len(problem.topologies), rows_total(problem)
    K_bar = np.tile(np.kron(np.eye(problem.n), problem.plant.A), (modes, 1, 1))
    return np.asarray(K_bar), np.zeros((modes, problem.n * problem.nx, rows))


def least_variance_gains(problem: Problem, held: NDArray[np.bool_] | None = None) -> StackedGains:
    """Gains at which white w leaves each node the least mean square of e_i, given the others' gains.

    `held`: as `Entries` takes it.
    """
    modes, greedy = len(problem.topologies), Greedy(problem, held)
    chain = (1.0 - _RESTARTS) * problem.markov.transition + _RESTARTS / modes
    chain /= chain.sum(axis=1, keepdims=True)
    occupied = np.linalg.matrix_power((chain + np.eye(modes)) / 2.0, 2**20).mean(axis=0)
    size = problem.plant_states + problem.n * problem.nx
    fresh = _STIRRED * float((problem.plant.B**2).sum()) * occupied[:, None, None] * np.eye(size)
    X = fresh
    joint = np.zeros((modes, size + problem.nw, size + problem.nw))
    joint[:, size:, size:] = occupied[:, None, None] * np.eye(problem.nw)
    for _ in range(_STEPS_OF_NETWORK):
        look()
        joint[:, :size, :size] = X
        K_bar, H_bar = greedy.gains(joint)
        operator = greedy.operator(K_bar, H_bar)
        operator.transition = chain
        X_next = operator.carry(joint) + fresh
        change = np.abs(X_next - X).max()
        X = (X_next + X_next.swapaxes(1, 2)) / 2.0
        if change <= _SETTLED_NETWORK * np.abs(X).max() or np.abs(X).max() > _BOUNDLESS:
            break
    return K_bar, H_bar


class Greedy:
    """Gains that leave every node the least mean square of its next error, whatever the moments of [eta; w] are."""

    def __init__(self, problem: Problem, held: NDArray[np.bool_] | None = None) -> None:
        self.problem, self._entries, self._pattern = problem, Entries(problem, held), Inputs(problem).pattern
        self._batches = _batches(problem, self._entries)

    def gains(self, joint: Array) -> StackedGains:
        """`joint`: the moments of each mode, (modes, n_eta + nw, n_eta + nw)."""
        v = np.zeros(len(self._entries.units))
        for batch in self._batches:
            v[batch.at] = batch.best(joint)
        return self._entries.unpack(self._entries.in_units(v))

    def operator(self, K_bar: Array, H_bar: Array) -> Operator:
        return Operator(error_model(self.problem, K_bar, H_bar), self._pattern)


class _Batch(NamedTuple):
    """Regressions of one shape, m of them, each over the c entries of [eta; w] that it depends on."""

    at: Indices  # (m, nx q): where the vector of all gains has [K H]
    moments: Indices  # (m, c, c): of the moments of [eta; w] in all modes, flat
    t: Array  # (m, nx, c)
    mean: Array  # (m, q, c)
    noises: Array  # (m, noises, q, c)
    free: NDArray[np.bool_]  # (nx, q): which entries of [K H] are

    def best(self, joint: Array) -> Array:
        """[K H] = E[t r'] E[r r']^-1, (m, nx q), where [eta; w] has the covariance `joint` in each mode."""
        cov = joint.reshape(-1)[self.moments]
        mean_T = self.mean.swapaxes(1, 2)
        gram = self.mean @ cov @ mean_T
        gram += (self.noises @ cov[:, None] @ self.noises.swapaxes(2, 3)).sum(axis=1)
        sizes = np.diagonal(gram, axis1=1, axis2=2)
        scale = 1.0 / np.sqrt(np.where(sizes > 0.0, sizes, 1.0))
        across = self.t @ cov @ mean_T
        best = np.zeros_like(across)
        for free in np.unique(self.free, axis=0):  # of what is not free the pseudo-inverse has zeros
            rows, scaled = (self.free == free).all(axis=1), scale * free
            inverse = np.linalg.pinv(gram * scaled[:, None] * scaled[:, :, None], rcond=1e-10, hermitian=True)
            best[:, rows] = (across[:, rows] * scaled[:, None]) @ inverse * scaled[:, None]
        return np.asarray(best.reshape(self.at.shape))


def _batches(problem: Problem, entries: Entries) -> list[_Batch]:
    """The regressions of all nodes in all modes, those of one shape together."""
    found: dict[tuple[int, ...], list[tuple[Any, ...]]] = {}
    for (s, i), at in entries.nodes.items():
        regression = node_regression(problem, s, i)
        c, rows = regression.columns, np.array([s])
        both = regression.t.shape[1]
        moments = (rows[:, None] * both + c[:, None]) * both + c
        noises: Array = np.array([V[:, c] for V in regression.noises]).reshape(-1, len(regression.mean), len(c))
        parts: tuple[Any, ...] = (at, moments, regression.t[:, c], regression.mean[:, c], noises)
        found.setdefault(tuple(size for part in parts for size in part.shape), []).append(parts)
    batches = []
    for alike in found.values():
        at, moments, t, mean, noises = map(np.array, zip(*alike, strict=True))
        batches.append(_Batch(at, moments, t, mean, noises, entries.units[at[0]].reshape(problem.nx, -1) > 0.0))
    return batches


class Regression(NamedTuple):
    """e_i(k+1) = t - sum_j K_ij a_j - sum_j H_ij phi_ij nu_j of one node and mode, over [eta; w].

    The regressors are all a_j and phi_ij nu_j. Where gains are unbiased t = A e_i + B w and
    a_j = phi_ij (e_i - e_j), j != i; elsewhere t = A x + B w and a_j = phi_ij x_hat_j + (1 - phi_ij) x_hat_i.
    """

    t: Array  # (nx, n_eta + nw)
    mean: Array  # (regressors, n_eta + nw)
    noises: list[Array]  # what chance adds to the mean, each times something of variance 1

    @property
    def columns(self) -> Indices:
        """The entries of [eta; w] that it depends on."""
        return np.flatnonzero(np.vstack([self.t, self.mean, *self.noises]).any(axis=0))


def node_regression(problem: Problem, s: int, i: int) -> Regression:
    """What node i regresses its next error on, in mode s."""
    nx, plant, p = problem.nx, problem.plant, problem.plant_states
    heard, at_w, eye = problem.neighbours(s, i), p + problem.n * problem.nx, np.eye(problem.nx)
    others = [j for j in heard if not problem.unbiased or j != i]
    K = {j: slice(k * nx, (k + 1) * nx) for k, j in enumerate(others)}
    ends = len(others) * nx + np.cumsum([0, *(len(problem.nodes[j].C) for j in heard)])
    H = {j: slice(int(ends[k]), int(ends[k + 1])) for k, j in enumerate(heard)}

    def e(j: int) -> slice:
        return slice(p + j * nx, p + (j + 1) * nx)

    t = np.zeros((nx, at_w + problem.nw))
    t[:, e(i) if problem.unbiased else slice(p)], t[:, at_w:] = plant.A, plant.B
    mean, noises = np.zeros((int(ends[-1]), at_w + problem.nw)), []
    for j in heard:
        node, beta, rho = problem.nodes[j], problem.beta[j], problem.delivery[i, j]
        sent, lost = np.zeros_like(mean), np.zeros_like(mean)  # what phi_ij multiplies, and phi_ij (theta_j - beta_j)
        if j in K:
            if not problem.unbiased:
                mean[K[j], :p], mean[K[j], e(i)] = eye, -eye  # x_hat_i
            sent[K[j], e(i)] += eye
            sent[K[j], e(j)] -= eye
        sent[H[j], e(j)], sent[H[j], at_w:] = beta * node.C, (beta if node.seen else 1.0) * node.D
        if node.seen:
            lost[H[j], e(j)], lost[H[j], at_w:] = node.C, node.D
        elif beta < 1.0:
            lost[H[j], :p] = node.C
        mean += rho * sent
        noises += [np.sqrt(rho * (1.0 - rho)) * sent] if rho < 1.0 else []
        noises += [np.sqrt(rho * beta * (1.0 - beta)) * lost] if beta < 1.0 else []
    return Regression(t, mean, noises)
