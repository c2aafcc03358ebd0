"""What an export has: one column of numbers for each entry of each field, step by step.

Everything comes from the recording as it is; NaN where a message is missing, or a vector is empty.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agent.contract.arrays import Array
from designer.model.error_model import measurement_slices
from designer.replay.log import Log
from designer.replay.topics import Numbers

OF_PROBLEM = "of the problem"


class Field(NamedTuple):
    """A field of the export: whose it is, in which unit, and what it means. docs/export.md shows this table."""

    name: str
    whose: str
    unit: str
    meaning: str


FIELDS = (
    Field("mode", "coordinator", "place, from 0", "the mode r(k), by its place among the topologies of the problem"),
    Field("x[...]", "plant", OF_PROBLEM, "the state x(k)"),
    Field("z[...]", "plant", OF_PROBLEM, "what is to be estimated, z(k) = M x(k)"),
    Field("w[...]", "plant", OF_PROBLEM, "the disturbance w(k)"),
    Field("arrived", "node", "0 or 1", "theta_i(k): whether the plant is in the measurement; from the plant"),
    Field("y[...]", "node", OF_PROBLEM, "the measurement y_i(k); NaN too where the node saw that it was lost"),
    Field("innovation[...]", "node", OF_PROBLEM, "what the node did not expect of y_i(k)"),
    Field("x_hat[...]", "node", OF_PROBLEM, "the estimate x_hat_i(k) of x(k)"),
    Field("z_hat[...]", "node", OF_PROBLEM, "the estimate z_hat_i(k) = M x_hat_i(k) of z(k)"),
    Field("made_in", "node", "place, from 0", "the mode of step k - 1, by which x_hat_i(k) was made; NaN at step 0"),
    Field("heard[...]", "node", "0 or 1", "whether the message of the node in brackets went into x_hat_i(k)"),
)


class Column(NamedTuple):
    """One number of every step."""

    whose: str  # the name of a node; "plant" or "coordinator"
    field: str  # with its place in a vector, "x_hat[1]", counted from 0 as in the messages; or "heard[name]"
    values: Callable[[slice], Array]  # of the steps in a slice
    folder: str = ""  # before the field, in the title of a wide table

    @property
    def title(self) -> str:
        """In a wide table: "mode", "plant/x[0]", "node/3/x_hat[1]"."""
        return self.folder + self.field


def columns(log: Log) -> Iterator[Column]:
    """In the order of FIELDS: what the coordinator said, the plant, then one node after the other, in file order."""
    problem = log.gains.problem
    yield Column("coordinator", "mode", _known(log, log.mode))
    for name, vectors in (("x", log.x), ("z", log.z), ("w", log.w)):
        yield from _entries("plant", name, vectors, "plant/")
    members, nx, nz = log.senders.members(), problem.nx, problem.nz
    for i, (node, rows) in enumerate(zip(problem.node_names, measurement_slices(problem), strict=True)):
        folder = f"node/{node}/"
        yield Column(node, "arrived", _rows(log.theta[:, i]), folder)
        yield from _entries(node, "y", log.y[:, rows], folder)
        yield from _entries(node, "innovation", log.innovation[:, rows], folder)
        yield from _entries(node, "x_hat", log.x_hat[:, i * nx : (i + 1) * nx], folder)
        yield from _entries(node, "z_hat", log.z_hat[:, i * nz : (i + 1) * nz], folder)
        yield Column(node, "made_in", _known(log, log.used[:, i]), folder)
        for j in problem.ever_heard(i):
            yield Column(node, f"heard[{problem.node_names[j]}]", _heard(log.heard[:, i], members[:, j]), folder)


def _entries(whose: str, name: str, vectors: Array, folder: str) -> Iterator[Column]:
    for place in range(vectors.shape[1]):
        yield Column(whose, f"{name}[{place}]", _rows(vectors[:, place]), folder)


def _rows(values: Array) -> Callable[[slice], Array]:
    return lambda now: values[now]


def _known(log: Log, modes: Numbers) -> Callable[[slice], Array]:
    """Modes of the problem as numbers; NaN for no mode, and for words that are none."""
    count = len(log.gains.problem.topologies)
    return lambda now: np.where((modes[now] >= 0) & (modes[now] < count), modes[now], np.nan)


def _heard(sets: Numbers, is_member: NDArray[np.bool_]) -> Callable[[slice], Array]:
    """1 where a node is in the set of those that were heard, 0 where it is not, NaN where nothing is said."""
    by_number = np.append(is_member.astype(float), np.nan)  # -1, which is for a missing message, takes the last
    return lambda now: by_number[sets[now]]
