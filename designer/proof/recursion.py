"""The exact gain proved: the recursion of docs/theory.md, section 2, until it lies below g P, in any arithmetic.

At g <= gamma^2, from M'M: every W > 0 up to a step after which Y < g P in every mode. P satisfies (17), which says that
a step leads from g P to less than g P with W > 0, and a smaller Y leads to a smaller one, with a larger W. So every W
is positive definite for ever, and gamma_T^2 <= g for every T. Y < g P at once is (18).

The recursion rises with what it starts from. So after every step Y is replaced by numbers that are provably not below
it: what is proved is proved of more than the truth. Where that fails, the same with numbers that are not above the
truth shows whether the claim is false.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Protocol

import numpy as np

from agent.contract.arrays import Array
from designer.patience import look
from designer.proof.balls import UNDECIDED, Sign
from designer.proof.findings import Finding, found, proved

Modes = tuple[str, ...]
MOST_STEPS = 100_000  # designs need fewer even where errors hardly decay
_FEWEST = 500  # that are taken in networks of any size
_FIRST = 100  # steps before w = Gamma eta is held
_FIRST_OF_THRESHOLD = 300  # in which what decays fast has died out
MOST_NUMBERS = 8e9  # of all S(Y) together: about two minutes; at the exact gain itself a recursion has no end


class Arithmetic(Protocol):
    """What a proof is made in. Every list has a sign for each mode, of the exact matrix that it is about.

    `up`: rounded so that what is proved of the result holds of the exact one; else, so that what is proved false does.
    Matrices of the recursion are in a form of its own; P is (modes, n_eta, n_eta), of which (P + P')/2 counts.
    """

    name: str
    order: int  # of eta
    cost: float  # of a number of S(Y), beside that of a float

    def inequality_17(self, P: Array) -> list[Sign]:
        """diag{P(s), I} - S(P)(s) > 0: minus the matrix of (17)."""

    def inequality_18(self, P: Array, gamma: float) -> list[Sign]:
        """P(s) - M'M / gamma^2 > 0: (18), by the Schur complement; (32)."""

    def positive(self, P: Array) -> list[Sign]:
        """P(s) > 0."""

    def decreasing(self, Z: Array) -> list[Sign]:
        """Z(s) - L(Z)(s) > 0, for any symmetric Z."""

    def start(self, *, up: bool) -> Any:
        """Y = M'M in every mode."""

    def step(self, Y: Any, gamma: float, *, up: bool) -> tuple[list[Sign], Any]:
        """The signs of W = gamma^2 I - B'Y_bar B, and Y one step earlier; None unless every W > 0 is proved."""

    def below(self, Y: Any, P: Array, gamma: float) -> list[Sign]:
        """gamma^2 P(s) - Y(s) > 0."""

    def floats(self, Y: Any) -> Array:
        """About Y, (modes, n_eta, n_eta)."""


class Costs(Protocol):
    """What w has to spend to bring x somewhere, beside a P that satisfies (17); designer.proof.steering."""

    P: Array  # about the largest P with E eta'P eta <= E sum |w|^2

    def ends(self, Y: Any, gamma: float) -> list[Sign]:
        """Whether what Y weighs costs more, wherever eta may be: then the recursion need not go on."""

    def outweighed(self, Y: Any, gamma: float, u: Array) -> list[Sign]:
        """Whether Y weighs x = G u, and whatever errors there are then, by more than it costs to be there."""

    def direction(self, Y: Array, gamma: float) -> Array | None:
        """Such a u, (p,), as floats see it; None: there is none."""


def recursion(
    arithmetic: Arithmetic, modes: Modes, gamma: float, P: Array, *, most: int = MOST_STEPS, costs: Costs | None = None
) -> list[Finding]:
    """W > 0 in every mode at each step, and then Y < g P in every mode; or the first that is not proved.

    With `costs`, g times what it costs to be at eta is in the place of g P.
    """
    bound = P if costs is None else costs.P
    most = min(most, max(_FEWEST, int(MOST_NUMBERS / (arithmetic.cost * len(modes) * arithmetic.order**2))))
    every: list[Finding] = []
    Y, next_look = arithmetic.start(up=True), 0
    for steps in range(most + 1):
        look(steps)
        if steps == most or steps >= next_look:
            if seems_below(arithmetic.floats(Y), bound, gamma):
                below = arithmetic.below(Y, P, gamma) if costs is None else costs.ends(Y, gamma)
                ends = found("Y < g P", modes, below, f" after {steps} steps")
                if proved(ends):
                    return every + ends
            next_look = steps + 1 + steps // 16  # so that looking takes a sixteenth more steps, not as long as they
        if steps < most:
            signs, Y = arithmetic.step(Y, gamma, up=True)
            every += found("recursion", modes, signs, _at(steps + 1, gamma))
            if Y is None:
                false = disproof(arithmetic, modes, gamma, most=2 * steps + 10)
                return [*every[: -len(modes)], false or _left_open(every[-len(modes) :])]
    end = Finding("Y < g P", modes[0], UNDECIDED, f" after {most} steps, and in none before", exhausted=True)
    return [*every, end]


def disproof(
    arithmetic: Arithmetic, modes: Modes, gamma: float, *, most: int, P: Array | None = None
) -> Finding | None:
    """A W that is proved not to be positive definite within so many steps: gamma is below the exact gain; or None.

    P, which satisfies (17), ends the search where there will be none.
    """
    Y, next_look = arithmetic.start(up=False), 1
    for step in range(1, most + 1):
        look()
        if P is not None and step >= next_look:
            if seems_below(arithmetic.floats(Y), P, gamma):
                break
            next_look = step + 1 + step // 16
        signs, Y = arithmetic.step(Y, gamma, up=False)
        false = [finding for finding in found("recursion", modes, signs, _at(step, gamma)) if finding.sign.refuted]
        if false:
            return false[0]
        if Y is None:
            break
    return None


def disproof_by_costs(arithmetic: Arithmetic, modes: Modes, gamma: float, costs: Costs, *, most: int) -> bool:
    """Whether it is proved that the recursion fails in the end, for all that w has to spend before."""
    Y, next_look = arithmetic.start(up=False), 0
    for step in range(most + 1):
        look()
        if step >= next_look:
            about = arithmetic.floats(Y)
            u = costs.direction(about, gamma)
            if u is not None and proved(found("", modes, costs.outweighed(Y, gamma, u))):
                return True
            if seems_below(about, costs.P, gamma):
                return False
            next_look = step + 1 + step // 16
        signs, Y = arithmetic.step(Y, gamma, up=False)
        if Y is None:
            return any(sign.refuted for sign in signs)
    return False


class Leaping(Arithmetic, Protocol):
    """One that takes many steps at once."""

    def leap(self, Y: Any, gamma: float, steps: int, like: Array | None = None) -> Any:
        """Not above Y so many steps earlier, a power of two, w = Gamma eta held that is worst now; None: not found.

        `like`: Gamma is worst against this P at g = 1 instead.
        """


def disproof_by_leaps(
    by: Leaping, modes: Modes, gamma: float, *, most: int, share: float, P: Array | None = None
) -> Finding | None:
    """As `disproof`, of errors that decay slowly: one w = Gamma eta is held for so large a share of all steps before.

    Without P it is the worst one, which hardly moves where errors do not oscillate. Where they do it turns with them,
    but one that is worst against a P = F(P) is worst in every phase.
    """
    Y, done, leapt = by.start(up=False), 0, 0
    first, between = (_FIRST, 1) if P is None else (_FIRST_OF_THRESHOLD, by.order)
    while done < most:
        look()
        signs, Y = by.step(Y, gamma, up=False)
        done += 1
        false = [finding for finding in found("recursion", modes, signs, _at(done, gamma)) if finding.sign.refuted]
        if false or Y is None:
            return false[0] if false else None
        if done >= max(first, leapt + between):
            length = 2 ** (int(share * done).bit_length() - 1)
            Y, done = by.leap(Y, gamma, length, P), done + length
            leapt = done
            if Y is None:
                return None
    return None


def _left_open(last: list[Finding]) -> Finding:
    """The first W of the last step that is not proved, or else the first, from which there was no going on."""
    first = next((finding for finding in last if not finding.sign.proved), last[0])
    return first._replace(sign=first.sign._replace(proved=False, refuted=False))


def _at(step: int, gamma: float) -> str:
    return f" at step {step}, counted from the last, with g = gamma^2 = {gamma**2:.6g}"


class Weighing(Protocol):
    """What floats make of S(Y), without a bound on their rounding."""

    def start(self, *, up: bool) -> Array: ...

    def weigh(self, Y: Array, X: Array) -> Array:
        """S(Y), (modes, n_eta + nw, n_eta + nw); X says nothing here."""


def seen_by_floats(by: Weighing, gamma: float, most: int) -> Iterator[Array]:
    """Y of the recursion every now and then, as far as it goes in so many steps; a look ahead that proves nothing."""
    Y, next_look, g = by.start(up=True), 0, gamma**2
    n = Y.shape[1]
    for steps in range(most + 1):
        look()
        if steps >= next_look:
            yield Y
            next_look = steps + 1 + steps // 16
        try:
            with np.errstate(all="ignore"):  # here, as around a generator it would be over before the first step
                S = by.weigh(Y, Y)
                W = g * np.eye(S.shape[1] - n) - S[:, n:, n:]
                np.linalg.cholesky(W)
                Y = S[:, :n, :n] + S[:, :n, n:] @ np.linalg.solve(W, S[:, n:, :n])
        except np.linalg.LinAlgError:
            return


def seems_below(Y: Array, P: Array, gamma: float) -> bool:
    """Whether Y < g P by Cholesky in floats: a cheap screen, no proof."""
    with np.errstate(all="ignore"):
        rest = gamma**2 * (P + P.swapaxes(1, 2)) / 2.0 - Y
    try:
        return bool(np.isfinite(np.linalg.cholesky(rest)).all())
    except np.linalg.LinAlgError:
        return False
