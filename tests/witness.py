"""A second opinion on everything that is said of gains, sharing no code with `designer/`.

The filters are run on unit vectors, with every outcome of losses and deliveries in turn: that gives the linear maps of
the whole network's error, each with its probability. All else is made of these maps: no mean, no variance, no eq. (10).
"""

from __future__ import annotations

from functools import cached_property
from itertools import product
from typing import Any, NamedTuple

import numpy as np

Array = np.ndarray
Document = dict[str, Any]


class Outcome(NamedTuple):
    """What may happen in a step, and what it makes of [eta; w]."""

    probability: float
    V: Array  # (n_eta, n_eta + nw)


class Network:
    """The plant and the filters of a problem document, with K and H, {mode: {i: {j: rows}}}."""

    def __init__(self, problem: Document, K: Document, H: Document) -> None:
        self.A, self.B, self.M = (np.array(problem["plant"][letter]) for letter in "ABM")
        self.nodes, self.K, self.H = problem["node"], K, H
        self.names = [node["name"] for node in self.nodes]
        self.adjacency = {mode["name"]: mode["adjacency"] for mode in problem["topology"]}
        self.rho = {
            (link["receiver"], link["sender"]): link["delivery_probability"] for link in problem.get("link", ())
        }
        self.seen = {node["name"]: node.get("loss") == "seen" for node in self.nodes}
        self.beta = {node["name"]: node["arrival_probability"] for node in self.nodes}
        hidden = any(self.beta[i] < 1.0 and not self.seen[i] for i in self.names)
        self.plant_counts = hidden or not problem.get("unbiased")
        self.nx, self.nw = self.B.shape
        self.size = self.nx * (len(self.names) + self.plant_counts)
        self.Pi = np.array(problem["markov"]["transition"])
        self.first = list(self.adjacency).index(problem["markov"]["initial"])

    def innovation(self, node: Document, arrived: bool, x: Array, x_hat: Array, w: Array) -> Array:
        """What node j takes from its measurement; nothing where it sees that there is none."""
        C, D = np.array(node["C"]), np.array(node["D"])
        if node.get("loss") == "seen":
            return arrived * (C @ x + D @ w - C @ x_hat)
        return arrived * (C @ x) + D @ w - node["arrival_probability"] * (C @ x_hat)

    def step(self, mode: str, arrived: dict, delivered: dict, x: Array, x_hats: dict, w: Array) -> tuple[Array, dict]:
        """Eqs. (1), (4) and (5); who misses a message takes its own estimate for it, and no innovation."""
        nu = {
            node["name"]: self.innovation(node, arrived[node["name"]], x, x_hats[node["name"]], w)
            for node in self.nodes
        }
        following = {}
        for i, weights in zip(self.names, self.adjacency[mode], strict=True):
            following[i] = np.zeros(self.nx)
            for j, a_ij in zip(self.names, weights, strict=True):
                if a_ij == 0.0:
                    continue
                K_ij, H_ij = np.array(self.K[mode][i][j]), np.array(self.H[mode][i][j])
                if delivered.get((i, j), True):
                    following[i] = following[i] + a_ij * (K_ij @ x_hats[j] + H_ij @ nu[j])
                else:
                    following[i] = following[i] + a_ij * (K_ij @ x_hats[i])
        return self.A @ x + self.B @ w, following

    def moved(self, mode: str, arrived: dict, delivered: dict, at: Array) -> Array:
        """eta one step after [eta; w], by running the filters."""
        x = at[: self.nx] if self.plant_counts else np.zeros(self.nx)
        e = at[self.size - self.nx * len(self.names) : self.size].reshape(-1, self.nx)
        x_hats = {name: x - e_i for name, e_i in zip(self.names, e, strict=True)}
        x_next, following = self.step(mode, arrived, delivered, x, x_hats, at[self.size :])
        errors = [x_next - following[name] for name in self.names]
        return np.concatenate([x_next] * self.plant_counts + errors)

    @cached_property
    def outcomes(self) -> list[list[Outcome]]:
        """Of every mode, all that may happen in it."""
        return [self._outcomes(mode, adjacency) for mode, adjacency in self.adjacency.items()]

    def _outcomes(self, mode: str, adjacency: list[list[float]]) -> list[Outcome]:
        used = [
            (i, j)
            for i, weights in zip(self.names, adjacency, strict=True)
            for j, a_ij in zip(self.names, weights, strict=True)
            if a_ij > 0.0 and (i, j) in self.rho
        ]
        chances = [*self.beta.values(), *(self.rho[pair] for pair in used)]
        found = []
        for happens in product((True, False), repeat=len(chances)):
            probability = np.prod([p if yes else 1.0 - p for p, yes in zip(chances, happens, strict=True)])
            if probability > 0.0:
                arrived = dict(zip(self.names, happens[: len(self.names)], strict=True))
                delivered = dict(zip(used, happens[len(self.names) :], strict=True))
                units = np.eye(self.size + self.nw)
                V = np.array([self.moved(mode, arrived, delivered, unit) for unit in units]).T
                found.append(Outcome(float(probability), V))
        return found

    def quadratic(self, Y: Array) -> Array:
        """E eta(k+1)'Y(r(k+1))eta(k+1) as a form in [eta; w], for every mode; Y (modes, n_eta, n_eta)."""
        return np.array(
            [
                sum(p * V.T @ np.tensordot(row, Y, 1) @ V for p, V in outcomes)
                for row, outcomes in zip(self.Pi, self.outcomes, strict=True)
            ]
        )

    def peak(self, node: int | None = None) -> Array:
        """|z_tilde|^2, or that of one node, as a form in eta, for every mode."""
        weight = np.zeros((self.size, self.size))
        counts = [node.get("weight", 1.0) for node in self.nodes]
        for i in range(len(self.names)):
            if node in (None, i):
                rows = slice(
                    self.size - (len(self.names) - i) * self.nx, self.size - (len(self.names) - i - 1) * self.nx
                )
                weight[rows, rows] = (counts[i] * self.M).T @ (counts[i] * self.M)
        return np.array([weight] * len(self.Pi))

    @cached_property
    def growth(self) -> Array:
        """Second moments of eta one step on, column by column: X (modes, n_eta, n_eta) without w, as a matrix."""
        modes, n = len(self.Pi), self.size
        blocks = [sum(p * np.kron(V[:, :n], V[:, :n]) for p, V in outcomes) for outcomes in self.outcomes]
        return np.block([[self.Pi[s, t] * blocks[s] for s in range(modes)] for t in range(modes)])

    @property
    def radius(self) -> float:
        """What E|eta|^2 is multiplied by in each step, in the long run."""
        return float(np.abs(np.linalg.eigvals(self.growth)).max())

    def noise(self) -> list[float]:
        """E|z - z_hat_i|^2 of every node in the steady state under white w of unit covariance."""
        modes, n = len(self.Pi), self.size
        long_run = np.linalg.matrix_power((self.Pi + np.eye(modes)) / 2.0, 2**20)[self.first]
        fresh = [sum(p * V[:, n:] @ V[:, n:].T for p, V in outcomes) for outcomes in self.outcomes]
        right = [sum(self.Pi[s, t] * long_run[s] * fresh[s] for s in range(modes)) for t in range(modes)]
        X = np.linalg.solve(np.eye(modes * n * n) - self.growth, np.array(right).reshape(-1)).reshape(modes, n, n)
        return [float((self.peak(i) * X).sum()) for i in range(len(self.names))]

    def invariant(self) -> Array:
        """P > 0 with (17), (modes, n_eta, n_eta)."""
        modes, n = len(self.Pi), self.size
        units = np.array([np.eye(n)] * modes).reshape(-1)
        Z = np.linalg.solve(np.eye(modes * n * n) - self.growth.T, units).reshape(modes, n, n)
        Z = (Z + Z.swapaxes(1, 2)) / 2.0
        S = self.quadratic(Z)
        rest = Z - S[:, :n, :n]
        most = max(
            np.linalg.eigvalsh(S_s[n:, n:] + S_s[n:, :n] @ np.linalg.solve(rest_s, S_s[:n, n:]))[-1]
            for S_s, rest_s in zip(S, rest, strict=True)
        )
        return Z / (1.001 * most)

    def slack(self, P: Array) -> float:
        """The least eigenvalue of diag{P(s), I} - S(P)(s), (17)."""
        S = self.quadratic(P)
        whole = [
            np.block([[P_s, np.zeros((self.size, self.nw))], [np.zeros((self.nw, self.size)), np.eye(self.nw)]])
            for P_s in P
        ]
        return min(float(np.linalg.eigvalsh(whole_s - S_s)[0]) for whole_s, S_s in zip(whole, S, strict=True))

    def bounds(self, gamma: float, *, node: int | None = None, steps: int = 3000) -> bool | None:
        """Whether gamma bounds the peak for ever: a W fails, or the recursion ends in the set of P; None: neither."""
        n, g, Y, P = self.size, gamma**2, self.peak(node), self.invariant()
        for _ in range(steps):
            if min(np.linalg.eigvalsh(g * P - Y)[:, 0]) > 0.0:
                return True
            S = self.quadratic(Y)
            W = g * np.eye(self.nw) - S[:, n:, n:]
            if np.linalg.eigvalsh(W)[:, 0].min() <= 0.0:
                return False
            Y = S[:, :n, :n] + S[:, :n, n:] @ np.linalg.solve(W, S[:, n:, :n])
        return None

    def fixed(self, steps: int) -> float:
        """The largest E|z_tilde|^2 after so many steps, for a w of energy 1 fixed beforehand: over every path."""
        total = np.zeros((steps * self.nw, steps * self.nw))
        weight = self.peak()[0]

        def walk(k: int, mode: int, probability: float, carried: Array) -> None:
            if k == steps:
                total[:] += probability * carried.T @ weight @ carried
                return
            at = np.zeros((self.nw, steps * self.nw))
            at[:, k * self.nw : (k + 1) * self.nw] = np.eye(self.nw)
            for p, V in self.outcomes[mode]:
                after = V @ np.vstack([carried, at])
                for following, pi in enumerate(self.Pi[mode]):
                    walk(k + 1, following, probability * p * pi, after)

        walk(0, self.first, 1.0, np.zeros((self.size, steps * self.nw)))
        return float(np.linalg.eigvalsh(total)[-1])
