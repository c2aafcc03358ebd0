"""Filters run by (1)-(5) on unit vectors, through every outcome of loss and delivery: shares no code with designer/."""

from __future__ import annotations

from functools import cache
from itertools import product
from typing import NamedTuple

import numpy as np

from agent.contract.gains import Gains
from agent.contract.problem.matrices import Matrices, matrices_of

Array = np.ndarray


class Outcomes(NamedTuple):
    """Every theta and phi of a step, and what leads from [x; e; w] to [x; e] where they come about."""

    arrived: Array  # (outcomes, n)
    delivered: Array  # (outcomes, n, n): 1 where nobody is asked
    G: Array  # (outcomes, n_eta, n_eta + nw)


def outcomes(gains: Gains, mode: str, real: Matrices | None = None) -> Outcomes:
    """Of a step in this mode; the filters use the arrival probabilities and the C of the file, whatever is `real`."""
    return _as_told(gains, mode) if real is None else _outcomes(gains, mode, real)


@cache
def _as_told(gains: Gains, mode: str) -> Outcomes:
    return _outcomes(gains, mode, matrices_of(gains.problem))


def _outcomes(gains: Gains, mode: str, real: Matrices) -> Outcomes:
    problem, names = gains.problem, gains.problem.node_names
    nx, nw, n = problem.nx, problem.nw, problem.n
    unit = np.eye(nx + n * nx + nw)
    x, w = unit[:nx], unit[nx + n * nx :]
    x_hat = [x - unit[nx + i * nx : nx + (i + 1) * nx] for i in range(n)]
    x_next = real.A @ x + real.B @ w
    s = problem.mode_index(mode)
    pairs = [(i, j) for i in range(n) for j in problem.neighbours(s, i) if i != j]
    found = []
    for arrived in product((0, 1), repeat=n):
        nu = []
        for theta, node, own, C, D in zip(arrived, problem.nodes, x_hat, real.C, real.D, strict=True):
            hidden = theta * (C @ x) + D @ w - node.arrival_probability * (node.C @ own)
            nu.append(theta * (C @ x - node.C @ own + D @ w) if node.seen else hidden)
        for of_pairs in product((0, 1), repeat=len(pairs)):
            phi, errors = np.ones((n, n)), []
            for at, got in zip(pairs, of_pairs, strict=True):
                phi[at] = got
            for i, name in enumerate(names):
                after = np.zeros_like(x)
                for j in problem.neighbours(s, i):
                    K, H = (letter[mode][name][names[j]] for letter in (gains.K, gains.H))
                    used = K @ x_hat[j] + H @ nu[j] if phi[i, j] else K @ x_hat[i]
                    after = after + problem.topologies[s].adjacency[i, j] * used
                errors.append(x_next - after)
            found.append((arrived, phi, np.vstack([x_next, *errors])))
    return Outcomes(*(np.array(part) for part in zip(*found, strict=True)))


def moment(gains: Gains, mode: str, beta: Array, rho: Array, Y_bar: Array, real: Matrices | None = None) -> Array:
    """E [x; e]'Y_bar[x; e] one step later, as a quadratic form in [x; e; w]; beta (n,) and rho (n, n) are the truth.

    A link that no step of this mode asks for counts as delivered, with probability 1.
    """
    arrived, delivered, G = outcomes(gains, mode, real)
    asked = (delivered == 0.0).any(axis=0)
    chance = np.where(arrived, beta, 1.0 - beta).prod(axis=1)
    chance = chance * np.where(asked, np.where(delivered, rho, 1.0 - rho), 1.0).prod(axis=(1, 2))
    return np.asarray(np.einsum("o,oij,oik->jk", chance, G, Y_bar @ G, optimize=True))
