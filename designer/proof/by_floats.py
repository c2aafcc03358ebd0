"""The proof in float64 with a bound on every rounding: fast, for networks of any size; docs/theory.md, section 4."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
from flint import ctx

from agent.contract.arrays import Array
from agent.contract.gains import LinkMatrices
from agent.contract.problem import Problem
from designer.proof.ball_model import BallModel, Truth
from designer.proof.balls import UNDECIDED, Sign
from designer.proof.float64 import Bounded, bounded_below, difference, quotient, raised, sign, symmetric
from designer.proof.float_model import FloatModel
from designer.proof.machine import fault

BITS = 128  # of the balls that the numbers are taken from


class ByFloats:
    """`designer.proof.recursion.Arithmetic`. Y is floats (modes, n_eta, n_eta) on one side of the truth."""

    name = f"float64 with a bound on every rounding (numpy {np.__version__})"
    cost = 1.0
    spreads = False  # about one model, of which S(Y) is linear in Y

    def __init__(
        self,
        problem: Problem,
        K: LinkMatrices,
        H: LinkMatrices,
        truth: Truth | None = None,
        *,
        T: Array | None = None,
    ) -> None:
        with ctx.workprec(BITS):
            self._begin(BallModel(problem, K, H, truth, T))

    def _begin(self, balls: BallModel) -> None:
        self.model = FloatModel(balls)
        self.order = self.model.size
        wrong = fault(self.model.order)
        if wrong is not None:
            self.model.in_range = False  # nothing is decided
            self.name = f"float64, which is not used on this machine because {wrong},"

    def joint(self, Y: Array, X: Array) -> Bounded | None:
        """S(Y) of every model that this is about; X, which weighs what is lost by that, loses nothing of one."""
        return self.model.joint(Y)

    def weigh(self, Y: Array, X: Array) -> Array:
        """The middle of that."""
        return self.model.weigh(Y)

    def ended(self, X: Array) -> Array:
        """Floats above M'M of every model that this is about, (modes, n_eta, n_eta)."""
        return self.start(up=True)

    @np.errstate(all="ignore")  # what is not finite decides nothing
    def inequality_17(self, P: Array) -> list[Sign]:
        return self.inequality_17_of(P, self.model.joint(symmetric(P)))

    @np.errstate(all="ignore")  # what is not finite decides nothing
    def inequality_17_of(self, P: Array, S: Bounded | None) -> list[Sign]:
        """With this for S(P)."""
        P, n = symmetric(P), self.model.size
        if S is None:
            return self._undecided
        whole = np.tile(np.eye(self.model.order), (self.model.modes, 1, 1))
        whole[:, :n, :n] = P
        return self._signs(difference(whole, S), whole)

    def inequality_18(self, P: Array, gamma: float) -> list[Sign]:
        """As g P - M'M > 0: with g <= gamma^2 it is proved of more, for P > 0 follows."""
        signs = self.below(self.start(up=True), P, gamma)
        if all(each.proved for each in signs):
            return signs
        false = self._less(self.start(up=False), P, square(gamma, up=False))
        return [each._replace(refuted=no.refuted) for each, no in zip(signs, false, strict=True)]

    def positive(self, P: Array) -> list[Sign]:
        return self._less(np.zeros_like(P), P, 1.0)

    @np.errstate(all="ignore")  # what is not finite decides nothing
    def decreasing(self, Z: Array) -> list[Sign]:
        Z, n = symmetric(Z), self.model.size
        S = self.model.joint(Z)
        if S is None:
            return self._undecided
        rest = difference(Z, Bounded(S.middle[:, :n, :n], S.spread[:, :n]))
        return self._signs(rest, np.abs(rest.middle))

    def start(self, *, up: bool) -> Array:
        MM = raised(self.model.peak, up=up)
        return np.tile(MM, (self.model.modes, 1, 1))

    @np.errstate(all="ignore")  # what is not finite decides nothing
    def step(self, Y: Array, gamma: float, *, up: bool) -> tuple[list[Sign], Array | None]:
        S = self.model.joint(Y)
        if S is None:
            return self._undecided, None
        J, n, g = raised(S, up=up), self.model.size, square(gamma, up=up)
        W, i = -J[:, n:, n:], np.arange(self.model.order - n)
        W[:, i, i] = np.nextafter(g - J[:, n + i, n + i], -np.inf if up else np.inf)
        known, sizes = np.zeros(len(i)), np.full(len(i), g)
        signs, least = zip(*(bounded_below(Bounded(W_s, known), sizes) for W_s in W), strict=True)
        if not all(each.proved for each in signs):
            return list(signs), None
        Y_next = quotient(J, W, np.array(least))
        return list(signs), None if Y_next is None else raised(Y_next, up=up)

    @np.errstate(all="ignore")  # what is not finite decides nothing
    def undisturbed(self, Y: Array) -> Array | None:
        """Floats not below L(Y): the step without w."""
        S, n = self.model.joint(Y), self.model.size
        return None if S is None else raised(Bounded(S.middle[:, :n, :n], S.spread[:, :n]), up=True)

    def below(self, Y: Array, P: Array, gamma: float) -> list[Sign]:
        return self._less(Y, P, square(gamma, up=True))

    def floats(self, Y: Array) -> Array:
        return Y

    @np.errstate(all="ignore")  # what is not finite decides nothing
    def _less(self, Y: Array, P: Array, g: float) -> list[Sign]:
        """The signs of g P - Y."""
        bound = g * symmetric(P)
        return self._signs(difference(bound, Bounded(Y, np.zeros(Y.shape[:-1]))), bound)

    def _signs(self, S: Bounded, measure: Array) -> list[Sign]:
        if not self.model.in_range:
            return self._undecided
        sizes = measure.diagonal(axis1=1, axis2=2)
        return [sign(Bounded(*part), size) for *part, size in zip(S.middle, S.spread, sizes, strict=True)]

    @property
    def _undecided(self) -> list[Sign]:
        return [UNDECIDED] * self.model.modes


def square(gamma: float, *, up: bool) -> float:
    """The nearest float to gamma^2 that is not above it; or, where not `up`, not below it."""
    exact, g = Fraction(gamma) ** 2, gamma * gamma
    while Fraction(g) > exact if up else Fraction(g) < exact:
        g = float(np.nextafter(g, 0.0 if up else np.inf))
    return g
