"""A topology as a small graph: the nodes on a circle, and an arrow to each from every node that it hears."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

from agent.contract.problem import Problem

SHORT = 3  # letters of a name that fit into a node
NAMED = 20  # nodes up to which they have names, and the links arrows
BEND = 0.13  # of a link's length, where there is one in the other direction too
HEAD = 8.0  # length of an arrow's head

Point = tuple[float, float]


class Link(NamedTuple):
    """What `receiver` hears of `sender`: a curve from one to the other by way of `middle`."""

    receiver: int
    sender: int
    start: Point
    middle: Point
    end: Point
    lossy: bool


def points(n: int) -> list[Point]:
    """The nodes in file order, clockwise from the top."""
    if n == 1:
        return [(0.0, 0.0)]
    angles = [2.0 * math.pi * i / n for i in range(n)]
    return [(radius(n) * math.sin(angle), -radius(n) * math.cos(angle)) for angle in angles]


def radius(n: int) -> float:
    """Of the circle."""
    return 78.0 if n <= 8 else 112.0


def node_radius(problem: Problem) -> float:
    if problem.n > NAMED:
        return 2.5
    return 14.0 if max(map(len, problem.node_names)) <= SHORT and problem.n <= 16 else 7.0


def links(problem: Problem, s: int) -> Iterator[Link]:
    """Every link of one mode, but that of a node to itself."""
    places, gap = points(problem.n), node_radius(problem) + 2.0
    heard = {(i, j) for i in range(problem.n) for j in problem.neighbours(s, i) if i != j}
    for i, j in sorted(heard):
        (x0, y0), (x1, y1) = places[j], places[i]
        bend = BEND if (j, i) in heard else 0.0
        middle = ((x0 + x1) / 2 - bend * (y1 - y0), (y0 + y1) / 2 + bend * (x1 - x0))
        yield Link(
            i,
            j,
            _towards(places[j], middle, gap),
            middle,
            _towards(places[i], middle, gap),
            problem.delivery[i, j] < 1.0,
        )


def head(link: Link) -> tuple[Point, Point, Point]:
    """The triangle at the end of an arrow."""
    (x, y), (back_x, back_y) = link.end, _towards(link.end, link.middle, HEAD)
    dx, dy = 0.42 * (x - back_x), 0.42 * (y - back_y)
    return link.end, (back_x - dy, back_y + dx), (back_x + dy, back_y - dx)


def _towards(start: Point, end: Point, distance: float) -> Point:
    length = math.dist(start, end) or 1.0
    return start[0] + (end[0] - start[0]) * distance / length, start[1] + (end[1] - start[1]) * distance / length
