"""What goes wrong in one step of a network, and the operators that act in it instead of the designed ones."""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import numpy as np

from agent.contract.arrays import Array
from agent.contract.problem import Problem
from designer.gain.exact import Operator
from designer.model.error_model import error_model, measurement_slices


class Deviation(NamedTuple):
    """Nodes by their index. What is not in it goes as designed: modes, losses and deliveries are as in the model."""

    substituted: frozenset[tuple[int, int]] = frozenset()  # (i, j): node i took x_hat_i for x_hat_j, and nu_j = 0
    unmeasured: frozenset[int] = frozenset()  # nu_i = 0, because no measurement came
    absent: frozenset[int] = frozenset()  # nobody hears the node, and its error does not count
    begun: frozenset[tuple[int, int | None]] = frozenset()  # (i, j): first x_hat_i := x_hat_j; 0 where j is None

    @property
    def is_as_designed(self) -> bool:
        return self == AS_DESIGNED


AS_DESIGNED = Deviation()
_MOST = 512  # deviations of which the models are kept


class Acting(NamedTuple):
    """One step: eta <- J eta where nodes begin; then z_tilde counts where nodes are there; then the step."""

    operator: Operator
    J: Array | None  # (n_eta, n_eta); None: nobody begins
    MM: Array  # (modes, n_eta, n_eta): M'M of the nodes that are there

    def before(self, Y: Array) -> Array:
        """What weighs eta before nodes begin, if Y does after it."""
        return Y if self.J is None else np.asarray(self.J.T @ Y @ self.J)

    def after(self, X: Array) -> Array:
        """The covariance of eta after nodes have begun, if X is that before."""
        return X if self.J is None else np.asarray(self.J @ X @ self.J.T)


class Unabsorbed(Exception):
    """A deviation that no error model of these gains describes, and why."""


class Models:
    """The error model of every deviation of one network, made when it is first asked for.

    A pair that is substituted moves K_ij to K_ii and leaves H_ij out; without a measurement H_ji is 0 for all j.
    An absent node has no gains, so that its error is that of the estimate 0, which nobody hears.
    """

    def __init__(self, problem: Problem, K_bar: Array, H_bar: Array) -> None:
        self.problem, self.K_bar, self.H_bar = problem, K_bar, H_bar
        self._known: dict[Deviation, Acting] = {}
        self._operators: dict[Deviation, Operator] = {}

    @cached_property
    def designed(self) -> Operator:
        return Operator(error_model(self.problem, self.K_bar, self.H_bar))

    def acting(self, deviation: Deviation) -> Acting:
        """What acts. Raises Unabsorbed where a node begins with 0 and the errors do not know x."""
        if len(self._known) > _MOST:  # a run may go on for ever, with ever other faults
            self._known.clear()
            self._operators.clear()
        if deviation not in self._known:
            self._known[deviation] = Acting(self._operator(deviation), self._J(deviation), self._MM(deviation))
        return self._known[deviation]

    def _operator(self, deviation: Deviation) -> Operator:
        of_step = deviation._replace(begun=frozenset())
        if of_step.is_as_designed:
            return self.designed
        if of_step not in self._operators:
            self._operators[of_step] = Operator(error_model(self.problem, *self._gains(of_step)))
        return self._operators[of_step]

    def _gains(self, deviation: Deviation) -> tuple[Array, Array]:
        problem, nx, rows = self.problem, self.problem.nx, measurement_slices(self.problem)
        K, H = self.K_bar.copy(), self.H_bar.copy()
        nodes = [slice(i * nx, (i + 1) * nx) for i in range(problem.n)]
        without = {(i, j) for j in deviation.absent for i in range(problem.n) if i != j}
        for i, j in deviation.substituted | without:
            K[:, nodes[i], nodes[i]] += K[:, nodes[i], nodes[j]]
            K[:, nodes[i], nodes[j]] = 0.0
            H[:, nodes[i], rows[j]] = 0.0
        for j in deviation.unmeasured:
            H[:, :, rows[j]] = 0.0
        for i in deviation.absent:
            K[:, nodes[i]], H[:, nodes[i]] = 0.0, 0.0
        return K, H

    def _J(self, deviation: Deviation) -> Array | None:
        """e_i := e_j, or x where the node begins with 0."""
        if not deviation.begun:
            return None
        problem, p, nx = self.problem, self.problem.plant_states, self.problem.nx
        J = np.eye(self.designed.size)
        for i, j in sorted(deviation.begun, key=str):
            rows = slice(p + i * nx, p + (i + 1) * nx)
            J[rows] = 0.0
            if j is not None:
                J[rows, p + j * nx : p + (j + 1) * nx] = np.eye(nx)
            elif p:
                J[rows, :p] = np.eye(nx)
            else:
                name = problem.node_names[i]
                raise Unabsorbed(f'node "{name}" began with 0, and of x itself, its error then, the bound says nothing')
        return J

    def _MM(self, deviation: Deviation) -> Array:
        M = self.designed.M.copy()
        for i in deviation.absent:
            M[i * self.problem.nz : (i + 1) * self.problem.nz] = 0.0
        return np.broadcast_to(M.T @ M, self.designed.MM.shape)
