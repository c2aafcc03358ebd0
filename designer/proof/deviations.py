"""How a model moves where entries of A, B, C, D, M are off, each by itself: docs/theory.md, section 13.

With entry j off by delta_j, E_l C_l becomes E_l C_l + sum of delta_j u_lj v_j' for every term l of S(Y), [A B] among
them, and v_j is a unit vector: the entry's column meets one entry of [eta; w]. Entries of one row of one matrix share
all u_lj, and so do those of A and B; such a row is one k here.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from flint import arb, arb_mat

from agent.contract.problem import Problem
from designer.proof.ball_model import BallModel
from designer.proof.balls import add, part


class Entry(NamedTuple):
    """An entry of a matrix that may be off by `radius`, up or down; rows and columns count from 0."""

    matrix: str  # "A", "B", "C", "D" or "M"
    node: int  # of C and D; else 0
    row: int
    column: int
    radius: float


class Term(NamedTuple):
    """One term of S(Y): variance, E_l C_l over rows of eta+ and columns of [eta; w], and u_lk of some k."""

    variance: arb
    rows: list[int]
    columns: list[int]
    T: arb_mat
    k: list[int]
    U: arb_mat  # (len(rows), len(k))


class Deviations:
    """Of the entries of A, B, C, D: `radii` (k, n_eta + nw), 0 where nothing is off; `of_M` (nz, n_eta) likewise."""

    def __init__(self, model: BallModel, problem: Problem, entries: tuple[Entry, ...]) -> None:
        self.model, self.problem = model, problem
        self.keys = list(dict.fromkeys(_key(entry) for entry in entries if entry.matrix != "M"))
        nz = model.M.nrows() // len(model.e)
        self.radii, self.of_M = np.zeros((len(self.keys), model.size + model.nw)), np.zeros((nz, model.size))
        self.places: list[tuple[int, int]] = []  # of every entry in `radii`, or in `of_M`
        for entry in entries:
            columns = model.w if entry.matrix in "BD" else model.x
            if not columns:
                raise ValueError(f"an entry of {entry.matrix} is off, and x is left out")
            of_M, at = entry.matrix == "M", columns[entry.column]
            self.places.append((entry.row if of_M else self.keys.index(_key(entry)), at))
            (self.of_M if of_M else self.radii)[self.places[-1]] = entry.radius

    def terms(self, s: int) -> list[Term]:
        """Those of S(Y) in mode s."""
        model, n = self.model, self.model.size
        U = arb_mat(n, len(self.keys))
        for k, (matrix, node, row) in enumerate(self.keys):
            if matrix == "A":
                for at in [part_of[row] for part_of in (model.x, *model.e) if part_of]:
                    U[at, k] = U[at, k] + 1
                continue
            scale = self._scale(matrix, node, loss=False)
            for rows, block in model.carried[s][node]:
                add(U, rows, [k], part(block, range(len(rows)), [row]) * scale)
        found = [Term(arb(1), model.eta, model.eta + model.w, model.AB[s], list(range(len(self.keys))), U)]
        for noise in model.noise[s]:
            moved = [
                (k, row, scale)
                for k, (matrix, node, row) in enumerate(self.keys)
                if matrix != "A" and node == noise.sender and (scale := self._scale(matrix, node, loss=noise.loss)) != 0
            ]
            U, every = arb_mat(len(noise.rows), len(moved)), range(len(noise.rows))
            for column, (_, row, scale) in enumerate(moved):
                add(U, every, [column], part(noise.carried, every, [row]) * scale)
            found.append(Term(noise.variance, noise.rows, noise.columns, noise.E * noise.C, [k for k, *_ in moved], U))
        return found

    def _scale(self, matrix: str, node: int, *, loss: bool) -> arb:
        """What of a deviation of C or D is in the mean innovation of the node, or in what a loss takes from it."""
        if matrix == "C" or self.problem.nodes[node].seen:
            return arb(1) if loss else self.model.sensors[node].beta
        return arb(0) if loss else arb(1)  # D w is there though C x is lost, unseen

    def peak(self) -> tuple[arb_mat, arb]:
        """a_k of the rows of M over the errors of all nodes, (n nx, nz), and Q_kk; Q_kk' is 0 for others."""
        model, nz, weights = self.model, len(self.of_M), [arb(float(weight)) for weight in self.problem.weights]
        a = [
            [model.M[i * nz + row, at] * weight for row in range(nz)]
            for i, (e_i, weight) in enumerate(zip(model.e, weights, strict=True))
            for at in e_i
        ]
        return arb_mat(a), sum((weight**2 for weight in weights), arb(0))


def _key(entry: Entry) -> tuple[str, int, int]:
    return ("A" if entry.matrix in "AB" else entry.matrix, entry.node, entry.row)
