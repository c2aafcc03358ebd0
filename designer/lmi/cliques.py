"""Which small matrices a large sparse one may be split into: the cliques of a chordal graph, as a tree.

A symmetric matrix whose entries are zero outside the cliques of a chordal graph is positive semidefinite if and
only if it is a sum of positive semidefinite matrices that each live on one clique (Agler, Helton, McCullough and
Rodman, Linear Algebra and its Applications 107, 1988). Neighbours in a tree of the cliques exchange what they share.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass


@dataclass
class Clique:
    """Some vertices, ascending; and what it shares with the clique above it in the tree (None at the top)."""

    vertices: tuple[int, ...]
    shared: tuple[int, ...]
    above: int | None


def clique_tree(groups: Iterable[Iterable[int]]) -> list[Clique]:
    """The maximal cliques of a chordal graph in which every group, and vertex 0 with all, is connected.

    Vertices are eliminated, the one with the fewest neighbours left first and vertex 0 last; the neighbours of
    an eliminated vertex become neighbours of each other, which makes the graph chordal.
    """
    left = _neighbours(groups)
    cliques: list[Clique] = []
    waiting: dict[int, set[int]] = {}  # cliques that have no clique above them yet: what is left of each
    while left:
        v = min(left, key=lambda u: (u == 0, len(left[u]), u))
        rest = left.pop(v)
        for u in rest:
            left[u] |= rest - {u}
            left[u].discard(v)
        below = [k for k, shared in waiting.items() if v in shared]
        home = next((k for k in below if waiting[k] == rest | {v}), None)
        if home is None:  # no clique has all of them
            home = len(cliques)
            cliques.append(Clique(tuple(sorted(rest | {v})), (), None))
        for k in below:
            if k != home:
                cliques[k].shared, cliques[k].above = tuple(sorted(waiting.pop(k))), home
        waiting[home] = set(rest)
    return cliques


def _neighbours(groups: Iterable[Iterable[int]]) -> dict[int, set[int]]:
    neighbours: dict[int, set[int]] = {0: set()}
    for group in groups:
        together = {0, *group}
        for u in together:
            neighbours.setdefault(u, set()).update(together - {u})
    return neighbours
