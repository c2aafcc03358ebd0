"""What no gains can undercut by Theorem 2, a lower bound by duality, with the weights that prove it.

designer.proof.least proves it from them. The multipliers of the LMI's balance are the best weights, up to a solver's
tolerance. So they are mixed with a little of weights that have much to spare: the moments of a network under white
noise, each of whose nodes takes the gains of least variance, and of which a part is forgotten in every step. The LMI is
solved for states in which these moments are near the identity: there, what a solver misses is as small beside them in
every direction. Where a design has solved the LMI in states of its own, its multipliers are tried first.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from agent.contract.arrays import Array
from agent.contract.gains import Weights
from agent.contract.problem import Problem
from designer.coordinates import Coordinates
from designer.lmi import conic, decomposed
from designer.lmi.attempts import SOLVED
from designer.lmi.cones import Indices
from designer.model.units import NaturalUnits, Units
from designer.patience import look
from designer.proof.least import at_least
from designer.proof.reachable import between, on_reachable
from designer.proof.silent import at_least_by_silence
from designer.search.effort import in_words
from designer.search.starts import Greedy

_KEPT, _APART = 0.3, 0.3  # of moments in each step; and of those of each error once more, but of no two together
_AT_FIRST = (1e-3, 0.0)  # of them: errors that feed themselves are there or not, and either may have more to spare
_STEPS, _SETTLED, _BOUNDLESS = 300, 1e-5, 1e100
_NOTHING = 1e-9  # of the largest moments: w does not reach this error in this mode
_SPARE = (1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 0.1)  # of the weights, those that have much to spare
_DIGITS = 3  # of the weights in a file, more than that part has
_LITTLE = 1e-5  # of that, beside which better weights are not worth a solver's time
_OF_SQUARES = 1.5e-6  # seconds that a solver takes, over the squares of the numbers in a matrix of each inequality


class Undercut(NamedTuple):
    """gamma that no gains are below by the LMI, proved by `weights`, or by none; or None, and why."""

    gamma: float | None
    weights: Weights | None = None
    why_not: str | None = None


class _Seen(NamedTuple):
    """A problem nearly as it is seen from T (r, nx), and weights (modes, n_eta + nw, n_eta + nw) with much to spare."""

    problem: Problem
    T: Array
    spare: Array


def undercut(problem: Problem, *, offered: Weights | None = None, seconds: float = math.inf) -> Undercut:
    """The largest that is proved.

    `offered`: multipliers of an LMI that was solved in other states, perhaps as good as better ones. These take a
    solver; where it is estimated to take more `seconds`, they are not sought.
    """
    silent = at_least_by_silence(problem)
    try:
        found = _by_weights(problem, offered, seconds)
    except np.linalg.LinAlgError as error:
        found = Undercut(None, why_not=f"floats found no weights: {error}")
    return Undercut(silent) if silent is not None and silent >= (found.gamma or 0.0) else found


def _by_weights(problem: Problem, offered: Weights | None, seconds: float) -> Undercut:
    numbers = decomposed.numbers_of_weights(problem)
    if numbers > decomposed.MOST_WEIGHTS:
        why = f"it takes {numbers} weights, and a file keeps at most {decomposed.MOST_WEIGHTS}"
        return Undercut(None, why_not=why)
    found = Undercut(None, why_not="no weights have anything to spare")
    for seen in (_seen(problem, at_first) for at_first in _AT_FIRST):
        if seen is not None and np.isfinite(seen.T).all():
            found = _seen_so(problem, seen, offered, seconds)
        if found.gamma is not None:
            break
    return found


def _seen_so(problem: Problem, seen: _Seen, offered: Weights | None, seconds: float) -> Undercut:
    V = None if offered is None else _moved(problem, offered, seen.T)
    found = Undercut(None) if V is None else _mixed(problem, seen, V, most=_LITTLE)
    if found.gamma is not None:
        return found
    lmi = decomposed.assemble(seen.problem)
    estimated = _OF_SQUARES * sum((cone * (cone + 1) / 2) ** 2 for cone in lmi.cones.orders)
    if estimated <= seconds:
        found = _solved(problem, seen, lmi)
    else:
        why = f"better weights would take about {in_words(estimated)}, which a larger --budget allows"
        found = Undercut(None, why_not=why)
    further = Undercut(None) if V is None or found.gamma is not None else _mixed(problem, seen, V)
    return found if further.gamma is None else further


def _solved(problem: Problem, seen: _Seen, lmi: decomposed.Lmi) -> Undercut:
    objective = np.zeros(lmi.cones.A.shape[1])
    objective[lmi.delta] = 1.0
    answer = conic.clarabel(lmi.cones.without(_unreached(seen, lmi)), objective)
    if answer.record.status not in SOLVED or answer.z is None:
        return Undercut(None, why_not=f"the LMI was not solved ({answer.record.status})")
    units = Units(np.ones(seen.problem.nx), 1.0)
    return _mixed(problem, seen, decomposed.multipliers(seen.problem, lmi, answer.z, units))


def _unreached(seen: _Seen, lmi: decomposed.Lmi) -> dict[int, Indices]:
    """The rows of the balance on errors that w does not reach, of the inequalities of these numbers."""
    r, p, found = seen.problem.nx, seen.problem.plant_states, dict[int, Indices]()
    for s, mode in enumerate(lmi.modes):
        live = seen.spare[s].any(axis=1)
        for piece in mode.balance:
            dead = [piece.at[v][:r] for v in piece.at if v and not live[p + (v - 1) * r : p + v * r].any()]
            if dead:
                found[piece.matrix.number] = np.concatenate(dead)
    return found


def _moved(problem: Problem, weights: Weights, T: Array) -> Array | None:
    """The weights, of states T x."""
    V = weights.matrices(problem.mode_names)
    try:
        S = between(weights.states, T)
    except ZeroDivisionError:
        return None
    blocks = [S] * ((V.shape[1] - problem.nw) // problem.nx)
    whole = np.zeros((sum(len(block) for block in blocks) + problem.nw, V.shape[1]))
    for k, block in enumerate(blocks):
        whole[k * len(S) : (k + 1) * len(S), k * problem.nx : (k + 1) * problem.nx] = block
    whole[len(whole) - problem.nw :, V.shape[1] - problem.nw :] = np.eye(problem.nw)
    return np.asarray(whole @ V @ whole.T)


def _mixed(problem: Problem, seen: _Seen, V: Array, *, most: float = math.inf) -> Undercut:
    """With as little of those that have much to spare, and as few digits, as prove anything; with no more than that."""
    w = slice(V.shape[1] - problem.nw, None)
    spare = np.where(V != 0.0, seen.spare, 0.0)
    spare *= np.trace(V[:, w, w], axis1=1, axis2=2).sum() / np.trace(spare[:, w, w], axis1=1, axis2=2).sum()
    live = np.asarray(spare.any(axis=2))
    V = np.where(live[:, :, None] & live[:, None], V, 0.0)  # what w does not reach has to be 0
    for part in (part for part in _SPARE if part <= most):
        look()
        mixed = _rounded((1.0 - part) * V + part * spare, _DIGITS - round(math.log10(part)))
        gamma = at_least(problem, mixed, seen.T)
        if gamma is not None:
            return Undercut(gamma, Weights.of(seen.T, mixed, problem.mode_names))
    return Undercut(None, why_not="no weights were found that prove any")


def _seen(problem: Problem, at_first: float) -> _Seen | None:
    """From where nothing cancels in M; and where nothing does in the problem, all errors are about as large."""
    reduced, T = on_reachable(problem)
    if reduced is None:
        return None
    coordinates = Coordinates.of(reduced)
    natural = NaturalUnits(reduced, coordinates)
    near, T = natural.problem, (T if coordinates is None else coordinates.T @ T) / natural.state[:, None]
    spare = _spare(near, at_first)
    if spare is None or coordinates is not None:  # T as it is has nothing to do with rounding
        return None if spare is None else _Seen(near, T, spare)
    S = _near_1(near, spare)
    whole = np.eye(spare.shape[1])
    for at in range(0, len(whole) - near.nw, near.nx):
        whole[at : at + near.nx, at : at + near.nx] = S
    return _Seen(_turned(near, S), S @ T, whole @ spare @ whole.T)


def _near_1(problem: Problem, spare: Array) -> Array:
    """S (r, r): moments of the errors of S x are alike in all directions, and those of S x near 1, if x is there."""
    r, p = problem.nx, problem.plant_states
    errors = sum(spare[:, at : at + r, at : at + r].sum(axis=0) for at in range(p, p + problem.n * r, r))
    sizes, axes = np.linalg.eigh(errors / problem.n)
    if not sizes[0] > _NOTHING**2 * sizes[-1]:
        return np.eye(r)
    S = axes.T / np.sqrt(sizes)[:, None]
    moments = spare[:, :p, :p].sum(axis=0)
    return np.asarray(S / math.sqrt(np.trace(S @ moments @ S.T) / p) if p else S)


def _turned(problem: Problem, S: Array) -> Problem:
    """For S x, rounded."""
    plant, inverse = problem.plant, np.linalg.inv(S)
    M = plant.M @ inverse
    matrices = {"A": S @ plant.A @ inverse, "B": S @ plant.B, "M": M / np.linalg.norm(M, 2)}
    nodes = tuple(node.model_copy(update={"C": node.C @ inverse}) for node in problem.nodes)
    return problem.model_copy(update={"plant": plant.model_copy(update=matrices), "nodes": nodes})


def _spare(problem: Problem, at_first: float) -> Array | None:
    """Of [x; e] what white w leaves of it, 0 where that is next to nothing; None where it grows without end.

    It begins with `at_first`. In every mode each e_i is as large as its best gains leave it, times _KEPT + _APART < 1:
    so much is to spare.
    """
    greedy, modes, w = Greedy(problem), len(problem.topologies), problem.nw
    size = problem.plant_states + problem.n * problem.nx
    blocks = np.kron(np.eye(size // problem.nx), np.ones((problem.nx, problem.nx)))
    joint, X = np.zeros((modes, size + w, size + w)), at_first * np.tile(np.eye(size), (modes, 1, 1))
    joint[:, size:, size:] = np.eye(w) / modes
    for _ in range(_STEPS):
        look()
        joint[:, :size, :size] = X
        arrived = greedy.operator(*greedy.gains(joint)).carry(joint)
        X_next = (_KEPT + _APART * blocks) * (arrived + arrived.swapaxes(1, 2)) / 2.0
        before, now = (np.diagonal(moments, axis1=1, axis2=2) for moments in (X, X_next))
        X = X_next
        if not now.max() < _BOUNDLESS:
            return None
        if (np.abs(now - before) <= np.maximum(_SETTLED * now, _NOTHING * now.max())).all():
            break
    sizes = np.trace(X.reshape(modes, -1, problem.nx, size // problem.nx, problem.nx), axis1=2, axis2=4)
    live = np.repeat(np.diagonal(sizes, axis1=1, axis2=2) > _NOTHING * sizes.max(), problem.nx, axis=1)
    joint[:, :size, :size] = np.where(live[:, :, None] & live[:, None], X, 0.0)
    return joint


def _rounded(V: Array, digits: int) -> Array:
    """So many of each entry, counted from those of the diagonal beside and above it."""
    sizes = np.sqrt(np.abs(np.diagonal(V, axis1=1, axis2=2)))
    places = digits - np.log10(np.maximum(sizes[:, :, None] * sizes[:, None], 1e-300)).round().astype(int)
    found = np.zeros_like(V)
    for at in zip(*np.nonzero(V), strict=True):
        found[at] = round(float(V[at]), int(places[at]))
    return found
