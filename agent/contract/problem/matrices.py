"""A, B, M of the plant and C, D of every node, together: those of a problem file, or what they really are."""

from __future__ import annotations

from typing import NamedTuple

from agent.contract.arrays import Array
from agent.contract.problem import Problem


class Matrices(NamedTuple):
    """Of eqs. (1) and (2), in the shapes that a problem has them in; C and D by node."""

    A: Array
    B: Array
    M: Array
    C: tuple[Array, ...]
    D: tuple[Array, ...]


def matrices_of(problem: Problem) -> Matrices:
    """Those that the file has."""
    plant, nodes = problem.plant, problem.nodes
    return Matrices(plant.A, plant.B, plant.M, tuple(node.C for node in nodes), tuple(node.D for node in nodes))
