"""The proof for a box in ball arithmetic: slow, and nothing is assumed of numpy; the witness of `by_vertices`.

Floats find the weights of the inequalities, P, and the Z of every step; balls decide that they are right.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import flint
import numpy as np
from flint import arb, arb_mat, ctx

from agent.contract.arrays import Array
from agent.contract.errors import counted
from agent.contract.gains import LinkMatrices
from agent.contract.problem import Problem
from designer.proof import balls
from designer.proof.ball_model import BallModel, Truth
from designer.proof.balls import UNDECIDED, Sign, above, add, diagonal, exact, identity, of_blocks, part, sign
from designer.proof.by_balls import ByBalls, symmetric
from designer.proof.by_vertices import ByVertices, Reached
from designer.proof.cube import chosen
from designer.proof.deviations import Deviations, Entry, Term


class CubeByBalls:
    """S(Y) of every model of a cube from above, as `designer.proof.cube.Cube` in floats."""

    def __init__(
        self,
        problem: Problem,
        K: LinkMatrices,
        H: LinkMatrices,
        truth: Truth,
        entries: tuple[Entry, ...],
        T: Array | None = None,
    ) -> None:
        self.model = BallModel(problem, K, H, truth, T)
        self.deviations = Deviations(self.model, problem, entries)
        self.terms: list[list[Term]] = [self.deviations.terms(s) for s in self.model.modes]

    def joint(self, Y: Sequence[arb_mat], X: Array) -> list[arb_mat] | None:
        """Of every mode; X (modes, m, m). None: not proved."""
        every = self.model.joint(list(Y))
        if not self.deviations.keys:
            return every
        found = [
            cubed(S, *self._moved(s, Y), self.deviations.radii, X[s])
            for s, S in zip(self.model.modes, every, strict=True)
        ]
        return _if_all(found)

    def _moved(self, s: int, Y: Sequence[arb_mat]) -> tuple[arb_mat, arb_mat]:
        """a (m, k) and Q (k, k)."""
        model, k = self.model, len(self.deviations.keys)
        Y_bar = sum((Y[t] * pi for t, pi in enumerate(model.transition[s]) if pi != 0), arb_mat(model.size, model.size))
        a, Q = arb_mat(model.size + model.nw, k), arb_mat(k, k)
        for term in self.terms[s]:
            half = part(Y_bar, term.rows, term.rows) * term.U * term.variance
            add(a, term.columns, term.k, term.T.transpose() * half)
            add(Q, term.k, term.k, term.U.transpose() * half)
        return a, Q

    def ended(self, X: Array) -> list[arb_mat] | None:
        """Above M'M of every model of the cube; None: not proved."""
        model, radii = self.model, self.deviations.of_M
        if not radii.any():
            return [model.MM] * len(model.AB)
        by_e, square = self.deviations.peak()
        a = arb_mat(model.size, len(radii))
        add(a, [at for e_i in model.e for at in e_i], range(len(radii)), by_e)
        Q = identity(len(radii)) * square
        n = model.size
        return _if_all([cubed(model.MM, a, Q, radii, X_s[:n, :n]) for X_s in X])


def _if_all(found: Sequence[arb_mat | None]) -> list[arb_mat] | None:
    every = [S for S in found if S is not None]
    return every if len(every) == len(found) else None


def cubed(S: arb_mat, a: arb_mat, Q: arb_mat, radii: Array, X: Array) -> arb_mat | None:
    """`designer.proof.cube.cubed` in balls: the same inequalities, floats choose the weights; None: not proved."""
    by = chosen(balls.floats(a), balls.floats(Q), radii, X)
    Lambda, xi = ([arb(float(number)) for number in numbers] for numbers in (by.Lambda, by.xi))
    d, rows, columns = exact(radii), range(radii.shape[0]), np.flatnonzero(radii.any(axis=0)).tolist()
    W = -Q
    for k in rows:
        W[k, k] = W[k, k] + Lambda[k]
    if not sign(W, by.Lambda).proved:
        return None
    found = S + a * W.solve(a.transpose())
    e = [sum((d[k, c] * xi[c] for c in columns), arb(0)) for k in rows]
    for c in columns:
        found[c, c] = found[c, c] + sum((Lambda[k] * e[k] * d[k, c] for k in rows), arb(0)) / xi[c]
    return found


class VerticesByBalls(ByBalls):
    """`designer.proof.recursion.Arithmetic` of all models of a box; `found` is the same in floats."""

    cost = 1000.0

    def __init__(
        self,
        problem: Problem,
        K: LinkMatrices,
        H: LinkMatrices,
        corners: Sequence[Truth],
        entries: tuple[Entry, ...],
        found: ByVertices,
        *,
        bits: int = 128,
        T: Array | None = None,
    ) -> None:
        self.bits, self.found = bits, found
        self.name = f"ball arithmetic of {bits} bits (flint {flint.__version__}), at {counted(len(corners), 'corner')}"
        with ctx.workprec(bits):
            self.corners = [CubeByBalls(problem, K, H, corner, entries, T) for corner in corners]
        self.model = self.corners[0].model
        self.order = self.model.size

    def inequality_17(self, P: Array) -> list[Sign]:
        n = self.order
        weighed = np.tile(np.eye(n + self.model.nw), (len(P), 1, 1))
        weighed[:, :n, :n] = P
        with ctx.workprec(self.bits):
            whole, exact_P = symmetric(weighed), symmetric(P)
            signs = [_signs(whole, corner.joint(exact_P, self.found.mean)) for corner in self.corners]
        return [of_blocks(list(of_mode))._replace(refuted=False) for of_mode in zip(*signs, strict=True)]

    def decreasing(self, Z: Array) -> list[Sign]:
        """Not known, as in `designer.proof.cube`."""
        return [UNDECIDED] * len(Z)

    def start(self, *, up: bool) -> Any:
        if not up:
            return Reached(0, super().start(up=False))
        with ctx.workprec(self.bits):
            ended = self.corners[0].ended(self.found.mean)
            nothing = [arb_mat(self.order, self.order, [arb("nan")] * self.order**2)] * len(self.model.modes)
            return Reached(0, nothing if ended is None else [above(Y) for Y in ended])

    def step(self, Y: Any, gamma: float, *, up: bool) -> tuple[list[Sign], Any]:
        """Where not `up`: of the first corner."""
        if not up:
            signs, following = super().step(Y.Y, gamma, up=False)
            return signs, None if following is None else Reached(Y.steps + 1, following)
        in_floats = super().floats(Y.Y)
        if not np.isfinite(in_floats).all():
            return [UNDECIDED] * len(in_floats), None
        Z, X = self.found.upper(in_floats, Y.steps), self.found.weight(Y.steps)
        with ctx.workprec(self.bits):
            exact_Z = [exact(Z_s) for Z_s in Z]
            for corner in self.corners:
                if not all(each.proved for each in _signs(exact_Z, corner.joint(Y.Y, X))):
                    return [UNDECIDED] * len(Z), None
            g = (arb(gamma) ** 2).lower()
            taken = [self._step(Z_s, g, up=True) for Z_s in exact_Z]
        following = [grown for _, grown in taken if grown is not None]
        signs = [found._replace(refuted=False) for found, _ in taken]
        return signs, Reached(Y.steps + 1, following) if len(following) == len(taken) else None

    def below(self, Y: Any, P: Array, gamma: float) -> list[Sign]:
        return super().below(Y.Y, P, gamma)

    def floats(self, Y: Any) -> Array:
        return super().floats(Y.Y)


def _signs(above: Sequence[arb_mat], every: Sequence[arb_mat] | None) -> list[Sign]:
    """Whether what is to be above is."""
    if every is None:
        return [UNDECIDED] * len(above)
    return [sign(one - other, diagonal(one)) for one, other in zip(above, every, strict=True)]
