"""A paced run as it really was: who used whose pair and whose measurement at every step, and who began again.

The matrices of each step are in `acting`. A node that begins again at step k has e_i(k) := e_j(k), or x(k) where it
begins with 0. Without a simulated plant the estimates are compared in place of the errors: x = 0, w = 0, e = -x_hat,
and - H_phi mu y comes in.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from agent.contract.arrays import Array
from agent.contract.keys import estimate
from designer.replay import free_run
from designer.replay.acting import Acting, with_plant, without_plant
from designer.replay.census import Place
from designer.replay.central import FLOOR, Central, Flags
from designer.replay.free_run import FreeBlock
from designer.replay.inputs import Drawn, Inputs, logged_plant, logged_states
from designer.replay.log import Log
from designer.replay.proofs import Check, names, numbers
from designer.replay.topics import Numbers


@dataclass(frozen=True, eq=False)
class Coupling:
    """What acted at each step; the last step's is what the seed and the events give, for no message tells it."""

    log: Log
    central: Central  # with x in the state wherever there is a simulated plant
    inputs: Inputs  # without holes
    used: Flags  # (steps, n, n): phi, row i for what node i used
    measured: Array  # (steps, n): mu
    hears: Numbers  # (steps, n): positions in `log.senders` of those that each node should have used
    unexplained: tuple[tuple[int, int], ...]  # (step, node): no event says why, for its process was killed
    unknown: Flags  # (steps, n): estimates of which nothing is concluded; used by others, and not recorded

    @classmethod
    def of(cls, log: Log, central: Central, inputs: Inputs, drawn: Drawn, hears: Numbers) -> Coupling:
        central = with_plant(central) if log.has_plant else without_plant(central)
        whole = free_run.complete(inputs, drawn, log, central)
        hears, unexplained = _less_substituted(log, hears)
        members = np.vstack([log.senders.members(), np.zeros((1, log.gains.problem.n), dtype=bool)])
        told = np.vstack([log.heard[1:], np.full((1, log.heard.shape[1]), -1)])
        went_on = np.vstack([log.origin[1:] == -1, np.ones((1, log.heard.shape[1]), dtype=bool)])
        used = members[np.where((told >= 0) & went_on, told, hears)]
        used = used | np.eye(log.gains.problem.n, dtype=bool)  # a node always hears itself
        seen = np.array([node.seen for node in log.gains.problem.nodes])
        lost = (log.told == 0) | (seen & (log.measured == 0.0))
        measured, unknown = np.where(lost, 0.0, 1.0), np.zeros(log.told.shape, dtype=bool)
        return cls(log, central, whole, used, measured, hears, tuple(sorted(unexplained)), unknown)

    def doubtful(self) -> Coupling:
        """The same, but nothing is concluded of estimates that others have used and that are not recorded.

        What they were made of went with them, so that the model may have another idea of them.
        """
        log, n = self.log, self.log.gains.problem.n
        members = np.vstack([log.senders.members(), np.zeros((1, n), dtype=bool)])
        told = np.vstack([np.where(log.origin[1:] == -1, log.heard[1:], -1), np.full((1, n), -1)])
        has_used = members[told].any(axis=1)  # (steps, n): by any node
        for step, i in np.argwhere((log.origin >= 0) & (log.origin < n)).tolist():
            has_used[step, log.origin[step, i]] = True
        return replace(self, unknown=self._perhaps_sent() & has_used)

    def _perhaps_sent(self) -> Flags:
        """(steps, n): estimates that others may have had; of a part of a recording, all that no absence explains."""
        log, estimates = self.log, 2 + 2 * np.arange(self.log.gains.problem.n)
        left_out = self.absent() & ~log.absences.excused[: log.steps, estimates] & log.is_part
        return np.asarray(log.absences.perhaps_sent[: log.steps] | left_out)

    def unknown_places(self) -> tuple[Place, ...]:
        """By step."""
        names = self.log.gains.problem.node_names
        return tuple(Place(estimate(names[i]), step) for step, i in np.argwhere(self.unknown).tolist())

    @cached_property
    def anchored(self) -> Flags:
        """(steps, n): estimates that depend on unknown ones; the model goes on from what is recorded of them."""
        log, n = self.log, self.log.gains.problem.n
        anchored, absent = np.zeros_like(self.unknown), self.absent()
        unknown = np.zeros(n, dtype=bool)  # of the step before
        for k in range(log.steps if self.unknown.any() else 0):
            depends = (self.used[k - 1] & unknown).any(axis=1) if k else unknown
            unknown = self.unknown[k] | (absent[k] & depends)
            origin = log.origin[k]
            begins = (origin != -1) & ~absent[k]
            from_unknown = begins & (origin < n) & unknown[np.clip(origin, 0, n - 1)]
            anchored[k] = (depends & ~begins & ~absent[k]) | from_unknown
        return anchored

    def absent(self) -> Flags:
        """(steps, n): the node's estimate of the step is not there."""
        return _absent(self.log)

    def keys(self, steps: range) -> list[tuple[int, bytes, bytes, bytes]]:
        inputs = self.inputs
        theta = inputs.theta * self.measured  # of what was not used, nothing depends
        return [
            (int(inputs.mode[k]), theta[k].tobytes(), self.used[k].tobytes(), self.measured[k].tobytes()) for k in steps
        ]

    @cached_property
    def acted(self) -> Acting:
        """The matrices of a step, by its key."""
        return Acting(self.central)

    # the proofs
    def told_checks(self, now: slice) -> Iterator[Check]:
        """Proof 1: what nodes say of their measurements and beginnings is what their events say."""
        log, each, n = self.log, self.central.owner(1), self.log.gains.problem.n
        expected = np.ones((log.steps, n), dtype=np.int64)
        began = np.zeros((log.steps, n), dtype=np.int64)
        for places, flags, value in ((log.said.measurements, expected, 0), (log.said.began, began, 1)):
            for step, i in places:
                if step < log.steps:
                    flags[step, i] = value
        again = np.where(log.told < 0, -1, log.origin != -1)
        expected[again == 1] = 0
        unsaid = _unsaid(log) & (again != 1)
        expected[unsaid] = log.told[unsaid]
        yield names("measured", now.start, each, log.told[now], expected[now], ("false", "true"))
        yield names("origin", now.start, each, again[now], began[now], ("", "a beginning"))
        yield from self._origin_checks(now)

    def _origin_checks(self, now: slice) -> Iterator[Check]:
        """x_hat_i(k) of a node that begins again is x_hat_j(k), or 0, to the last bit."""
        log, n, nx = self.log, self.log.gains.problem.n, self.log.gains.problem.nx
        x_hat = log.x_hat[now].reshape(-1, n, nx)
        rows, nodes = np.nonzero(log.origin[now] != -1)
        expected = np.full_like(x_hat, np.nan)
        sources = np.concatenate([x_hat, np.zeros((len(x_hat), 1, nx)), np.full((len(x_hat), 1, nx), np.inf)], axis=1)
        origin = log.origin[now][rows, nodes]
        expected[rows, nodes] = sources[rows, np.where(origin < 0, n + 1, origin)]
        exact = np.where(expected == x_hat, 0.0, 1.0)
        gap = np.where(np.isnan(expected), np.nan, exact).reshape(len(x_hat), -1)
        yield Check(1, "x_hat", now.start, self.central.owner(nx), gap, log.x_hat[now], expected.reshape(gap.shape))

    def step_checks(self, now: slice) -> Iterator[Check]:
        """Proof 2, as in lock-step, with what acted; a node that begins again does not go on from where it was."""
        log, inputs, nx, p = self.log, self.inputs, self.central.problem.nx, self.central.model.plant_states
        now = slice(now.start, min(now.stop, log.steps - 1))
        eta = logged_states(log, self.central, now)
        predicted = np.full_like(eta, np.nan)
        groups: dict[tuple[int, bytes, bytes, bytes], list[int]] = {}
        for row, key in enumerate(self.keys(range(now.start, now.stop))):
            groups.setdefault(key, []).append(row)
        for key, rows in groups.items():
            step, at = self.acted(key), np.array(rows) + now.start
            unknown = np.isnan(eta[rows])
            after = np.where(unknown, 0.0, eta[rows]) @ step.A.T + inputs.w[at] @ step.B.T
            after[:, p:] -= inputs.u[at] @ step.H.T
            touched = unknown.astype(float) @ (step.A != 0.0).astype(float).T > 0.0
            predicted[rows] = np.where(touched, np.nan, after)
        magnitude = self.magnitude(now, logged_plant(log)[now], log.x_hat[now])
        following = slice(now.start + 1, now.stop + 1)
        expected = np.tile(logged_plant(log)[following], self.central.problem.n) - predicted[:, p:]
        expected[np.repeat(log.origin[following] != -1, nx, axis=1)] = np.nan
        yield numbers(
            2, "x_hat", now.start + 1, self.central.owner(nx), log.x_hat[following], expected, magnitude[:, p:]
        )

    def free_run(self, *, block: int) -> Iterator[FreeBlock]:
        """Proofs 3 and 5, as in lock-step, with what acted and with beginnings; absent nodes have no error."""
        log, central, inputs = self.log, self.central, self.inputs
        model, p, size = central.model, central.model.plant_states, central.model.size
        absent, nx = self.absent(), central.problem.nx
        x, eta = central.start(log.has_plant)
        covariances, start, diagonal = np.zeros((2, size, size)), eta, np.arange(size)
        covariances[1] = np.diag(eta**2)
        for first in range(0, log.steps, block):
            steps = range(first, min(first + block, log.steps))
            keys = self.keys(steps)
            xs, etas, reach = np.empty((len(steps), nx)), np.empty((len(steps), size)), np.empty((len(steps), size))
            jumps = [self._jump(k) for k in steps]
            for row, k in enumerate(steps):
                step = self.acted(keys[row])
                if (jump := jumps[row]) is not None:
                    eta = jump @ eta
                at = p + np.flatnonzero(np.repeat(self.anchored[k], nx))
                eta[at] = (np.tile(x, central.problem.n) - log.x_hat[k])[at - p]
                xs[row], etas[row] = x, eta
                etas[row, at] = np.nan
                eta = step.A @ eta + step.B @ inputs.w[k]
                eta[p:] -= step.H @ inputs.u[k]
                x = eta[:p] if p else x
            now = slice(steps.start, steps.stop)
            x_hat = np.where(np.isnan(log.x_hat[now]), np.tile(xs, central.problem.n) - etas[:, p:], log.x_hat[now])
            squares = self.magnitude(now, xs, x_hat) ** 2
            outputs, starts = np.empty((len(steps), len(model.M), len(model.M))), np.empty(len(steps))
            for row, k in enumerate(steps):
                step = self.acted(keys[row])
                if (jump := jumps[row]) is not None:
                    covariances, start = jump @ covariances @ jump.T, jump @ start
                M = model.M * ~np.repeat(absent[k], central.problem.nz)[:, None]
                outputs[row] = M @ covariances[0] @ M.T
                starts[row], start = np.linalg.norm(M @ start), step.A @ start
                reach[row] = covariances[1, diagonal, diagonal] * (max(first + row, 1) * size)
                covariances = step.A @ covariances @ step.A.T
                covariances[0] += step.B @ step.B.T
                covariances[1, diagonal, diagonal] += squares[row]
            yield FreeBlock(first, xs, etas, np.sqrt(np.maximum(reach, FLOOR**2)), free_run.largest(outputs), starts)

    def error_norms(self) -> Array:
        """|z_tilde(k)| over the nodes that are there, (steps,)."""
        log, n = self.log, self.log.gains.problem.n
        errors = np.repeat(log.gains.problem.weights, log.gains.problem.nz) * (np.tile(log.z, n) - log.z_hat)
        errors[np.repeat(self.absent(), log.gains.problem.nz, axis=1)] = 0.0
        errors[np.logical_or.accumulate(self.anchored.any(axis=1))] = np.nan  # whose gain from w is not known
        return np.asarray(np.linalg.norm(errors, axis=1))

    def _jump(self, k: int) -> Array | None:
        """What beginnings do to eta(k); None where nobody begins."""
        log, p, nx, size = self.log, self.central.model.plant_states, self.central.problem.nx, self.central.model.size
        nodes = np.flatnonzero(log.origin[k] != -1)
        if not len(nodes):
            return None
        jump, n = np.eye(size), log.gains.problem.n
        left = {int(i): int(log.origin[k, i]) for i in nodes}
        while left:  # first those whose origin does not begin itself in this step
            i = next((i for i, origin in left.items() if origin not in left), next(iter(left)))
            rows, origin = slice(p + i * nx, p + (i + 1) * nx), left.pop(i)
            if 0 <= origin < n:
                jump[rows] = jump[p + origin * nx : p + (origin + 1) * nx]
                continue
            jump[rows] = 0.0
            if p:
                jump[rows, :p] = np.eye(nx)
        return jump

    def magnitude(self, now: slice, x: Array, x_hat: Array) -> Array:
        """`Central.magnitude`, with a stand-in for every neighbour."""
        inputs, central, log = self.inputs, self.central, self.log
        found = np.empty((now.stop - now.start, central.model.size))
        for s in np.unique(inputs.mode[now]):
            at = inputs.mode[now] == s
            w, y = inputs.w[now][at], np.where(np.isnan(log.y[now]), inputs.u[now], log.y[now])[at]
            found[at] = central.magnitude(int(s), x[at], x_hat[at], w, y, stand_in=self._stand_in[s])
        return found

    @cached_property
    def _stand_in(self) -> Array:
        """(modes, n, nx, nx): the absolute values of what may stand beside a_ii K_ii."""
        problem = self.central.problem
        n, nx = problem.n, problem.nx
        blocks = np.abs(self.central.K_bar).reshape(-1, n, nx, n, nx)
        of_others = np.einsum("sirjc,ij->sirc", blocks, 1.0 - np.eye(n))
        return np.asarray(of_others + (np.abs(problem.plant.A) if problem.unbiased else 0.0))


def with_the_plant(log: Log, drawn: Drawn) -> Log:
    """The log with what a simulated plant did and nobody told, or recorded: it goes on, as the seed disturbs it."""
    if not log.has_plant:
        return log
    plant = log.gains.problem.plant
    x, w = log.x.copy(), np.where(np.isnan(log.w), drawn.w, log.w)
    for k in np.flatnonzero(np.isnan(x).any(axis=1)):
        x[k] = plant.A @ x[k - 1] + plant.B @ w[k - 1] if k else log.gains.problem.initial_error
    seen = np.array([node.seen for node in log.gains.problem.nodes])
    measured = np.where(seen & np.isnan(log.measured), drawn.theta, log.measured)
    return replace(log, x=x, w=w, z=np.where(np.isnan(log.z), x @ plant.M.T, log.z), measured=measured)


def _absent(log: Log) -> Flags:
    unknown = np.isnan(log.x_hat.reshape(log.steps, log.gains.problem.n, log.gains.problem.nx))
    return np.asarray(unknown.any(axis=2), dtype=np.bool_)


def _unsaid(log: Log) -> Flags:
    """(steps, n): so soon before a node was away, or before the log ends, that it may not have given its reasons.

    A node that has given account of the last step has given them all, but for what was lost. Where no event is in the
    file, nobody has.
    """
    absent = _absent(log) | (log.origin != -1)
    unsaid: Flags = log.absences.untold[: log.steps].copy()
    for step, i in zip(*np.nonzero(absent), strict=True):
        unsaid[max(0, step - log.said.memory) : step + 1, i] = True
    for i in range(log.gains.problem.n):
        if not log.said.events:
            unsaid[:, i] = True
        elif log.said.accounted(i) < log.planned - 1:
            unsaid[max(0, log.steps - log.said.memory) :, i] = True
    return unsaid


def _less_substituted(log: Log, hears: Numbers) -> tuple[Numbers, set[tuple[int, int]]]:
    """Those that each node should have used, by the seed and by its events, and where the node alone says so."""
    hears = hears.copy()
    texts = log.gains.problem.node_names
    members = log.senders.members()
    missed: dict[tuple[int, int], set[int]] = {}
    for step, i, j in log.said.pairs:
        if step < log.steps and hears[step, i] >= 0:
            missed.setdefault((step, i), set()).add(j)
    for (step, i), senders in missed.items():
        kept = [j for j in np.flatnonzero(members[hears[step, i]]) if j not in senders]
        hears[step, i] = log.senders.number(texts[j] for j in kept)
    unexplained = set()
    for step, i in np.argwhere(_unsaid(log)).tolist():
        if log.told[step, i] == 0 and log.origin[step, i] == -1 and (step, i) not in log.said.measurements:
            unexplained.add((step, i))
        told = log.heard[step + 1, i] if step + 1 < log.steps and log.origin[step + 1, i] == -1 else -1
        if told >= 0 and told != hears[step, i]:
            hears[step, i] = told
            unexplained.add((step, i))
    return hears, unexplained
