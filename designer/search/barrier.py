"""The log-det barrier of the exact gain over a horizon T, a smooth function of the gains; and its gradient.

With y = log g,

    J(K, H, y) = y - mu sum over steps and modes of log det (I - B'Y_bar B / g) + kappa tr(X_0 Y_T) / g

is finite exactly where gamma_T^2 < g, and costs one sweep and one covariance: gamma_T itself is never searched for.
B'Y_bar B is the block of w in `Operator.joint`. The last term, with X_0 the identity in natural units and kappa small,
is what an error at the start of the horizon still weighs at its end: without it, what grows slowly costs nothing
within T. docs/theory.md, section 6. Of several models, J has the sum of theirs, and is finite where each of their
gamma_T^2 is below g.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agent.contract.arrays import Array
from agent.contract.problem import Problem
from designer.gain.exact import Operator
from designer.gain.noise import long_run
from designer.gain.sensitivity import Inputs, Slope, Sweep, slope, sweep
from designer.model.error_model import ErrorModel, Indices
from designer.model.units import natural_units
from designer.search import bfgs
from designer.search.entries import Entries
from designer.search.starts import node_regression

_DAMPING = 0.1  # added to a Hessian with 1 on its diagonal: only part of the Hessian is known
_KAPPA = 1e-5  # of the descent: its part of gamma is not seen
_KAPPA_OF_CENTRE = 1.0  # as if what is left at the end were one step more
_FLAT = 1e-12  # a curvature in y below this is none


class _Node(NamedTuple):
    """What the gains of one node multiply in one mode."""

    mean: Array  # (q, c)
    noises: list[Array]
    at: Indices  # of its gains in the vector
    part: slice  # of the moments that are asked for: those of its c entries of [eta; w]


class Blocks:
    """A block-diagonal symmetric matrix, blocks of one size together; the identity elsewhere."""

    def __init__(self, blocks: list[tuple[Indices, Array]], last: float | None) -> None:
        sizes = {len(at) for at, _ in blocks}
        self._alike = [
            tuple(map(np.array, zip(*((at, B) for at, B in blocks if len(at) == size), strict=True))) for size in sizes
        ]
        self._last = last

    def __call__(self, q: Array) -> Array:
        """Times a vector."""
        product = q.copy()
        for at, matrices in self._alike:
            product[at] = (matrices @ q[at][:, :, None])[:, :, 0]
        if self._last is not None:
            product[-1] *= self._last
        return product


class Barrier:
    """J and what it is made of, for one problem; x = [v; y] holds the gains' entries and y = log g.

    `models`: what the same gains may meet beside the problem itself. `held`: as `Entries` takes it.
    """

    def __init__(
        self,
        problem: Problem,
        horizon: int,
        models: Sequence[Inputs] = (),
        *,
        held: NDArray[np.bool_] | None = None,
    ) -> None:
        self.problem, self.horizon = problem, horizon
        self.entries, self.inputs = Entries(problem, held), Inputs(problem)
        self.models = [self.inputs, *models]
        self.size, self._units = problem.plant_states + problem.n * problem.nx, natural_units(problem).state
        self._nodes, self._moments = self._heard()
        self._initial = problem.mode_index(problem.markov.initial)

    def model(self, v: Array) -> ErrorModel:
        """The error model of the gains v."""
        return self.inputs.model(*self.entries.unpack(v))

    def operator(self, v: Array) -> Operator:
        """The same, in the shapes of the recursions."""
        return Operator(self.model(v), self.inputs.pattern)

    def descent(self, mu: float) -> bfgs.Function:
        """J(v, y), whose minimum goes to that of log gamma_T^2 as mu goes to 0, but for kappa."""

        def J(x: Array) -> tuple[float, Array]:
            value, gradient = self._inside(x, _KAPPA / mu)
            gradient *= mu
            gradient[-1] += 1.0
            return float(x[-1]) + mu * value, gradient

        return J

    def centre(self, y: float, ridge: float) -> bfgs.Function:
        """The same with g held, and the size of the gains in place of y: -sum of log det + ridge |v|^2 / 2.

        The sum is least where the responses of all horizons together are small: for gains that decay fast. What is
        left at the end of the horizon is as in J, with much more weight.
        """

        def J(v: Array) -> tuple[float, Array]:
            value, gradient = self._inside(np.append(v, y), _KAPPA_OF_CENTRE)
            return ridge / 2.0 * float(v @ v) + value, ridge * v + gradient[:-1]

        return J

    def noise(self, y: float, mu: float) -> bfgs.Function:
        """log E|z_tilde|^2 under white w of unit covariance, after the horizon, plus mu times J's barrier at g = e^y.

        The covariance of eta that w of steps before the horizon leaves is not there.
        """

        def J(v: Array) -> tuple[float, Array]:
            value, gradient = self._inside(np.append(v, y), _KAPPA / mu)
            if math.isinf(value):
                return value, gradient[:-1]
            model, operator = self.model(v), self.operator(v)
            swept, V, noise = self._noisy(operator)
            slopes = slope(model, operator, self.inputs, swept, V)
            by_gains = self.entries.pack_slope(slopes.K_bar, slopes.H_bar)
            return math.log(noise) + mu * value, by_gains / noise + mu * gradient[:-1]

        return J

    def noise_of(self, v: Array) -> float:
        """E|z_tilde|^2 after the horizon, of the gains v under white w of unit covariance."""
        return self._noisy(self.operator(v))[2]

    def _noisy(self, operator: Operator) -> tuple[Sweep, Array, float]:
        """The recursion where w is not the worst one but white: its steps, what is put in at each, and E|z_tilde|^2."""
        often = long_run(operator.transition, self._initial)
        Y, noise, Y_bars = operator.MM, 0.0, []
        for _ in range(self.horizon):
            Y_bars.append(operator.bar(Y))
            S = operator.joint(Y_bars[-1])
            noise += float(often @ np.trace(S[:, operator.size :, operator.size :], axis1=1, axis2=2))
            Y = S[:, : operator.size, : operator.size]
        shape = (self.horizon, len(often), operator.nw)
        none = np.zeros((*shape, operator.nw))
        swept = Sweep(np.array(Y_bars), np.zeros((*shape, operator.size)), none, 0.0, Y)
        return swept, none + often[:, None, None] * operator.eye_w, noise

    def inverse_hessian(self, x: Array, mu: float, *, ridge: float = 0.0) -> bfgs.Map:
        """Where the search begins: the inverse of part of the Hessian of J + ridge |v|^2 / 2 by [v; y].

        The part is what remains if Y_bar and the moments of [eta; w] do not move with the gains, and of that a block
        for each mode and node: the sum over steps of 2 mu Y_bar (x) E r r', r being what K_ij and H_ij multiply; and
        by y the sum of mu tr(W^-2 - W^-1), W = I - B'Y_bar B / g. Other units of x and y scale it as they scale v, so
        the steps do not depend on them. Without an entry for y, for x = v, where ridge is not 0.
        """
        found = self._swept(self.inputs, x, 0.0, moments=True)
        if found is None:
            return Blocks([], None)
        swept, slopes = found
        known = self._known(swept, slopes, mu)
        W = swept.W_inverse * math.exp(x[-1])
        curvature = mu * float(np.trace(W @ W - W, axis1=2, axis2=3).sum())
        return self._inverse(known, ridge, None if ridge else 1.0 / max(curvature, _FLAT))

    def inverse_hessian_of_noise(self, v: Array, y: float, mu: float) -> bfgs.Map:
        """The same of `noise`, by v."""
        swept, V, value = self._noisy(self.operator(v))
        slopes = slope(self.model(v), self.operator(v), self.inputs, swept, V, entries=self._moments)
        found = self._swept(self.inputs, np.append(v, y), 0.0, moments=True)
        if found is None:
            return Blocks([], None)
        both = zip(self._known(swept, slopes, 1.0 / value), self._known(*found, mu), strict=True)
        return self._inverse([noise + inside for noise, inside in both], 0.0, None)

    def _known(self, swept: Sweep, slopes: Slope, mu: float) -> list[Array]:
        """By node as `_nodes` has them, the sum over steps of 2 mu Y_bar (x) E r r', by the node's part of v."""
        assert slopes.moments is not None
        found = []
        for (s, i), node in self._nodes.items():
            first, c = self.inputs.p + i * self.problem.nx, node.mean.shape[1]
            rows, moments = slice(first, first + self.problem.nx), slopes.moments[:, node.part].reshape(-1, c, c)
            gram = node.mean @ moments @ node.mean.T + sum(V @ moments @ V.T for V in node.noises)
            known = 2.0 * mu * np.tensordot(swept.Y_bar[:, s, rows, rows], gram, (0, 0)).transpose(0, 2, 1, 3)
            units = self.entries.units[node.at]
            found.append(known.reshape(len(node.at), -1) * np.outer(units, units))
        return found

    def _inverse(self, known: list[Array], ridge: float, last: float | None) -> Blocks:
        """Of each block, damped."""
        blocks = []
        for node, part in zip(self._nodes.values(), known, strict=True):
            hessian = part + ridge * np.eye(len(node.at))
            roots = np.sqrt(np.where(hessian.diagonal() > 0.0, hessian.diagonal(), 1.0))
            sizes = np.outer(roots, roots)
            blocks.append((node.at, np.linalg.inv(hessian / sizes + _DAMPING * np.eye(len(node.at))) / sizes))
        return Blocks(blocks, last)

    def _inside(self, x: Array, kappa: float) -> tuple[float, Array]:
        """-sum of log det (I - B'Y_bar B / g) + kappa tr(X_0 Y_T) / g by [v; y]; infinite where gamma_T^2 >= g."""
        value, gradient = 0.0, np.zeros_like(x)
        for inputs in self.models:
            found = self._swept(inputs, x, kappa)
            if found is None:
                return math.inf, np.zeros_like(x)
            swept, slopes = found
            g, count = math.exp(x[-1]), math.prod(swept.W_inverse.shape[:3])
            traces = float(np.trace(swept.W_inverse, axis1=2, axis2=3).sum())
            late = kappa / g * float(np.vdot(self._X(inputs), swept.Y))
            by_gains = self.entries.pack_slope(slopes.K_bar, slopes.H_bar)
            value += late - swept.log_det
            gradient += np.append(by_gains, count - g * (traces - slopes.g) - late)
        return value, gradient

    def _swept(self, inputs: Inputs, x: Array, kappa: float, *, moments: bool = False) -> tuple[Sweep, Slope] | None:
        """The sweep of one model at [v; y] and the slopes of `_inside`; None where gamma_T^2 >= g."""
        v, y = x[:-1], float(x[-1])
        if abs(y) > 300.0 or np.abs(v).max() > 1e50:  # squares overflow
            return None
        model = inputs.model(*self.entries.unpack(v))
        operator = Operator(model, inputs.pattern)
        swept = sweep(operator, math.exp(y), self.horizon)
        if swept is None:
            return None
        X, entries = kappa * math.exp(-y) * self._X(inputs), self._moments if moments else None
        return swept, slope(model, operator, inputs, swept, swept.W_inverse, X=X, entries=entries)

    def _X(self, inputs: Inputs) -> Array:
        """X_0, (modes, n_eta, n_eta)."""
        units = np.tile(self._units, self.problem.n + (1 if inputs.p else 0))
        return np.broadcast_to(np.diag(units**2), (len(self.problem.topologies), len(units), len(units)))

    def _heard(self) -> tuple[dict[tuple[int, int], _Node], Indices]:
        """By (s, i), and which moments of [eta; w] they ask for together."""
        nodes: dict[tuple[int, int], _Node] = {}
        asked: list[Indices] = []
        first = 0
        for (s, i), at in self.entries.nodes.items():
            heard = node_regression(self.problem, s, i)
            c, both = heard.columns, heard.t.shape[1]
            asked.append(((s * both + c[:, None]) * both + c).reshape(-1))
            part = slice(first, first + len(c) ** 2)
            nodes[s, i] = _Node(heard.mean[:, c], [V[:, c] for V in heard.noises], at, part)
            first = part.stop
        return nodes, np.concatenate(asked)
