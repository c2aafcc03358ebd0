"""Weights of the inequalities of a proof for a box: what [eta; w] is like, step by step from the last.

Any are right, and a proof takes what floats find. The least gamma is that of a game: for given weights X the bound of
every step takes what is least in tr(XZ), and for given bounds the worst w, with the deviations that cost most, leads
to X. So weights begin as those of one model, and then move part of the way to those of the bound that they made;
docs/theory.md, section 13.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from agent.contract.arrays import Array
from designer.box.passes import back, forth
from designer.gain.exact import Operator, exact_gain
from designer.gain.sensitivity import sweep
from designer.model.error_model import ErrorModel
from designer.proof.by_vertices import ByVertices

_WIDTH = 1e-5  # of gamma^2 of the model
_HORIZON, _BEGINNING = 60, 30  # steps of the weights, and before them, from rest
_ABOVE = (0.01, 0.1)  # gamma^2 of the weights above that of their model
_RIDGE = 1e-3
_OF_TAIL = 0.1  # of the weights of P in those of a model: a model without deviations leaves much at 0


def starts(likely: list[ErrorModel], *, spreads: bool) -> Iterator[Array]:
    """The weights of models, each at a gamma near to its own and one further off.

    Where the bounds of entries spread, rounds follow, and the first with the wider view is the best to begin with.
    """
    tried = ((likely[0], _ABOVE[-1]),) if spreads else ((model, above) for model in likely for above in _ABOVE)
    return (found for model, above in tried if (found := weights_of(model, above)) is not None)


def weights_of(model: ErrorModel, above: float) -> Array | None:
    """(T, modes, n_eta + nw, n_eta + nw) while the worst w acts in this model; None: not mean-square stable."""
    operator = Operator(model)
    gain = exact_gain(model, width=_WIDTH)
    swept = sweep(operator, gain.high**2 * (1.0 + above), _HORIZON + _BEGINNING) if gain.stable else None
    if swept is None:
        return None
    joint, _ = forth(swept.Gamma, swept.W_inverse, lambda joint, k: operator.carry(joint))
    return _ridged(joint)


def mixed(weights: Array, tail: Array) -> Array:
    """With something of the weights of P, in which entries are off."""
    sizes = np.trace(weights, axis1=2, axis2=3).sum(axis=1) / np.trace(tail, axis1=1, axis2=2).sum()
    return np.asarray(weights + _OF_TAIL * sizes[:, None, None, None] * tail)


class Round(NamedTuple):
    """Weights on the way: `share` of those that the bound has at gamma."""

    gamma: float
    share: float


class Recipe(NamedTuple):
    """How weights are made: from which of `starts`, and through which rounds."""

    start: int
    rounds: tuple[Round, ...]

    def times(self, output: float) -> Recipe:
        """For z in a unit of which this is so many."""
        return self._replace(rounds=tuple(to._replace(gamma=to.gamma * output) for to in self.rounds))


def moved(by: ByVertices, units: Array, to: Round) -> Array | None:
    """The weights of `by` after one round; None: the recursion does not come so far. `units` (n_eta,): of eta."""
    found = _of_bound(by, to.gamma**2)
    if found is None:
        return None
    sizes = np.append(units**2, np.ones(by.weights.shape[-1] - len(units)))
    return np.asarray((1.0 - to.share) * _measured(by.weights, sizes) + to.share * _measured(found, sizes))


def _measured(weights: Array, sizes: Array) -> Array:
    traces = (weights.diagonal(axis1=2, axis2=3) * sizes).sum(axis=(1, 2))
    return np.asarray(weights / traces[:, None, None, None])


def _of_bound(by: ByVertices, g: float) -> Array | None:
    """As `weights_of`, of what the recursion takes for S(Y) with the weights that it has."""
    passed = back(by.upper, by.corners[0].ended(by.mean), g, _HORIZON + _BEGINNING)
    if passed is None:
        return None
    joint, _ = forth(passed.Gamma, passed.W_inverse, lambda joint, k: by.carry(passed.Y[k], joint))
    return _ridged(joint)


def _ridged(joint: Array) -> Array:
    """Without the steps from rest, and with something of all steps in each."""
    joint = joint[:_HORIZON]
    mean = joint.mean(axis=0)
    everywhere = mean.mean(axis=0)
    return np.asarray(joint + _RIDGE * (mean + everywhere + np.diag(_RIDGE * everywhere.diagonal())))
