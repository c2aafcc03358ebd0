"""The error model in float64: the balls of `BallModel`, each as a float and a bound on what it is off, without zeros.

Every noise xi_l E_l C_l acts through its core E_l'Y_bar E_l, (r, r). The cores are linear in Y_bar, and what they add
to S(Y) is linear in them. docs/theory.md, section 4, counts the roundings.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from flint import arb
from numpy.typing import NDArray

from agent.contract.arrays import Array
from designer.coordinates import of_all_states
from designer.decay import Decay, decay
from designer.invariants import invariants
from designer.proof.ball_model import BallModel
from designer.proof.balls import floats, part
from designer.proof.float64 import TINY, UP, Bounded, U, product, relative, symmetric, times, weights, within
from designer.proof.sparse import matrix
from designer.steered import Steered

Indices = NDArray[np.int64]

_STEPS_OF_REACH = 8


class Enclosed(NamedTuple):
    """Exact numbers x, as floats: |x - middle| <= U size and |middle| <= size."""

    middle: Any  # an array, or a sparse matrix
    size: Any


def enclosed(balls: Sequence[arb], *shape: int) -> Enclosed:
    """The numbers within these balls."""
    middle = np.array([float(ball) for ball in balls])
    off = np.array([float(abs(ball - m).upper()) for ball, m in zip(balls, middle.tolist(), strict=True)])
    size = np.maximum(np.abs(middle), off / U * UP)
    return Enclosed(middle.reshape(shape or (-1,)), size.reshape(shape or (-1,)))


class FloatModel:
    """S(Y) of docs/theory.md in floats, and a P to go with it; eta and modes as in `BallModel`."""

    def __init__(self, balls: BallModel) -> None:
        self.modes, self.size, self.order = len(balls.AB), balls.size, balls.size + balls.nw
        self.states = len(balls.e[0])
        self.transition = enclosed([pi for row in balls.transition for pi in row], self.modes, self.modes)
        self.AB = self._mean(balls)  # block diagonal, a block for each mode
        self._x = tuple(floats(part(balls.AB[0], balls.x, columns)) for columns in (balls.x, balls.w))
        self.AB_T = Enclosed(*(part.T.tocsr() for part in self.AB))
        self.cores, self.added, self.at = self._noise(balls)
        self.peak = self._peak(balls)
        on_the_way = max(2 * _fullest(self.AB_T), _fullest(self.cores) + _fullest(self.added))
        self.rounded = relative(self.modes + on_the_way + 12)
        sizes = (self.transition.size, self.AB.size.data, self.cores.size.data, self.added.size.data)
        self.in_range = within(*sizes, *self.peak)

    def joint(self, Y: Array) -> Bounded | None:
        """S(Y), (modes, n_eta + nw, n_eta + nw), of symmetric floats Y that may have met one rounding; None: too large.

        An entry is off by `rounded` times the same sum of products of sizes at most: with weights D, the row sums of
        that take products with vectors only.
        """
        if not (self.in_range and within(Y)):
            return None
        S = self.weigh(Y)
        Y_size = self._bar(self.transition.size, np.abs(Y))
        D = weights(S.diagonal(axis1=1, axis2=2))
        half = times(Y_size, product(self.AB.size, D.reshape(-1)).reshape(self.modes, self.size))
        rows = product(self.AB_T.size, half.reshape(-1)).reshape(D.shape)
        by_chance = product(self.added.size, product(self.cores.size, Y_size.reshape(-1)))
        of_D = self.at // self.order**2 * self.order + self.at % self.order
        rows += np.bincount(self.at // self.order, by_chance * D.reshape(-1)[of_D], D.size).reshape(D.shape)
        spread = self.rounded * rows / D * UP + TINY
        return Bounded(S, spread) if within(S, spread) else None

    def weigh(self, Y: Array) -> Array:
        """The middle of S(Y)."""
        Y_bar = self._bar(self.transition.middle, Y)
        half = product(self.AB_T.middle, Y_bar.reshape(-1, self.size)).reshape(self.modes, self.order, self.size)
        S = product(self.AB_T.middle, half.swapaxes(1, 2).reshape(-1, self.order)).reshape(-1)
        S[self.at] += product(self.added.middle, product(self.cores.middle, Y_bar.reshape(-1)))
        return symmetric(S.reshape(self.modes, self.order, self.order))

    def _bar(self, transition: Array, Y: Array) -> Array:
        """Y_bar(s) = sum_t pi_st Y(t)."""
        return product(transition, Y.reshape(self.modes, -1)).reshape(Y.shape)

    @cached_property
    @np.errstate(all="ignore")
    def decay(self) -> Decay:
        """Of L, and what solves Z - L(Z) > 0, found and not proved."""
        return decay(lambda Y: self.weigh(Y)[:, : self.size, : self.size], self.modes, weights(self._reach()))

    @cached_property
    @np.errstate(all="ignore")
    def invariants(self) -> list[Array]:
        """Every P(s) for (17), (modes, n_eta, n_eta), found and not proved; none where the errors do not decay."""
        peak = np.tile(self.peak.middle, (self.modes, 1, 1))
        return invariants(self.weigh, self.decay, weights(self._reach()), peak, self.steered).P

    @cached_property
    def steered(self) -> Steered | None:
        """x, where it is in eta."""
        A, B = self._x
        return Steered(A, B) if len(A) else None

    def _reach(self) -> Array:
        """About the square of what w of energy 1 makes of each state of the plant, and of its errors, (n_eta,)."""
        n, nw = self.size, self.order - self.size
        X, reach = np.zeros((self.modes, self.order, nw)), np.zeros((self.modes, n))
        X[:, n:] = np.eye(nw)
        for _ in range(_STEPS_OF_REACH):
            moved = product(self.AB.middle, X.reshape(-1, nw)).reshape(self.modes, n, nw)
            reach += (moved**2).sum(axis=2)
            X[:, :n], X[:, n:] = moved, 0.0
        of_state = of_all_states(reach.reshape(-1, self.states).max(axis=0), self._moves)
        return np.tile(of_state**2, n // self.states)

    def _moves(self) -> Array:
        """The largest |a_ij| from a state j to i, or their errors, (nx, nx)."""
        found, entries = np.zeros((self.states, self.states)), abs(self.AB.middle).tocoo()
        columns = entries.col % self.order
        inside = columns < self.size
        np.maximum.at(
            found,
            (entries.row[inside] % self.size % self.states, columns[inside] % self.states),
            entries.data[inside],
        )
        return found

    def _mean(self, balls: BallModel) -> Enclosed:
        """[A B]."""
        found = _Entries()
        for s, (AB, filled) in enumerate(zip(balls.AB, balls.filled, strict=True)):
            rows, columns = np.nonzero(filled)
            numbers = enclosed([AB[i, j] for i, j in zip(rows.tolist(), columns.tolist(), strict=True)])
            found.add(s * self.size + rows, s * self.order + columns, numbers)
        return found.matrix((self.modes * self.size, self.modes * self.order))

    def _noise(self, balls: BallModel) -> tuple[Enclosed, Enclosed, Indices]:
        """The cores from the entries of Y_bar, what they add to entries of S, and which entries these are."""
        cores, added, first = _Entries(), _Entries(), 0
        for s, noise in ((s, noise) for s, of_mode in enumerate(balls.noise) for noise in of_mode):
            rows, columns, r = np.array(noise.rows), np.array(noise.columns), noise.C.nrows()
            E = enclosed(noise.E.entries(), len(rows), r)
            C = enclosed(noise.C.entries(), r, len(columns))
            variance = enclosed([noise.variance])
            core = first + np.arange(r * r).reshape(r, r, 1, 1)  # one for each pair of columns of E
            E_E = Enclosed(*(np.einsum("ia,jb->abij", part, part) for part in E))
            C_C = Enclosed(*(np.einsum("ap,bq->abpq", part, part) * v for part, v in zip(C, variance, strict=True)))
            cores.add(core, (s * self.size + rows[:, None]) * self.size + rows, E_E)
            added.add((s * self.order + columns[:, None]) * self.order + columns, core, C_C)
            first += r * r
        into_S = added.matrix((self.modes * self.order**2, first))
        at = np.flatnonzero(np.diff(into_S.size.indptr))
        return cores.matrix((first, self.modes * self.size**2)), Enclosed(*(part[at] for part in into_S)), at

    def _peak(self, balls: BallModel) -> Bounded:
        """M'M, the same for every mode."""
        MM, middle, size = balls.MM, np.zeros((self.size, self.size)), np.zeros((self.size, self.size))
        for e_i in balls.e:
            numbers = enclosed([MM[i, j] for i in e_i for j in e_i], len(e_i), len(e_i))
            middle[np.ix_(e_i, e_i)], size[np.ix_(e_i, e_i)] = numbers
        D = weights(middle.diagonal())
        return Bounded(symmetric(middle), relative(2) * times(size, D) / D * UP + TINY)


class _Entries:
    """A sparse matrix, gathered part by part; no place twice."""

    def __init__(self) -> None:
        self._parts: list[tuple[Indices, Indices, Array, Array]] = []

    def add(self, rows: Indices, columns: Indices, numbers: Enclosed) -> None:
        """Numbers at these places, all of one shape; what is exactly 0 is left out."""
        kept = numbers.size != 0.0  # what is no number stays, and is out of range
        places = (np.broadcast_to(part, kept.shape)[kept] for part in (rows, columns))
        self._parts.append((*places, numbers.middle[kept], numbers.size[kept]))

    def matrix(self, shape: tuple[int, int]) -> Enclosed:
        """Two sparse matrices."""
        nowhere, nothing = np.zeros(0, dtype=np.int64), np.zeros(0)
        parts = self._parts or [(nowhere, nowhere, nothing, nothing)]
        rows, columns, *numbers = (np.concatenate(each) for each in zip(*parts, strict=True))
        found = Enclosed(*(matrix(part, rows, columns, shape) for part in numbers))
        assert found.size.nnz == len(rows), "a place twice: its sum would be rounded, and not counted"
        return found


def _fullest(matrix: Enclosed) -> int:
    """The most entries in a row."""
    return int(np.diff(matrix.size.indptr).max(initial=0))
