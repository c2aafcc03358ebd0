"""The proof in ball arithmetic: slow, sees far further than floats, and assumes nothing of numpy; the witness."""

from __future__ import annotations

from functools import cached_property

import flint
import numpy as np
from flint import arb, arb_mat, ctx

from agent.contract.arrays import Array
from agent.contract.gains import LinkMatrices
from agent.contract.problem import Problem
from designer.proof import balls
from designer.proof.ball_model import BallModel
from designer.proof.balls import UNDECIDED, Sign, above, below, blocks, diagonal, exact, identity, of_blocks, part, sign
from designer.proof.held_policies import Held, HeldPolicies


class ByBalls:
    """`designer.proof.recursion.Arithmetic`. Y is a matrix of numbers, radius 0, for every mode."""

    cost = 200.0

    def __init__(
        self, problem: Problem, K: LinkMatrices, H: LinkMatrices, *, bits: int, T: Array | None = None
    ) -> None:
        self.bits, self.name = bits, f"ball arithmetic of {bits} bits (flint {flint.__version__})"
        with ctx.workprec(bits):
            self.model = BallModel(problem, K, H, T=T)
        self.order = self.model.size
        self.unknowns = len(self.model.AB) * self.order * (self.order + 1) // 2  # entries of Y in all modes
        self._last: tuple[Array, float, Held | None] | None = None

    def inequality_17(self, P: Array) -> list[Sign]:
        n, model = self.model.size, self.model
        weighed = np.tile(np.eye(n + model.nw), (len(P), 1, 1))
        weighed[:, :n, :n] = P
        with ctx.workprec(self.bits):
            S = model.joint(symmetric(P), _blocks(model, P))
            return [sign(whole - S_s, diagonal(whole)) for S_s, whole in zip(S, symmetric(weighed), strict=True)]

    def inequality_18(self, P: Array, gamma: float) -> list[Sign]:
        """By the blocks of P."""
        with ctx.workprec(self.bits):
            MM, found = self.model.MM * (1 / arb(gamma) ** 2), _blocks(self.model, P)
            return [
                of_blocks([sign(part(P_s - MM, block, block), diagonal(P_s)[block]) for block in found])
                for P_s in symmetric(P)
            ]

    def positive(self, P: Array) -> list[Sign]:
        with ctx.workprec(self.bits):
            return [sign(P_s, diagonal(P_s)) for P_s in symmetric(P)]

    def decreasing(self, Z: Array) -> list[Sign]:
        eta = self.model.eta
        with ctx.workprec(self.bits):
            rests = [
                Z_s - part(S, eta, eta)
                for S, Z_s in zip(self.model.joint(symmetric(Z), _blocks(self.model, Z)), symmetric(Z), strict=True)
            ]
            return [sign(rest, np.abs(diagonal(rest))) for rest in rests]

    def start(self, *, up: bool) -> list[arb_mat]:
        with ctx.workprec(self.bits):
            return [_rounded(self.model.MM, up=up)] * len(self.model.AB)

    def step(self, Y: list[arb_mat], gamma: float, *, up: bool) -> tuple[list[Sign], list[arb_mat] | None]:
        with ctx.workprec(self.bits):
            g = arb(gamma) ** 2
            g = g.lower() if up else g.upper()
            taken = [self._step(S, g, up=up) for S in self.model.joint(Y)]
        Y_next = [grown for _, grown in taken if grown is not None]
        return [found for found, _ in taken], Y_next if len(Y_next) == len(taken) else None

    def undisturbed(self, Y: list[arb_mat]) -> list[arb_mat]:
        """Not below L(Y): the step without w."""
        eta = self.model.eta
        with ctx.workprec(self.bits):
            return [above(part(S, eta, eta)) for S in self.model.joint(Y)]

    def _step(self, S: arb_mat, g: arb, *, up: bool) -> tuple[Sign, arb_mat | None]:
        model = self.model
        W, cross = identity(model.nw) * g - part(S, model.w, model.w), part(S, model.eta, model.w)
        found = sign(W, np.full(model.nw, float(g)))
        if not found.proved:
            return found, None
        try:
            grown = part(S, model.eta, model.eta) + cross * W.solve(cross.transpose())
        except ZeroDivisionError:  # too few bits
            return UNDECIDED, None
        return found, _rounded(grown, up=up)

    def leap(self, Y: list[arb_mat], gamma: float, steps: int, like: Array | None = None) -> list[arb_mat] | None:
        with ctx.workprec(self.bits):
            held = self._held_now(Y, gamma) if like is None else self._held_like(like, gamma)
            return None if held is None else [below(Y_s) for Y_s in self._policies.after(Y, held, steps)]

    def _held_like(self, P: Array, gamma: float) -> Held | None:
        """What was asked for last is kept: its powers are most of the work."""
        if self._last is None or self._last[0] is not P or self._last[1] != gamma:
            self._last = P, gamma, self._held_now(symmetric(P), gamma, 1.0)
        return self._last[2]

    def _held_now(self, Y: list[arb_mat], gamma: float, g: float | None = None) -> Held | None:
        """The policy that is worst against Y at g, or at gamma^2; None where it is no number."""
        policies = [self._worst(S, gamma**2 if g is None else g) for S in self.model.joint(Y)]
        if not all(np.isfinite(Gamma).all() for Gamma in policies):
            return None
        return self._policies.held([exact(Gamma) for Gamma in policies], gamma)

    def _worst(self, S: arb_mat, g: float) -> Array:
        """W^-1 B'Y_bar A in floats."""
        n, joint = self.model.size, balls.floats(S)
        with np.errstate(all="ignore"):
            try:
                return np.asarray(np.linalg.solve(g * np.eye(self.model.nw) - joint[n:, n:], joint[n:, :n]))
            except np.linalg.LinAlgError:
                return np.full((self.model.nw, n), np.nan)

    @cached_property
    def _policies(self) -> HeldPolicies:
        return HeldPolicies(self.model)

    def below(self, Y: list[arb_mat], P: Array, gamma: float) -> list[Sign]:
        with ctx.workprec(self.bits):
            bounds = [P_s * arb(gamma) ** 2 for P_s in symmetric(P)]
            return [sign(bound - Y_s, diagonal(bound)) for Y_s, bound in zip(Y, bounds, strict=True)]

    def floats(self, Y: list[arb_mat]) -> Array:
        return np.array([balls.floats(Y_s) for Y_s in Y])


def _rounded(Y: arb_mat, *, up: bool) -> arb_mat:
    return above(Y) if up else below(Y)


def _blocks(model: BallModel, P: Array) -> list[list[int]]:
    """The blocks of P(s), the same for every mode; the states of a node, which M'M may join, stay together."""
    joined = (P != 0.0).any(axis=0)
    for e_i in model.e:
        joined[np.ix_(e_i, e_i)] = True
    return blocks(joined)


def symmetric(P: Array) -> list[arb_mat]:
    """(P + P')/2 of every mode, as x'Px sees P."""
    return [exact(P_s) if (P_s == P_s.T).all() else (exact(P_s) + exact(P_s.T)) * arb(0.5) for P_s in P]
