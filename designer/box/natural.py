"""A box in natural units: what proves its gamma is sought in those that all units lead to, and proved in powers of two.

Weights of a proof are compared by their size over all of [eta; w], which is that of the largest numbers wherever states
and w are measured differently. Sought for the numbers of `designer.model.units.NaturalUnits`, what is found depends on
no units; but these are rounded. A proof is of the numbers that were given: powers of two leave every bit.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from agent.contract.arrays import Array
from agent.contract.errors import InputError
from agent.contract.gains import LinkMatrices
from agent.contract.problem import Problem
from agent.contract.problem.matrices import matrices_of
from designer.box.extent import Box
from designer.coordinates import Coordinates
from designer.model.units import NaturalUnits, rounded
from designer.proof.by_vertices import ByVertices
from designer.proof.cube import Cube
from designer.proof.deviations import Entry


class Side(NamedTuple):
    """Gains and a box of models; x and z of the problem that was given are diag(state) x and output z of this one."""

    problem: Problem
    K: LinkMatrices
    H: LinkMatrices
    box: Box
    state: Array  # (nx,)
    output: float = 1.0

    def taken_from(self, other: Side, by: ByVertices, P: Array) -> tuple[ByVertices, Array]:
        """The models of a proof here, with the weights and the P that were found for those of the other side."""
        if self is other:
            return by, P
        eta = np.tile(other.state / self.state, by.order // len(self.state))
        every = np.append(eta, np.ones(by.mean.shape[-1] - by.order))
        both, entries = np.outer(every, every), self.box.entries
        models = [Cube(self.problem, self.K, self.H, corner.truth, entries) for corner in by.corners]
        return ByVertices(models, by.weights * both, by.mean * both), np.asarray(P / np.outer(eta, eta))


def sides(problem: Problem, K: LinkMatrices, H: LinkMatrices, box: Box) -> tuple[Side, Side]:
    """Where a proof is sought, and where it is proved.

    The same where M cancels, as it would not bear the rounding; and all as it was given where numbers near the ends of
    float64 would lose bits even by powers of two.
    """
    given = Side(problem, K, H, box, np.ones(problem.nx))
    try:
        proved = _proved(given)
        natural = NaturalUnits(problem)
    except InputError:  # what is beyond float64 there, or stable by a rounding, is no problem
        return given, given
    if proved is given or natural.exactly or Coordinates.of(natural.problem) is not None:
        return proved, proved
    gains = natural.rounded_there(K, H)
    return Side(natural.problem, *gains, in_units(box, natural), natural.state, natural.output), proved


def _proved(given: Side) -> Side:
    """In powers of two of x and y, if every number comes back from there. z keeps its unit: a proof speaks of gamma."""
    with np.errstate(all="ignore"):
        units = NaturalUnits(given.problem, exactly=True)
        plant = units.problem.plant
        plant = plant.model_copy(update={"M": plant.M * units.output})
        units.problem, units.output = units.problem.model_copy(update={"plant": plant}), 1.0
        gains = units.there(given.K, given.H)
        side = Side(units.problem, *gains, in_units(given.box, units), units.state)
        return side if _is(given, side, units) else given


def in_units(box: Box, units: NaturalUnits) -> Box:
    """The box of the problem in these units."""
    return box._replace(entries=tuple(_scaled(entry, units) for entry in box.entries))


def _scaled(entry: Entry, units: NaturalUnits) -> Entry:
    """An entry of the same matrix in these units, rounded as the matrix is."""
    radius = entry.radius * _factor(entry, units)
    return entry._replace(radius=radius if units.exactly else float(rounded(np.array(radius))))


def _factor(entry: Entry, units: NaturalUnits) -> float:
    r, c, x, y = entry.row, entry.column, units.state, units.y[entry.node]
    match entry.matrix:
        case "A":
            return float(x[c] / x[r])
        case "B":
            return float(1.0 / x[r])
        case "M":
            return float(x[c] / units.output)
        case "C":
            return float(x[c] / y[r])
        case _:
            return float(1.0 / y[r])


def _is(given: Side, side: Side, units: NaturalUnits) -> bool:
    """Whether every number comes back from there as it was."""
    x = units.state
    A, B, M, C, D = matrices_of(side.problem)
    back = [A * x[:, None] / x, B * x[:, None], M / x]
    back += [C_i * y[:, None] / x for C_i, y in zip(C, units.y, strict=True)]
    back += [D_i * y[:, None] for D_i, y in zip(D, units.y, strict=True)]
    A, B, M, C, D = matrices_of(given.problem)
    pairs = list(zip([A, B, M, *C, *D], back, strict=True))
    for gains, found in zip((given.K, given.H), units.back(side.K, side.H), strict=True):
        for mode, of_mode in gains.items():
            pairs += [(G, found[mode][i][j]) for i, heard in of_mode.items() for j, G in heard.items()]
    entries = zip(given.box.entries, side.box.entries, strict=True)
    pairs += [(np.array(entry.radius), np.array(moved.radius / _factor(entry, units))) for entry, moved in entries]
    return all(np.array_equal(*pair) for pair in pairs)
