"""The exact gain of given gains: the least gamma of which sup_k E|z_tilde(k)|^2 <= gamma^2 E sum |w|^2 is true.

w(k) may depend on the modes r(0..k) and on everything before step k, but not on what gets lost in step k or on later
modes; the initial mode is any, the initial error is 0. That is the class that Theorem 1 covers. docs/theory.md,
sections 1 to 3, derives what is written here; the letters are those of eqs. (10)(11), and g stands for gamma^2.
In comments and docstrings B'Y_bar B and B'Y_bar A are the blocks of `Operator.joint`, chance within.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from agent.contract.arrays import Array
from designer.decay import Decay, decay
from designer.gain.alone import Alone
from designer.gain.products import Collected, Pattern, Products
from designer.invariants import Invariants, Outweighed, Threshold, invariants, scaled
from designer.model.error_model import ErrorModel
from designer.model.links import LinkTerms
from designer.model.units import natural_scale
from designer.patience import look
from designer.steered import Steered

_WIDTH = 1e-6  # relative width of the bracket of gamma^2
_WIDTH_OF_LARGE = 1e-4  # where a sweep takes 10 s and more, and one that holds near gamma several times as many steps
_LARGE = 900  # n_eta from which that is so
_WIDTH_OF_NODES = 1e-4
_UNSTABLE_HORIZON = 30  # where no horizon suffices
_MOST_STEPS = 20_000
_TRIALS_AROUND = 4  # on each side of where these do not decide
_FREED = 3_900_000  # numbers, 31 MB: see `exact_gain`


class Gain(NamedTuple):
    """gamma lies in [low, high]: at low^2 the recursion is known to fail by `horizon` steps, at high^2 it never does.

    Where the error system is not mean-square stable, no finite bound is proved: high is infinite, P is None. Where
    chance has no say there is no recursion to end, and no P either.
    """

    low: float
    high: float
    horizon: int
    P: Array | None  # (modes, n_eta, n_eta), satisfies (17) strictly; in its invariant set the recursion ends
    radius: float  # spectral radius of the operator L of `Operator.corner`: what E|eta|^2 is multiplied by, per step
    digits: int = 9  # of it that are known

    @property
    def rate(self) -> str:
        """The same for people."""
        return f"{self.radius:.{min(self.digits, 6)}g}"

    @property
    def stable(self) -> bool:
        """Whether the error system is mean-square stable."""
        return math.isfinite(self.high)

    @property
    def bounds(self) -> tuple[float, float] | None:
        """The interval that the exact gain lies in; None where the errors are not mean-square stable."""
        return (self.low, self.high) if self.stable else None


class Operator:
    """The matrices of (10)(11) in the shapes that the recursions multiply by.

    `pattern`: where they may have numbers; without one, where these have.
    """

    def __init__(self, model: ErrorModel, pattern: Pattern | None = None) -> None:
        modes, size = model.modes, model.size
        self.products = Products(model, Pattern(model) if pattern is None else pattern)
        self.links = None if model.links is None else _Links(model.links, modes, size + model.nw, model.plant_states)
        self.MM = np.broadcast_to(model.M.T @ model.M, (modes, size, size))
        self.model, self.M = model, model.M
        self.transition = model.transition / model.transition.sum(axis=1, keepdims=True)
        self.p, self.size, self.nw = model.plant_states, size, model.nw
        self.eye_w = np.eye(self.nw)
        self.units = natural_scale(model)

    def bar(self, Y: Array) -> Array:
        """Y_bar(s) = sum_t pi_st Y(t), (modes, n_eta, n_eta)."""
        return np.asarray((self.transition @ Y.reshape(len(Y), -1)).reshape(Y.shape))

    def joint(self, Y_bar: Array) -> Array:
        """[A B]'Y_bar[A B] with the sum of alpha_i F_i'Y_bar F_i, and as much of links: what E|eta(k+1)|^2 weighs.

        Y_bar is symmetric; the result is (modes, n_eta + nw, n_eta + nw).
        """
        look()
        S = self.products.joint(Y_bar)
        if self.links is not None:
            self.links.add(S, Y_bar)
        return S

    def of(self, Y: Array) -> Array:
        """S(Y), (modes, n_eta + nw, n_eta + nw)."""
        return self.joint(self.bar(Y))

    def corner(self, Y: Array) -> Array:
        """L(Y) = A'Y_bar A + sum of alpha_i F_i'Y_bar F_i, the mean of Y one step later, (modes, n_eta, n_eta)."""
        return self.joint(self.bar(Y))[:, : self.size, : self.size]

    def carry(self, joint: Array, collected: Collected | None = None, Y_bar: Array | None = None) -> Array:
        """E[eta(k+1) eta(k+1)'; r(k+1)] by mode, (modes, n_eta, n_eta), from `joint`, that of [eta; w] at k.

        The adjoint of L: `joint` has E[[eta; w][eta; w]'; r(k) = s] for every s, (modes, n_eta + nw, n_eta + nw).
        `collected` gets the derivatives of what Y_bar weighs, but for those by the links.
        """
        look()
        X = self.products.carry(joint, collected, Y_bar)
        if self.links is not None:
            self.links.carry(X, joint)
        return np.asarray((self.transition.T @ X.reshape(len(X), -1)).reshape(X.shape))


class _Links:
    """What lossy links add to `Operator.joint`: V_l'Y_bar V_l for every term, at its columns."""

    def __init__(self, links: LinkTerms, modes: int, order: int, p: int) -> None:
        nx = links.V.shape[1]
        self.roots = np.sqrt(links.variance)[:, None, None]
        self.V = self.roots * links.V
        self.V_T = np.ascontiguousarray(self.V.swapaxes(1, 2))
        rows = p + links.receiver[:, None] * nx + np.arange(nx)  # (terms, nx)
        self.block = links.mode[:, None, None], rows[:, :, None], rows[:, None, :]
        self.columns = links.mode[:, None, None], links.columns[:, :, None], links.columns[:, None, :]
        at = (links.mode[:, None, None] * order + links.columns[:, :, None]) * order + links.columns[:, None, :]
        self.at = at.reshape(-1)  # where the entries of all terms go

    def add(self, S: Array, Y_bar: Array) -> None:
        """In place."""
        terms = self.V_T @ (Y_bar[self.block] @ self.V)  # (terms, c, c)
        S += np.bincount(self.at, weights=terms.reshape(-1), minlength=S.size).reshape(S.shape)

    def carry(self, X: Array, joint: Array) -> None:
        """Add V_l cov V_l' to the covariance X of eta one step later, in place; joint is that of [eta; w]."""
        np.add.at(X, self.block, self.V @ (joint[self.columns] @ self.V_T))

    def by_V(self, Y_bar: Array, joint: Array) -> Array:
        """Derivative of sum tr(V_l'Y_bar V_l cov) by every V_l, (terms, nx, c)."""
        return np.asarray(2.0 * self.roots * (Y_bar[self.block] @ (self.V @ joint[self.columns])))


class Step(NamedTuple):
    """One step of the recursion backwards, for w = Gamma eta, which is worst in it."""

    Y_bar: Array  # (modes, n_eta, n_eta): what weighs eta(k+1)
    W_inverse: Array  # (modes, nw, nw), W = g I - B'Y_bar B
    Gamma: Array  # (modes, nw, n_eta): W^-1 B'Y_bar A
    log_det: Array  # (modes,): of W / g
    Y: Array  # (modes, n_eta, n_eta): what weighs eta(k)


def step(operator: Operator, Y: Array, g: float) -> Step | None:
    """Y <- L(Y) + A'Y_bar B W^-1 B'Y_bar A; None where a W is not positive definite."""
    Y_bar, size = operator.bar(Y), operator.size
    S = operator.joint(Y_bar)
    factored = _factored(operator.eye_w - S[:, size:, size:] / g)
    if factored is None:
        return None
    inverse, log_det = factored
    W_inverse = inverse / g
    Gamma = W_inverse @ S[:, size:, :size]
    return Step(Y_bar, W_inverse, Gamma, log_det, S[:, :size, :size] + S[:, :size, size:] @ Gamma)


def _factored(W: Array) -> tuple[Array, Array] | None:
    """W^-1 and log det W of every mode, (modes, nw, nw) and (modes,); None where a W is not positive definite."""
    if W.shape[-1] == 1:  # the same, in a fifth of the time
        return (1.0 / W, np.log(W[:, 0, 0])) if (W > 0.0).all() else None
    try:
        L = np.linalg.cholesky(W)
    except np.linalg.LinAlgError:
        return None
    L_inverse = np.linalg.inv(L)
    return L_inverse.swapaxes(1, 2) @ L_inverse, 2.0 * np.log(L.diagonal(axis1=1, axis2=2)).sum(axis=1)


class InvariantSet:
    """All Y <= g P, for a P that satisfies (17): once in it, the recursion at g holds over any horizon.

    (17) says that a step leads from g P to no more than g P, with W positive definite; and less Y leads to less, with
    a larger W. Of several P, each has its set.
    """

    def __init__(self, *P: Array, thresholds: Sequence[Threshold | Outweighed] = ()) -> None:
        self.P, self.thresholds = P, thresholds  # each P (modes, n_eta, n_eta)

    @classmethod
    def of(cls, known: Invariants) -> InvariantSet:
        """All that is known."""
        of_x = [] if known.of_x is None else [known.of_x]
        return cls(*known.P, *(each.P for each in of_x), thresholds=[*of_x, *known.thresholds])

    def contains(self, Y: Array, g: float) -> bool:
        """Cholesky decides."""
        return any(_positive(g * P - Y) for P in self.P)

    def never_reached(self, Y: Array, g: float) -> bool:
        """Whether it is known that the recursion fails sooner or later."""
        return any(threshold.passed(Y, g) for threshold in self.thresholds)


def _positive(Y: Array) -> bool:
    try:
        return bool(np.isfinite(np.linalg.cholesky(Y)).all())
    except np.linalg.LinAlgError:
        return False


class Trial(NamedTuple):
    """The recursion at one g."""

    holds: bool | None  # None: it has not come to its end
    measure: float  # sum over steps of min_s log det(W / g): how far it is from failing
    steps: int


def recursion_holds(
    operator: Operator,
    g: float,
    horizon: int,
    *,
    invariant: InvariantSet | None = None,
) -> Trial:
    """Whether gamma_T^2 <= g, T = horizon: whether every W is positive definite.

    With an invariant set the question is whether gamma^2 <= g; it is looked for every now and then, so that looking
    takes a sixteenth more steps, not as long as they.
    """
    Y, measure, next_look = operator.MM, 0.0, 1
    for steps in range(1, horizon + 1):
        taken = step(operator, Y, g)
        if taken is None:
            return Trial(False, -math.inf, steps)
        Y, measure = taken.Y, measure + float(taken.log_det.min())
        if invariant is not None and steps >= next_look:
            if invariant.contains(Y, g):
                return Trial(True, measure, steps)
            if invariant.never_reached(Y, g):
                return Trial(False, -math.inf, steps)
            next_look = steps + 1 + steps // 16
    return Trial(True if invariant is None else None, measure, horizon)


def invariant_set(operator: Operator, decays: Decay | None = None) -> InvariantSet:
    """In which recursions end; without P where floats find none. `decays`: of this operator, where it is known."""
    if decays is None:
        decays = decay(operator.corner, len(operator.MM), operator.units, operator.model.moves)
    model, p = operator.model, operator.p
    steered = Steered(model.A[0, :p, :p], model.B[0, :p]) if p else None
    known = invariants(operator.of, decays, operator.units, np.asarray(operator.MM), steered)
    return InvariantSet.of(known)


@np.errstate(over="ignore", invalid="ignore")  # gains of any size: what overflows is not stable
def exact_gain(model: ErrorModel, *, width: float | None = None) -> Gain:
    """The exact gain of an error model, between bounds that differ by `width` of its square where steps suffice.

    None: 1e-6, of large networks 1e-4.
    """
    alone = Alone.of(model)
    if alone is not None:
        return Gain(*alone.gain(model.M), alone.horizon(model.M), None, alone.radius)
    np.empty(_FREED)  # glibc keeps blocks up to the largest that was freed: no step waits for the system's memory
    operator = Operator(model)
    decays = decay(operator.corner, len(operator.MM), operator.units, operator.model.moves)
    invariant = invariant_set(operator, decays)
    if not invariant.P:
        low, _ = horizon_gain(operator, _UNSTABLE_HORIZON)
        return Gain(math.sqrt(low), math.inf, _UNSTABLE_HORIZON, None, *decays.rate)
    if width is None:
        width = _WIDTH if model.size < _LARGE else _WIDTH_OF_LARGE
    found = _bracket(operator, _MOST_STEPS, invariant, width)
    return Gain(math.sqrt(found.low), math.sqrt(found.high), found.horizon, invariant.P[0], *decays.rate)


@np.errstate(over="ignore", invalid="ignore")
def node_gains(model: ErrorModel, *, most: float = math.inf) -> list[tuple[float, float]] | None:
    """The exact gain to every node's own error z - z_hat_i, [low, high] each, with the gains of all as they are.

    M is replaced by the rows of that node; P is of the whole network, since (17) does not know M. None: not stable, or
    more work than `most`: numbers of Y for every node, as many times as errors take steps to decay.
    """
    alone, of_nodes = Alone.of(model), np.split(model.M, len(model.rows))
    if alone is not None:
        return [alone.gain(M) for M in of_nodes]
    operator = Operator(model)
    work = len(model.rows) * operator.MM.size
    if work > most:
        return None
    decays = decay(operator.corner, model.modes, operator.units, operator.model.moves)
    if math.isfinite(most) and work > most * (1.0 - decays.radius):
        return None
    invariant = invariant_set(operator, decays)
    if not invariant.P:
        return None
    found = []
    for M in of_nodes:
        operator.MM = np.broadcast_to(M.T @ M, operator.MM.shape)
        bracket = _bracket(operator, _MOST_STEPS, invariant, _WIDTH_OF_NODES)
        found.append((math.sqrt(bracket.low), math.sqrt(bracket.high)))
    return found


@np.errstate(over="ignore", invalid="ignore")
def horizon_gain(operator: Operator, horizon: int, *, width: float = _WIDTH) -> tuple[float, float]:
    """[low, high] around gamma_T^2, of relative width `width`: the recursion fails at low and holds at high."""
    found = _bracket(operator, horizon, None, width)
    return found.low, found.high


class _Bracket(NamedTuple):
    low: float
    high: float
    horizon: int  # in which the recursion fails at low


def _bracket(operator: Operator, horizon: int, invariant: InvariantSet | None, width: float) -> _Bracket:
    """Where the recursion fails, and where it holds.

    As g falls to gamma_T^2, the product of all W falls to 0 like (g - gamma_T^2)^p. Three values of g at which the
    recursion held give p and the root; where that leads nowhere, g is tried a fifth above low. Where it has not come
    to its end at some g, the bracket stays wider.
    """
    low, steps, growth, tiny, first = 0.0, 1, 2.0, float(np.finfo(float).tiny), _impulse(operator)  # first: one step's
    g = growth * max(first, tiny)
    held: list[tuple[float, float]] = []  # (g, log of the product of all W), falling
    while not held or held[-1][0] > max(low * (1.0 + 1.001 * width), 2.0 * tiny):
        if not math.isfinite(g):
            return _Bracket(low, math.inf, steps)
        trial = recursion_holds(operator, g, horizon, invariant=invariant)
        if trial.holds:
            held = [*held[-2:], (g, trial.measure)]
        elif trial.holds is False:
            low, steps, growth = g, trial.steps, growth * growth
        elif held:
            return _around(operator, horizon, invariant, _Bracket(max(low, 0.5 * first), held[-1][0], steps), g)
        g = _next_trial(low, held, width, fit=bool(trial.holds)) if held else growth * g
    return _Bracket(max(low, 0.5 * first), held[-1][0], steps)


def _around(
    operator: Operator, horizon: int, invariant: InvariantSet | None, bracket: _Bracket, undecided: float
) -> _Bracket:
    """A narrower bracket around a g at which the recursion has not come to its end: farther away it ends earlier."""
    (low, high, steps), least, most = bracket, undecided, undecided
    for _ in range(_TRIALS_AROUND):
        g = math.sqrt(low * least)
        trial = recursion_holds(operator, g, horizon, invariant=invariant)
        if trial.holds is False:
            low, steps = g, trial.steps
        else:
            least = g
    for _ in range(_TRIALS_AROUND):
        g = math.sqrt(most * high)
        if recursion_holds(operator, g, horizon, invariant=invariant).holds:
            high = g
        else:
            most = g
    return _Bracket(low, high, steps)


def _next_trial(low: float, held: list[tuple[float, float]], width: float, *, fit: bool) -> float:
    """Where to try g next, strictly inside the bracket: at the fitted root, or a fifth above low after that failed."""
    (high, measure), least = held[-1], 0.4 * width
    root = None
    if fit and measure < 0.0:  # else g is so large that the log of W is 0
        root = _root(low, held) if len(held) == 3 else -high * math.expm1(measure)  # as if one W did it all
    if high - low < 8.0 * width * high:  # close the bracket from the other side
        root = (root or low) if high > low * (1.0 + 3.0 * least) else None
    if root is None:
        return low + 0.2 * (high - low)  # fits fall short by little; and to fail takes fewer steps than to hold
    if high < root * (1.0 + least):
        root = high * (1.0 - 2.0 * least)
    elif low > root * (1.0 - least):
        root = low * (1.0 + 2.0 * least)
    return min(max(root, low * (1.0 + least)), high * (1.0 - least))


def _root(low: float, held: list[tuple[float, float]]) -> float | None:
    """r of measure = a + p log(g - r) through three points (g, measure); None if there is none above `low`."""
    (g1, m1), (g2, m2), (g3, m3) = held

    def excess(r: float) -> float:
        return math.log((g1 - r) / (g2 - r)) * (m2 - m3) - math.log((g2 - r) / (g3 - r)) * (m1 - m2)

    left, right = low, g3 * (1.0 - 1e-15)
    if not (m1 > m2 > m3 and excess(left) > 0.0 > excess(right)):
        return None
    for _ in range(50):
        middle = (left + right) / 2.0
        left, right = (middle, right) if excess(middle) > 0.0 else (left, middle)
    return left


def _impulse(operator: Operator) -> float:
    """gamma_1^2: the gain of one step of w."""
    S_ww = operator.joint(operator.MM)[:, operator.size :, operator.size :]
    return float(np.linalg.eigvalsh(S_ww).max()) if np.isfinite(S_ww).all() else math.inf


def lyapunov(operator: Operator) -> tuple[Array | None, Decay]:
    """P(s) that satisfies (17) strictly, (modes, n_eta, n_eta), and what is known of L.

    P0 > 0 with V = P0 - L(P0) > 0 is that of `designer.decay`. By Schur's complement c P0 satisfies (17) if and only if
    I > c (B'P0_bar B + B'P0_bar A V^-1 A'P0_bar B). P is None where floats find no such P0.
    """
    found = decay(operator.corner, len(operator.MM), operator.units, operator.model.moves)
    if found.total is None or found.rest is None or not found.dies_out:
        return None, found
    return scaled(operator.of, found.total, found.rest), found
