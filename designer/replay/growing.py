"""How large a state may be so that no honest message of the next step is beyond what is compared."""

from __future__ import annotations

import numpy as np

from agent.contract.arrays import Array
from agent.contract.gains import Gains
from agent.contract.messages import CEILING

_GROWN = 1e130  # beyond it nothing is compared, however slowly it grows


def largest_followed(gains: Gains) -> float:
    """While no number of x, of any x_hat or of w is beyond it, none of the next step's messages is beyond CEILING.

    By row sums of the absolute values that (1)-(5) multiply by, one after the other.
    """
    problem = gains.problem
    plant, nodes = problem.plant, problem.nodes
    shown = max([1.0, _most(plant.M), *(2.0 * _most(node.C) + _most(node.D) for node in nodes)])
    slices = (gains.for_node(name) for name in problem.node_names)
    moved = max(2.0 * shown * _most(rows) for of_node in slices for rows in of_node.rows.values())
    grows = max(1.0, _most(plant.A) + _most(plant.B), moved)
    return min(_GROWN, CEILING / shown / grows)


def _most(matrix: Array) -> float:
    return float(np.abs(matrix).sum(axis=1).max(initial=0.0))
