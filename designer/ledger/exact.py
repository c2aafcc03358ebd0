"""The exact account: the gain of the operators that really acted, and what jumps m have left.

    (E|z_tilde(k)|^2)^(1/2) <= gain(k) (E sum over j < k of |w(j)|^2)^(1/2) + sum over m of (E|z_tilde_m(k)|^2)^(1/2)

docs/theory.md, section 11. Faults are taken as they were: the means are over modes, losses and deliveries of the model.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from agent.contract.arrays import Array
from agent.contract.gains import Gains
from agent.contract.problem import Problem
from designer.coordinates import There
from designer.gain.exact import InvariantSet, Operator, lyapunov
from designer.gain.exact import step as backwards
from designer.ledger.deviation import AS_DESIGNED, Acting, Deviation, Models, Unabsorbed
from designer.ledger.promise import SHARE, VOID_ABOVE, Owed, Promise
from designer.model.error_model import error_model, stacked_links

_WIDTH = 1e-4  # relative width of a gain that is searched
_MEMORY = 64  # steps that are kept one by one, beside twice those that the recursion takes as designed
_MOST_STEPS = 5000  # of the recursion as designed, and of what jumps have left
_MOST_AHEAD = 200  # steps of a forecast of the gain
_LOOSE = 1e3  # of `Ledger._c`: it is then sought anew
_FORGOTTEN = 1e-9  # of what a jump was


class _Gone(NamedTuple):
    """A step that went by."""

    acting: Acting | None  # None: as designed
    c: float  # of `Ledger._c`, before it


@dataclass
class _Debt:
    what: str
    is_unit: bool
    X: Array  # (modes, n_eta, n_eta): E[eta_m eta_m'; r(k) = s]
    most: float  # the largest that its size has been


class Ledger:
    """Stands at a step k, from 0; is told what happens in it and of jumps; steps; and says what the bound says.

    `gamma` bounds the gain of these gains as designed, and P (modes, n_eta, n_eta) satisfies (17). All of that is of
    [T x; T e] where T is given; jumps are of [x; e].
    """

    def __init__(
        self, problem: Problem, K_bar: Array, H_bar: Array, *, gamma: float, P: Array, T: Array | None = None
    ) -> None:
        self._T = T
        self.models, self.gamma, self.k = Models(problem, K_bar, H_bar), gamma, 0
        self._g, self._P = gamma**2 * (1.0 + 1e-9), P  # a rounding above: to hold at it is to be valid
        self._set = InvariantSet(P)
        self._root_inverse = np.linalg.inv(np.linalg.cholesky(P))
        self._now = AS_DESIGNED
        self._past: list[_Gone] = []  # the last step first
        self._c = 1.0  # E eta'P eta <= c times the energy so far; 1 as designed
        self._is_cut = False  # steps before `_past` were not all as designed
        self._debts: list[_Debt] = []
        self._void: tuple[str, int] | None = None

    @classmethod
    def of(cls, gains: Gains) -> Ledger:
        """For what the certificate of a gains file claims; where that stores no P, one is made here, in floats."""
        from designer.proof.certificate import lyapunov_matrix  # loads ball arithmetic

        problem, K, H, T = There(gains.problem, gains.K, gains.H, None)
        P = None
        if gains.certificate.form == "summed":
            problem, K, H, T = There.of(problem, K, H)
            P, _ = lyapunov(Operator(error_model(problem, *stacked_links(problem, K, H))))
        if P is None:
            P = lyapunov_matrix(gains)
        of_links = stacked_links(problem, K, H)
        return cls(problem, *of_links, gamma=gains.certificate.gamma, P=(P + P.swapaxes(1, 2)) / 2.0, T=T)

    def anew(self, k: int) -> Ledger:
        """One of the same network that stands at step k, and has been told nothing."""
        models = self.models
        other = Ledger(models.problem, models.K_bar, models.H_bar, gamma=self.gamma, P=self._P, T=self._T)
        other.models, other.k = models, k  # the models that were made
        return other

    # what it is told
    def tell(self, deviation: Deviation) -> None:
        """What happens in this step, from its first moment on. What no model describes makes the bound void."""
        try:
            self.models.acting(deviation)
        except Unabsorbed as why:
            self.void(str(why))
            return
        self._now = deviation

    def jump(self, covariance: Array, what: str, *, is_unit: bool = False) -> None:
        """eta moves now: by what has this second moment, by mode (modes, n_eta, n_eta), or at most that.

        For a delta that is known, delta delta' in the mode of this step. `is_unit`: the length of it is not known,
        and `covariance` is for length 1.
        """
        if self._T is not None:
            whole = np.kron(np.eye(covariance.shape[1] // len(self._T)), self._T)
            covariance = whole @ covariance @ whole.T
        self._debts.append(_Debt(what, is_unit, covariance, self._size(covariance)))

    def void(self, reason: str) -> None:
        """From now on nothing is promised."""
        if self._void is None:
            self._void = (reason, self.k)

    def step(self) -> None:
        """The step goes by."""
        acting = None if self._now.is_as_designed else self.models.acting(self._now)
        for debt in self._debts:
            debt.X = self._carried(debt.X, acting)
        if acting is not None or self._past:
            self._past.insert(0, _Gone(acting, self._c))
            self._c = self._grown(acting, self._c)
        self.k, self._now = self.k + 1, AS_DESIGNED
        if self._c > _LOOSE:
            self._c = self._sought()
        if len(self._past) > self._memory:
            self._past.pop()
            self._is_cut = True
        for debt in self._debts:
            debt.most = max(debt.most, self._size(debt.X))
        self._debts = [debt for debt in self._debts if self._size(debt.X) > _FORGOTTEN * debt.most]

    # what it says
    @property
    def is_void(self) -> bool:
        """For good: not where the gain is too large just now."""
        return self._void is not None

    def gain(self) -> float:
        """The least gain to z_tilde now that the recursion proves, gamma at least."""
        return math.sqrt(self._least()) if self._is_marked else self.gamma

    def owed(self) -> float:
        """The sum of what jumps of known size have left."""
        return sum(self._size(debt.X) for debt in self._debts if not debt.is_unit)

    def bound(self, energy: float) -> float:
        """Of (E|z_tilde(k)|^2)^(1/2), where E sum over j < k of |w(j)|^2 is `energy` or less; inf where void."""
        return math.inf if self._void else self.gain() * math.sqrt(energy) + self.owed()

    def promise(self) -> Promise:
        """All of it."""
        reason, since = self._void or ("", None)
        if self._void is not None:
            return Promise("void", self.gamma, math.inf, None, (), reason, since)
        factor = self.gain() / self.gamma
        if factor > VOID_ABOVE:
            reason = f"after these faults the gain is more than {VOID_ABOVE:g} times gamma"
            return Promise("void", self.gamma, factor, self._within(), (), reason, self.k)
        owed = tuple(
            Owed(debt.what, self._size(debt.X), debt.is_unit, self._fades(debt))
            for debt in self._debts
            if self._size(debt.X) > SHARE * debt.most
        )
        within = self._within() if factor > 1.0 + SHARE else 0
        status = "valid plus" if owed or factor > 1.0 + SHARE else "valid"
        return Promise(status, self.gamma, factor, within, owed, "", None)

    @property
    def _is_marked(self) -> bool:
        """Whether something is not as designed, so that a search is due."""
        return bool(self._past) or not self._now.is_as_designed

    # the recursion backwards
    @cached_property
    def _memory(self) -> int:
        Y, steps = self.models.designed.MM, 0
        while steps < _MOST_STEPS and not self._set.contains(Y, self._g):
            taken = backwards(self.models.designed, Y, self._g)
            if taken is None:
                break
            Y, steps = taken.Y, steps + 1
        return _MEMORY + 2 * steps

    def _least(self) -> float:
        low = high = self._g
        if self._holds(low):
            return self.gamma**2
        while not self._holds(high):
            low, high = high, high * 2.0
            if high > 4.0 * VOID_ABOVE**2 * self._g:
                return math.inf
        while high > low * (1.0 + _WIDTH):
            middle = math.sqrt(low * high)
            low, high = (low, middle) if self._holds(middle) else (middle, high)
        return high

    def _holds(self, g: float, later: int = 0) -> bool:
        """Whether E|z_tilde(k)|^2 <= g times the energy, or that of `later` steps as designed after this one."""
        now = self.models.acting(self._now)
        if not later:
            return self._ends(now.before(now.MM), g)
        return self._ends(self._back(self.models.designed.MM, g, [None] * (later - 1) + [now]), g)

    def _ends(self, Y: Array | None, g: float, first: int = 0) -> bool:
        """Whether the recursion from Y, `first` steps ago, comes to Y <= g P / c, so that all before is bounded."""
        for m in range(first, len(self._past) + 1):
            c = self._past[m - 1].c if m else self._c
            if Y is None or self._set.contains(Y, g / c):
                return Y is not None
            if m < len(self._past):
                Y = self._back(Y, g, [self._past[m].acting])
        for _ in range(0 if self._is_cut else _MOST_STEPS):
            if Y is None or self._set.contains(Y, g):
                return Y is not None
            Y = self._back(Y, g, [None])
        return False

    def _back(self, Y: Array | None, g: float, past: Sequence[Acting | None]) -> Array | None:
        for acting in past:
            taken = None if Y is None else backwards(acting.operator if acting else self.models.designed, Y, g)
            Y = None if taken is None else acting.before(taken.Y) if acting else taken.Y
        return Y

    def _for_good(self, g: float, later: int) -> bool:
        """Whether g holds at every later step too, if all goes as designed.

        Once Y <= c P in the steps as designed since the last fault, it is in all further ones, since c P is invariant
        for c <= g; and if the recursion comes from c P through the faults, it does from any such Y.
        """
        if self._now.is_as_designed:
            last = next((m for m, gone in enumerate(self._past) if gone.acting is not None), len(self._past))
            Y = self._back(self.models.designed.MM, g, [None] * (later + last))
        elif later:
            last, Y = 0, self._back(self.models.designed.MM, g, [None] * (later - 1))
        else:
            return False
        if Y is None or (c := self._against_P(Y)) > g:
            return False
        through = [] if self._now.is_as_designed else [self.models.acting(self._now)]
        return self._ends(self._back(c * self._P, g, through), g, last)

    def _within(self) -> int | None:
        """The first of the steps to come from which on the gain is below (1 + SHARE) gamma."""
        g, first = self._g * (1.0 + SHARE) ** 2, 0
        for later in range(_MOST_AHEAD):
            if self._for_good(g, later):
                return first
            if not self._holds(g, later):
                first = later + 1
        return None

    # what P says of the past
    def _sought(self) -> float:
        """The least c, within a fifth, with E eta'P eta <= c times the energy so far, by the recursion from P."""
        low, high = 1.0, self._c
        while high > 1.2 * low:
            middle = math.sqrt(low * high)
            low, high = (low, middle) if self._ends(self._P, middle) else (middle, high)
        return high

    def _against_P(self, Y: Array) -> float:
        """The least c with Y <= c P in every mode."""
        return _largest(self._root_inverse @ Y @ self._root_inverse.swapaxes(1, 2))

    def _grown(self, acting: Acting | None, before: float) -> float:
        """The least c with E eta'P eta <= c times the energy after a step, where that held with `before`."""
        if acting is None and before == 1.0:
            return before
        operator: Operator = acting.operator if acting else self.models.designed
        if acting is not None and acting.J is not None:
            before *= max(1.0, self._against_P(acting.before(self._P)))
        S, n = operator.joint(operator.bar(self._P)), operator.size
        S[:, :n] = self._root_inverse @ S[:, :n]
        S[:, :, :n] = S[:, :, :n] @ self._root_inverse.swapaxes(1, 2)
        scale = np.concatenate([np.full(n, math.sqrt(before)), np.ones(operator.nw)])
        return max(1.0, _largest(S * scale[:, None] * scale))

    # jumps
    def _size(self, X: Array) -> float:
        now = self.models.acting(self._now)
        return math.sqrt(max(float(np.einsum("sij,sij->", now.before(now.MM), X)), 0.0))

    def _carried(self, X: Array, acting: Acting | None) -> Array:
        operator = acting.operator if acting else self.models.designed
        n = operator.size
        joint = np.zeros((len(X), n + operator.nw, n + operator.nw))
        joint[:, :n, :n] = acting.after(X) if acting else X
        return operator.carry(joint)

    def _fades(self, debt: _Debt) -> int | None:
        """Steps as designed until the debt is below SHARE of its most, for good as far as it was followed."""
        first = None
        for later, size in enumerate(self._sizes(debt.X)):
            if size > SHARE * debt.most:
                first = None
            elif first is None:
                first = later
            if size < 0.1 * SHARE * debt.most:
                return first
        return None

    def _sizes(self, X: Array) -> Iterator[float]:
        MM = self.models.designed.MM
        for later in range(_MOST_STEPS):
            yield math.sqrt(max(float(np.einsum("sij,sij->", MM, X)), 0.0))
            X = self._carried(X, None if later else self.models.acting(self._now))


def _largest(Y: Array) -> float:
    return float(np.linalg.eigvalsh((Y + Y.swapaxes(1, 2)) / 2.0).max())
