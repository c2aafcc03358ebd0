"""What can be proved of gains, without a solver: Theorem 1's bound for a P, and the exact gain.

Floats with bounds are asked first. What they leave open is asked of balls, with more bits each time, where the network
is small enough for that.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import cached_property, partial
from typing import NamedTuple

from agent.contract.arrays import Array
from agent.contract.gains import LinkMatrices
from agent.contract.problem import Problem
from designer.coordinates import Coordinates
from designer.invariants import SLOW
from designer.proof.by_balls import ByBalls
from designer.proof.by_floats import ByFloats
from designer.proof.by_gramian import ByGramian
from designer.proof.findings import GRAMIAN, Finding, Verdict, failure, found, margins, proved, refuted
from designer.proof.recursion import (
    MOST_STEPS,
    Arithmetic,
    disproof,
    disproof_by_costs,
    disproof_by_leaps,
    recursion,
    seems_below,
    seen_by_floats,
)
from designer.proof.steering import BITS as BITS_OF_COSTS
from designer.proof.steering import Steering
from designer.proof.undisturbed import Starts, largest

Make = Callable[..., Arithmetic]  # of a problem, K and H, and T

FLOATS: tuple[Make, ...] = (ByFloats,)
BALLS: tuple[Make, ...] = tuple(partial(ByBalls, bits=bits) for bits in (128, 256, 512, 1024))

# The largest order of eta for which balls are asked what floats leave open: some minutes at 128 bits.
_LARGEST_RECURSION = 130
_LARGEST_INEQUALITY = 450
_STEPS_OF_DISPROOF = 1000  # where there is no P to end the recursion
MOST_STEPS_BELOW = 20_000
_STEPS_BEFORE_LEAPS = 1000
_SHARES = (1 / 4, 1 / 32)  # of all steps so far that w = Gamma eta is held for
_FORGOTTEN = 40.0  # e^-40 is left of what there was, after so many times the steps that errors last
_BITS_OF_LEAPS = 512  # a vector that turns under 64 powers of a matrix loses some hundred
_LARGEST_LEAP = 130  # entries of Y in all modes: a second, if its powers are taken some hundred times
_LARGEST_LEAP_OFTEN = 60
_STEPS_OF_OTHERS = 20_000  # with a P that is to end it early


class _Answer(NamedTuple):
    findings: list[Finding]
    arithmetic: str


class Stability(NamedTuple):
    """Whether the errors are mean-square stable: proved, proved not to be, or not known."""

    holds: bool | None
    arithmetic: str


class Prover:
    """P (modes, n_eta, n_eta), of which (P + P')/2 counts; without one, it is found here. `makes`: whom to ask.

    P is of [T x; T e_1; ...]. Without P, T is chosen here too: where M cancels, so that it does not.
    """

    def __init__(
        self,
        problem: Problem,
        K: LinkMatrices,
        H: LinkMatrices,
        *,
        P: Array | None = None,
        T: Array | None = None,
        makes: Sequence[Make] = FLOATS + BALLS,
    ) -> None:
        self._problem, self._K, self._H, self._given, self._makes = problem, K, H, P, makes
        chosen = Coordinates.of(problem) if P is None and T is None else None
        self.T = T if chosen is None else chosen.T
        self._made: list[Arithmetic] = []
        self._known: dict[int, list[_Answer]] = {}  # by a P of `_invariants`, which stays

    @property
    def P(self) -> Array | None:
        """What satisfies (17), as far as is known before it is proved; None where floats find none."""
        return next(iter(self._invariants), None)

    @cached_property
    def _invariants(self) -> list[Array]:
        """P, and others that end the recursion earlier where errors decay slowly."""
        return self._floats.model.invariants if self._given is None else [self._given]

    @cached_property
    def by_gramian(self) -> ByGramian | None:
        """Where chance has no say, and nobody says by which P; it knows at once what the recursion comes to."""
        return ByGramian.of(self._problem, self._K, self._H) if self._given is None else None

    @cached_property
    def _steering(self) -> Steering | None:
        """Where x decays slowly and is in eta."""
        steered = self._floats.model.steered
        if steered is None or self.P is None or not self._problem.plant.spectral_radius**2 > SLOW:
            return None
        return Steering.of(self._problem, self.T, steered, self.P)

    @cached_property
    def _floats(self) -> ByFloats:
        return ByFloats(self._problem, self._K, self._H, T=self.T)

    def theorem1(self, gamma: float) -> Verdict:
        """(17) and (18) in every mode."""
        if self.P is None:
            return self._no_P(gamma)
        P, modes = self.P, self._problem.mode_names
        last = self._ask(lambda by: found("(18)", modes, by.inequality_18(P, gamma)), largest=_LARGEST_INEQUALITY)
        return _verdict(gamma, [self._inequality_17, self._of_P(last)])

    def exact(self, gamma: float, *, most: int = MOST_STEPS) -> Verdict:
        """(17), and the recursion until Y < g P, which it comes to within `most` steps."""
        if self.by_gramian is not None:
            modes, sign = self._problem.mode_names, self.by_gramian.sign(gamma)
            finding = found(GRAMIAN, modes, [sign] * len(modes))
            return _verdict(gamma, [_Answer(finding, self.by_gramian.name)])
        if self.P is None:
            return self._no_P(gamma)
        for P, costs in self._endings(gamma, min(most, _STEPS_OF_OTHERS)):
            answers = self._recursion(P, gamma, most=min(most, _STEPS_OF_OTHERS), costs=costs)
            if all(proved(answer.findings) or refuted(answer.findings) for answer in answers) and len(answers) > 2:
                return _verdict(gamma, answers)
        answers = self._recursion(self.P, gamma, most=most)
        if len(answers) > 2 or any(refuted(answer.findings) for answer in answers):
            return _verdict(gamma, answers)
        return _verdict(gamma, [*self._disproof(gamma), *answers])

    def _endings(self, gamma: float, most: int) -> Iterator[tuple[Array, Steering | None]]:
        """Beside the first P, what would end the recursion in so many steps as floats see it, the soonest first."""
        assert self.P is not None
        left: list[tuple[Array, Array, Steering | None]] = [(P, P, None) for P in reversed(self._invariants[1:])]
        if self._steering is not None:
            left = [(self._steering.P, self.P, self._steering), *left]
        if left:
            for Y in seen_by_floats(self._floats, gamma, most):
                for each in [each for each in left if seems_below(Y, each[0], gamma)]:
                    left = [other for other in left if other is not each]
                    yield each[1:]

    def _recursion(self, P: Array, gamma: float, *, most: int, costs: Steering | None = None) -> list[_Answer]:
        """(17), P > 0, and where both are proved the recursion with this P."""
        modes, answers = self._problem.mode_names, self._stability_by(P)
        if not all(proved(answer.findings) for answer in answers):
            return answers
        answer = self._ask(
            lambda by: recursion(by, modes, gamma, P, most=most, costs=costs), largest=_LARGEST_RECURSION
        )
        return [*answers, answer if costs is None else answer._replace(arithmetic=_with_costs(answer.arithmetic))]

    def at_least(self, gamma: float, *, most: int = MOST_STEPS_BELOW) -> str | None:
        """In which arithmetic it is proved that the exact gain is not below gamma; None: in none, in so many steps.

        Of errors that decay slowly the steps that take long are made last.
        """
        if self.by_gramian is not None:
            return self.by_gramian.name if self.by_gramian.sign(gamma).refuted else None
        if most <= _STEPS_BEFORE_LEAPS:
            return self.at_least_by_steps(gamma, most=most)
        return (
            self.at_least_by_costs(gamma)
            or self._fails(0, gamma, most=_STEPS_BEFORE_LEAPS)
            or self.at_least_by_leaps(gamma)
            or self.at_least_by_steps(gamma, most=most)
            or self.at_least_by_steps(gamma, most=_STEPS_OF_DISPROOF)  # in balls too
        )

    def at_least_by_costs(self, gamma: float) -> str | None:
        """The same where x decays slowly and is in eta, by what it costs to bring x somewhere."""
        costs, modes = self._steering, self._problem.mode_names
        if costs is None or not all(proved(answer.findings) for answer in self._stability):
            return None
        for k in range(len(self._makes)):
            by = self._arithmetic(k)
            if k and by.order > _LARGEST_RECURSION:
                break
            if disproof_by_costs(by, modes, gamma, costs, most=_STEPS_OF_OTHERS):
                return _with_costs(by.name)
        return None

    def at_least_by_leaps(self, gamma: float) -> str | None:
        """The same where errors decay slowly and are few, by a w = Gamma eta that is held."""
        known = (self._arithmetic(k) for k in range(len(self._makes)))
        by = next((by for by in known if isinstance(by, ByBalls) and by.bits >= _BITS_OF_LEAPS), None)
        radius = self._floats.model.decay.radius
        if by is None or by.unknowns > _LARGEST_LEAP or not SLOW < radius < 1.0:
            return None
        most, modes = int(_FORGOTTEN / (1.0 - radius)), self._problem.mode_names
        ways: list[tuple[float, Array | None]] = [(1.0, P) for P in self._floats.model.invariants[2:]]
        ways += [(share, None) for share in _SHARES] if by.unknowns <= _LARGEST_LEAP_OFTEN or not ways else []
        false = (disproof_by_leaps(by, modes, gamma, most=most, share=share, P=P) for share, P in ways)
        return by.name if any(finding is not None for finding in false) else None

    def at_least_by_steps(self, gamma: float, *, most: int) -> str | None:
        """The same, one step after the other; more than balls take are for floats alone."""
        found = self._fails(0, gamma, most=most)
        others = range(1, len(self._makes)) if most <= _STEPS_OF_DISPROOF else ()
        return found or next((name for k in others if (name := self._fails(k, gamma, most=most))), None)

    def _fails(self, k: int, gamma: float, *, most: int) -> str | None:
        """The name of the arithmetic in which a W of the recursion is proved not to be positive definite."""
        by = self._arithmetic(k)
        if k and by.order > _LARGEST_RECURSION:
            return None
        return None if disproof(by, self._problem.mode_names, gamma, most=most, P=self.P) is None else by.name

    def undisturbed(self, starts: Starts) -> float | None:
        """Above what eta(0) alone leaves of (E|z_tilde(k)|^2)^(1/2) at any step; None: not proved."""
        if self.P is None or not all(proved(answer.findings) for answer in self._stability):
            return None
        for by in (self._arithmetic(k) for k in range(len(self._makes))):
            few = isinstance(by, ByFloats) or by.order <= _LARGEST_RECURSION
            if few and isinstance(by, ByFloats | ByBalls) and (found := largest(by, self.P, starts)) is not None:
                return found
        return None

    @cached_property
    def stable(self) -> Stability:
        """By (17) and P > 0, or else by Z of `designer.decay`: Z - L(Z) > 0, and Z > 0 or some v'Z(s)v < 0."""
        if self.by_gramian is not None and self.by_gramian.dies_out:
            return Stability(True, self.by_gramian.name)
        if self.P is not None and all(proved(answer.findings) for answer in self._stability):
            return Stability(True, self._stability[0].arithmetic)
        Z, modes = self._floats.model.decay.total, self._problem.mode_names
        if Z is None:
            return Stability(None, self._floats.name)
        falls = self._ask(lambda by: found("Z > L(Z)", modes, by.decreasing(Z)), largest=_LARGEST_INEQUALITY)
        signs = self._ask(lambda by: found("Z > 0", modes, by.positive(Z)), largest=_LARGEST_INEQUALITY)
        arithmetic = "; ".join(dict.fromkeys([falls.arithmetic, signs.arithmetic]))
        if not proved(falls.findings):
            return Stability(None, arithmetic)
        return Stability(proved(signs.findings) or (False if refuted(signs.findings) else None), arithmetic)

    @property
    def _inequality_17(self) -> _Answer:
        return self._stability[0]

    @property
    def _stability(self) -> list[_Answer]:
        assert self.P is not None
        return self._stability_by(self.P)

    def _stability_by(self, P: Array) -> list[_Answer]:
        """(17) and P > 0."""
        if id(P) not in self._known:
            self._known[id(P)] = self._asked_of(P)
        return self._known[id(P)]

    def _asked_of(self, P: Array) -> list[_Answer]:
        modes = self._problem.mode_names
        answer = self._ask(lambda by: found("(17)", modes, by.inequality_17(P)), largest=_LARGEST_INEQUALITY)
        positive = self._ask(lambda by: found("P > 0", modes, by.positive(P)), largest=_LARGEST_INEQUALITY)
        return [self._of_P(answer), self._of_P(positive)]

    def _of_P(self, answer: _Answer) -> _Answer:
        """That a P which nobody claims is none says nothing of the claim."""
        if self._given is not None:
            return answer
        findings = [finding._replace(sign=finding.sign._replace(refuted=False)) for finding in answer.findings]
        return answer._replace(findings=findings)

    def _ask(self, question: Callable[[Arithmetic], list[Finding]], *, largest: int) -> _Answer:
        """The first answer that decides; else the last."""
        for k in range(len(self._makes)):
            by = self._arithmetic(k)
            answer = _Answer(question(by), by.name)
            if proved(answer.findings) or refuted(answer.findings) or answer.findings[-1].exhausted:
                break
            if isinstance(by, ByFloats) and by.order > largest and k + 1 < len(self._makes):
                more = f"(ball arithmetic, which sees further, is asked up to {largest} states of the errors)"
                return answer._replace(arithmetic=f"{by.name} {more}")
        return answer

    def _arithmetic(self, k: int) -> Arithmetic:
        while len(self._made) <= k:
            make = self._makes[len(self._made)]
            made = self._floats if make is ByFloats else make(self._problem, self._K, self._H, T=self.T)
            self._made.append(made)
        return self._made[k]

    def _disproof(self, gamma: float) -> list[_Answer]:
        by = self._arithmetic(0)
        false = disproof(by, self._problem.mode_names, gamma, most=_STEPS_OF_DISPROOF)
        return [] if false is None else [_Answer([false], by.name)]

    def _no_P(self, gamma: float) -> Verdict:
        answers = self._disproof(gamma)
        if answers:
            return _verdict(gamma, answers)
        why, stable = (
            "no P for (17) was found, and it is not known whether the errors are mean-square stable",
            self.stable,
        )
        if stable.holds is False:
            why = "the errors are not mean-square stable, which is proved: from some start they never die out"
        return Verdict(False, gamma, stable.arithmetic, why, {})


def _with_costs(arithmetic: str) -> str:
    return f"{arithmetic}, and what w has to spend in balls of {BITS_OF_COSTS} bits"


def _verdict(gamma: float, answers: Sequence[_Answer]) -> Verdict:
    findings = [finding for answer in answers for finding in answer.findings]
    false_first = sorted(answers, key=lambda answer: not refuted(answer.findings))
    why = next((text for answer in false_first if (text := failure(answer.findings, answer.arithmetic))), None)
    arithmetic = "; ".join(dict.fromkeys(answer.arithmetic for answer in answers))
    return Verdict(why is None, gamma, arithmetic, why, margins(findings))
