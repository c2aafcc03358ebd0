"""The recursion ended by what it costs to bring x somewhere, where only x decays slowly; in balls.

x+ = A x + B w moves by itself. G is the sum of all A^j B B' A'^j, P satisfies (17), and 0 < t < 1:

* E eta'P eta <= E sum |w|^2 up to any step, by (17); and x'G^-1 x <= sum |w|^2. So once the recursion at g has come to
  Y <= g [t P + (1 - t) diag{G^-1, 0}], with every W > 0 on the way, no horizon has more than g: gamma^2 <= g.
* w of sum |w|^2 = u'G_T u brings x to xi = G_T u within T steps. The errors are then whatever they are; but
  E eta'P eta <= u'xi. So if [xi; e]'(Y + t g P)[xi; e] > (1 + t) g u'xi for all e and in every mode, E eta'Y eta >
  g u'xi. What is gained after that is more than all w cost: gamma^2 > g.

docs/theory.md, section 4.
"""

from __future__ import annotations

import numpy as np
from flint import arb, arb_mat, ctx

from agent.contract.arrays import Array
from agent.contract.problem import Problem
from designer.proof.balls import Sign, add, diagonal, exact, identity, sign
from designer.proof.by_balls import symmetric
from designer.proof.gramian import Gramian
from designer.steered import SHARE, Steered

BITS = 512
_MORE = 1e-10  # of the diagonal of G: so that it has an inverse

Numbers = Array | list[arb_mat]  # Y as the recursion has it, in floats or in balls of radius 0


class Steering:
    """`designer.proof.recursion.Costs`, with a P that satisfies (17), which somebody else proves."""

    def __init__(self, gramian: Gramian, inverse: arb_mat, steered: Steered, strict: Array) -> None:
        self._G, self._inverse = gramian, inverse  # of more than G, so less than G^-1
        self._steered, self._strict, self.P = steered, strict, steered.P(strict)

    @classmethod
    def of(cls, problem: Problem, T: Array | None, steered: Steered, strict: Array) -> Steering | None:
        """Of T x; `steered` is what floats know of it. None: A^k is not seen to go to 0, or balls are too wide."""
        if not steered.known:
            return None
        with ctx.workprec(BITS):
            A, B = exact(problem.plant.A), exact(problem.plant.B)
            if T is not None:
                A, B = exact(T) * A * exact(T).inv(), exact(T) * B
            found = Gramian.of(A, B)
            try:
                return None if found is None else cls(found, _inverse_of_more(found), steered, strict)
            except ZeroDivisionError:
                return None

    def ends(self, Y: Numbers, gamma: float) -> list[Sign]:
        """g [t P(s) + (1 - t) diag{(more than G)^-1, 0}] - Y(s) > 0."""
        with ctx.workprec(BITS):
            g, t = arb(gamma) ** 2, arb(SHARE)
            by_x, p = self._inverse * (g * (1 - t)), range(self._inverse.nrows())
            bounds = [P_s * (g * t) for P_s in symmetric(self._strict)]
            for bound in bounds:
                add(bound, p, p, by_x)
            return [sign(bound - Y_s, diagonal(bound)) for Y_s, bound in zip(_exactly(Y), bounds, strict=True)]

    def outweighed(self, Y: Numbers, gamma: float, u: Array) -> list[Sign]:
        """[xi; e]'(Y(s) + t g P(s))[xi; e] - (1 + t) g u'xi > 0 for xi = G_T u and all e: of the form in [1; e]."""
        with ctx.workprec(BITS):
            g, t, exact_u = arb(gamma) ** 2, arb(SHARE), exact(u[:, None])
            xi = self._G.total * exact_u
            cost = (exact_u.transpose() * xi)[0, 0] * g * (1 + t)
            n, p = self._strict.shape[1], xi.nrows()
            ends = arb_mat(n, 1 + n - p)
            add(ends, range(p), [0], xi)
            add(ends, range(p, n), range(1, 1 + n - p), identity(n - p))
            signs = []
            for Y_s, P_s in zip(_exactly(Y), symmetric(self._strict), strict=True):
                form = ends.transpose() * (Y_s + P_s * (t * g)) * ends
                form[0, 0] = form[0, 0] - cost
                signs.append(sign(form, np.abs(diagonal(form))))
            return signs

    def direction(self, Y: Array, gamma: float) -> Array | None:
        """As `Costs` has it."""
        return self._steered.direction(Y, self._strict, gamma**2) if np.isfinite(Y).all() else None


def _exactly(Y: Numbers) -> list[arb_mat]:
    return [exact(Y_s) for Y_s in Y] if isinstance(Y, np.ndarray) else Y


def _inverse_of_more(gramian: Gramian) -> arb_mat:
    more = gramian.total * 1
    for i in range(more.nrows()):
        more[i, i] = (more[i, i] * (1 + _MORE) if more[i, i] > 0 else arb(1)) + gramian.rest
    return more.inv()
