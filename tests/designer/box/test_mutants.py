"""A box that lacks one entry, or is 1 % too small in it, is found out: in each of beta, rho, Pi, A, B, C, D and M.

What may be off is written in the problem; which models that means is worked out here, by hand.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import pytest
from flint import ctx
from made_recordings import random_gains, real_problem
from outcomes import moment

from agent.contract.arrays import Array
from agent.contract.gains import Gains
from agent.contract.problem.matrices import matrices_of
from designer.box.extent import Box, box_in, corners
from designer.proof.ball_model import Truth, told
from designer.proof.balls import exact, floats
from designer.proof.by_vertices import upper_bound
from designer.proof.cube import Cube
from designer.proof.vertices_by_balls import CubeByBalls

OFF = 0.1


class Kind(NamedTuple):
    """One number of the problem; `tolerance` says in it, or in a part of it, that this number is off by up to OFF."""

    letter: str
    part: str  # "plant", "markov", "node", "link"
    which: int  # of nodes or links
    at: tuple[int, ...]

    @property
    def tolerance(self) -> dict[str, Any]:
        if self.letter in ("beta", "rho"):
            return {"arrival_probability" if self.letter == "beta" else "delivery_probability": OFF}
        if self.letter == "Pi":
            return {"transition": [OFF if s == self.at[0] else 0.0 for s in range(2)]}
        sizes = np.zeros(SHAPES[self.letter])
        sizes[self.at] = OFF
        return {self.letter: sizes.tolist()}


SHAPES = {"A": (2, 2), "B": (2, 2), "C": (1, 2), "D": (1, 2), "M": (1, 2)}
KINDS = [
    Kind("beta", "node", 0, ()),  # its losses are hidden
    Kind("beta", "node", 1, ()),  # and of this seen
    Kind("rho", "link", 0, ()),
    Kind("Pi", "markov", 0, (1,)),
    Kind("A", "plant", 0, (1, 0)),
    Kind("B", "plant", 0, (0, 1)),
    Kind("C", "node", 0, (0, 1)),
    Kind("C", "node", 1, (0, 0)),
    Kind("D", "node", 0, (0, 0)),
    Kind("D", "node", 1, (0, 1)),
    Kind("M", "plant", 0, (0, 1)),
]


@cache
def network() -> Gains:
    """Two nodes that hear each other, one of which sees its losses; two modes."""
    problem = real_problem(4, unbiased=False, ny=(1, 1), modes=2)
    loss = {name: {"arrival_probability": 0.7} for name in problem.node_names}
    problem = problem.with_(node=loss)
    assert {node.seen for node in problem.nodes} == {False, True}
    return random_gains(problem)


def box_that_says(kind: Kind) -> Box:
    document = json.loads(json.dumps(network().problem.document()))
    part = document[kind.part]
    (part[kind.which] if isinstance(part, list) else part)["tolerance"] = kind.tolerance
    found = box_in(type(network().problem).from_document(document))
    assert found is not None
    return found._replace(carry=True)


def end(kind: Kind, sign: float) -> Truth:
    """The model in which this one number is off by all that it may be, everything else as it is."""
    problem = network().problem
    truth, off = told(problem)._replace(carry=True), sign * OFF
    if kind.letter == "beta":
        beta = np.array(problem.beta)
        beta[kind.which] += off
        return truth._replace(beta=beta)
    if kind.letter == "rho":
        link, rho = problem.links[kind.which], np.array(problem.delivery)  # type: ignore[index]
        rho[problem.node_index(link.receiver), problem.node_index(link.sender)] += off
        return truth._replace(rho=rho)
    if kind.letter == "Pi":
        rows = [[float(pi) for pi in row] for row in truth.transition]
        rows[kind.at[0]][0] += off
        rows[kind.at[0]][1] -= off
        return truth._replace(transition=rows)  # type: ignore[arg-type]
    matrices = matrices_of(problem)
    moved = getattr(matrices, kind.letter)
    one = np.array(moved[kind.which] if kind.letter in "CD" else moved)
    one[kind.at] += off
    if kind.letter in "CD":
        one = tuple(one if j == kind.which else other for j, other in enumerate(moved))
    return truth._replace(matrices=matrices._replace(**{kind.letter: one}))


def random_Y() -> tuple[Array, Array]:
    """Y, and weights X."""
    rng, order, nw = np.random.default_rng(1), 6, network().problem.nw
    half, of_X = rng.normal(size=(2, order, order)), rng.normal(size=(2, order + nw, order + nw))
    return half @ half.swapaxes(1, 2), of_X @ of_X.swapaxes(1, 2)


def in_floats(box: Box, Y: Array, X: Array) -> tuple[Array, Array]:
    gains = network()
    every = [Cube(gains.problem, gains.K, gains.H, corner, box.entries) for corner in corners(gains.problem, box)]
    joint = [cube.joint(Y, X) for cube in every]
    return np.array([S.middle for S in joint if S is not None]), every[0].ended(X)


def in_balls(box: Box, Y: Array, X: Array) -> tuple[Array, Array]:
    gains = network()
    with ctx.workprec(128):
        every = [
            CubeByBalls(gains.problem, gains.K, gains.H, corner, box.entries) for corner in corners(gains.problem, box)
        ]
        joint, peak = [cube.joint([exact(Y_s) for Y_s in Y], X) for cube in every], every[0].ended(X)
        assert peak is not None
        S = [[floats(S_s) for S_s in of_corner] for of_corner in joint if of_corner is not None]
        return np.array(S), np.array([floats(peak_s) for peak_s in peak])


def short_of(kind: Kind, box: Box, by: Callable[[Box, Array, Array], tuple[Array, Array]]) -> float:
    """By how much the bound of the box, at its least, is below what a model at an end of the kind's number does."""
    gains, (Y, X) = network(), random_Y()
    problem = gains.problem
    S, peak = by(box, Y, X)
    Z, least = upper_bound(S, X), 0.0
    for truth in (end(kind, sign) for sign in (-1.0, 1.0)):
        off = 0.0 if truth.matrices is None else truth.matrices.M - problem.plant.M
        M = np.vstack([np.zeros((problem.nz, problem.nx)) + off] * problem.n)
        M = (
            np.hstack([M, np.kron(np.eye(problem.n), problem.plant.M)])
            * np.repeat(problem.weights, problem.nz)[:, None]
        )
        least = min(least, float(np.linalg.eigvalsh(peak[0] - M.T @ M)[0]))
        for s, mode in enumerate(problem.mode_names):
            Y_bar = np.asarray(sum(float(pi) * Y_t for pi, Y_t in zip(truth.transition[s], Y, strict=True)))
            of_model = moment(gains, mode, truth.beta, truth.rho, Y_bar, truth.matrices)
            least = min(least, float(np.linalg.eigvalsh(Z[s] - of_model)[0]))
    return -least


def left_out(box: Box) -> Box:
    """All that may be off is one number, so nothing is."""
    rows = tuple((tuple(row),) for row in told(network().problem).transition)
    return box._replace(intervals=(), entries=(), rows=rows)


def too_small(box: Box) -> Box:
    """By 1 %."""
    entries = tuple(entry._replace(radius=0.99 * entry.radius) for entry in box.entries)
    intervals = tuple(part._replace(low=part.low + 0.01 * OFF, high=part.high - 0.01 * OFF) for part in box.intervals)
    given = told(network().problem).transition
    rows = tuple(
        tuple(tuple(pi + (end - pi) * 99 / 100 for pi, end in zip(row, corner, strict=True)) for corner in of_mode)
        for row, of_mode in zip(given, box.rows, strict=True)
    )
    return box._replace(entries=entries, intervals=intervals, rows=rows)


@pytest.mark.parametrize("by", [in_floats, in_balls])
@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: f"{kind.letter} {kind.which}")
def test_what_is_above_a_box_is_above_its_ends_and_that_of_a_mutant_is_not(kind: Kind, by: Any) -> None:
    box = box_that_says(kind)
    assert short_of(kind, box, by) < 1e-9
    for mutant in (left_out, too_small):
        assert short_of(kind, mutant(box), by) > 1e-6, mutant.__name__
