"""Many steps of the recursion at once, from below: with w = Gamma eta held a step is linear, and powers are squared.

A step leads from Y to the maximum over w, so to no less than L_c(Y) - g Gamma'Gamma for any Gamma; L_c(Y) is
[I; Gamma]'S(Y)[I; Gamma], and rises with Y. So what many steps of that lead to is not above what as many steps of the
recursion lead to, unless one of these has a W that is not positive definite, which is as good; docs/theory.md, 4.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from flint import arb, arb_mat

from designer.proof.ball_model import BallModel
from designer.proof.balls import identity


class Held(NamedTuple):
    """A step with w held, and its powers of 2, 4, 8, ... as far as they were asked for."""

    powers: list[arb_mat]

    def moved(self, vector: arb_mat, steps: int) -> arb_mat:
        """So many steps, a power of two; a power of the matrix is as dear as some multiplications by vectors."""
        k = 0
        while steps % 2 == 0 and steps > vector.nrows():
            k, steps = k + 1, steps // 2
            if k == len(self.powers):
                self.powers.append(self.powers[-1] * self.powers[-1])
        for _ in range(steps):
            vector = self.powers[k] * vector
        return vector


class HeldPolicies:
    """Symmetric matrices of all modes as vectors of their upper triangles, one mode after the other, and a 1."""

    def __init__(self, model: BallModel) -> None:
        self._model = model
        self._places = [(int(i), int(j)) for i, j in zip(*np.triu_indices(model.size), strict=True)]
        self._weighed = [
            [model.weighed(s, _unit(model.size, *at), [model.eta]) for at in self._places] for s in model.modes
        ]

    def held(self, policies: list[arb_mat], gamma: float) -> Held:
        """w = Gamma eta by mode, at gamma^2."""
        return Held([self._step(policies, arb(gamma) ** 2)])

    def after(self, Y: list[arb_mat], held: Held, steps: int) -> list[arb_mat]:
        """Not above Y after so many steps of the recursion at gamma^2, a power of two."""
        vector = arb_mat(held.powers[0].nrows(), 1, [*(Y_s[at] for Y_s in Y for at in self._places), arb(1)])
        return self._matrices(held.moved(vector, steps))

    def _step(self, policies: list[arb_mat], g: arb) -> arb_mat:
        """Y <- L_c(Y) - g Gamma'Gamma, as a matrix."""
        model, size = self._model, len(self._places)
        step = arb_mat(model.modes.stop * size + 1, model.modes.stop * size + 1)
        step[step.nrows() - 1, step.nrows() - 1] = 1
        for s, Gamma in enumerate(policies):
            closed = arb_mat(model.size + model.nw, model.size, identity(model.size).entries() + Gamma.entries())
            spent = Gamma.transpose() * Gamma * g
            for k, at in enumerate(self._places):
                step[s * size + k, step.ncols() - 1] = -spent[at]
            for column, S in enumerate(self._weighed[s]):
                moved = closed.transpose() * S * closed
                for t, pi in enumerate(model.transition[s]):
                    for k, at in enumerate(self._places):
                        step[s * size + k, t * size + column] = moved[at] * pi
        return step

    def _matrices(self, vector: arb_mat) -> list[arb_mat]:
        found, entries, n = [], iter(vector.entries()), self._model.size
        for _ in self._model.modes:
            Y_s = arb_mat(n, n)
            for i, j in self._places:
                Y_s[i, j] = Y_s[j, i] = next(entries)
            found.append(Y_s)
        return found


def _unit(size: int, i: int, j: int) -> arb_mat:
    unit = arb_mat(size, size)
    unit[i, j] = unit[j, i] = 1
    return unit
