"""Weights V(s) on [eta; w] that prove what Theorem 2 cannot undercut: the multipliers of the decomposed LMI's balance.

A solver's multipliers miss what `designer.proof.least` asks of them by its tolerance. So the LMI is solved again, with
a little of P, measured by the P that was found first, taken off its objective: the multipliers of that have as much to
spare. Where Q_i(s) may grow without end, because some gains keep the error of node i free of w, that has no optimum;
there the multipliers have nothing on e_i, and e_i is left out of the balance.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from agent.contract.arrays import Array
from agent.contract.problem import Problem
from designer.coordinates import Coordinates
from designer.lmi import conic
from designer.lmi.attempts import SOLVED
from designer.lmi.cones import Indices
from designer.lmi.decomposed import Lmi, Mode, assemble
from designer.model.units import Units, natural_units, rescaled
from designer.proof.least import at_least
from designer.proof.silent import at_least_by_silence

MOST_STATES = 12  # n nx up to which the LMI takes no second
_SPARE = (1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2)  # of delta, for P
_PARTS = (0.01, 0.03, 0.1, 0.3, 1.0)
_INNER = 0.01  # of that for V > 0
_NOTHING = 1e-7  # of the largest tr V_ii(s): e_i is free of w in mode s


def least_of_lmi(problem: Problem) -> float | None:
    """No gains and no P = diag{R, Q(s)} have a gamma below this one by Theorem 1, which is proved; None: it is not."""
    found = [gamma for gamma in (at_least_by_silence(problem), _by_multipliers(problem)) if gamma is not None]
    return max(found, default=None)


def _by_multipliers(problem: Problem) -> float | None:
    """The first that prove anything, and between them and those before them, which are closer to the optimum."""
    coordinates, before = Coordinates.of(problem), None
    given, T = (problem, None) if coordinates is None else (coordinates.problem, coordinates.T)
    for V in multipliers(given) if problem.n * problem.nx <= MOST_STATES else ():
        if at_least(problem, V, T) is not None:
            mixed = (V if before is None else before + part * (V - before) for part in _PARTS)
            return next(gamma for U in mixed if (gamma := at_least(problem, U, T)) is not None)
        before = V
    return None


def multipliers(problem: Problem) -> Iterator[Array]:
    """V, (modes, n_eta + nw, n_eta + nw), the closest to the optimum first; not proved to be of any use."""
    units = natural_units(problem)
    scaled = rescaled(problem, Units(units.state, units.output))
    lmi = assemble(scaled, split=False)
    q = np.zeros(lmi.cones.A.shape[1])
    q[lmi.delta] = 1.0
    first = conic.clarabel(lmi.cones, q)
    if first.record.status not in SOLVED or first.z is None:
        return
    free = _free(scaled, [_weights(scaled, lmi, mode, lmi.cones.piece(first.z, _number(mode))) for mode in lmi.modes])
    dropped = {_number(mode): _rows(mode, free[s], scaled.nx) for s, mode in enumerate(lmi.modes)}
    cones = lmi.cones.without(dropped)
    states = np.concatenate([np.tile(units.state, len(lmi.modes[0].Q) + bool(lmi.R.size)), np.ones(scaled.nw)])
    for spare in _SPARE:
        more = spare * float(first.u[lmi.delta].item())
        objective = q + more * _by_P(lmi, first.u, free)
        found = conic.clarabel(cones, objective)
        if found.record.status not in SOLVED or found.z is None:
            continue
        V = np.zeros((len(lmi.modes), len(states), len(states)))
        for s, mode in enumerate(lmi.modes):
            left = np.setdiff1d(np.arange(mode.balance[0].matrix.order), dropped[_number(mode)])
            whole = np.zeros((mode.balance[0].matrix.order,) * 2)
            whole[np.ix_(left, left)] = cones.piece(found.z, _number(mode))
            inner = _INNER * more * _inverse_of_P(lmi, s, first.u, free[s], scaled.nw)
            V[s] = _weights(scaled, lmi, mode, whole) + np.diag(inner)
        yield V * states[:, None] * states


def _number(mode: Mode) -> int:
    return mode.balance[0].matrix.number


def _rows(mode: Mode, nodes: set[int], nx: int) -> Indices:
    """Where the errors of these nodes stand in the balance."""
    return np.concatenate([np.zeros(0, dtype=np.int64), *(mode.balance[0].at[i + 1][:nx] for i in sorted(nodes))])


def _weights(problem: Problem, lmi: Lmi, mode: Mode, multiplier: Array) -> Array:
    """The part of a multiplier that weighs [eta; w], in that order."""
    at, nx, p = mode.balance[0].at, problem.nx, problem.plant_states
    w = np.zeros(problem.nw, dtype=np.int64)
    w[lmi.columns.shared] = at[0][p:]
    for j, own in enumerate(lmi.columns.own):
        w[own] = at[j + 1][nx:]
    rows = np.concatenate([at[0][:p], *(at[j + 1][:nx] for j in range(problem.n)), w])
    return np.asarray(multiplier[np.ix_(rows, rows)])


def _free(problem: Problem, V: list[Array]) -> list[set[int]]:
    """The nodes whose errors have no weight, of every mode."""
    p, nx = problem.plant_states, problem.nx
    sizes = np.array([[np.trace(V_s[k : k + nx, k : k + nx]) for k in range(p, p + problem.n * nx, nx)] for V_s in V])
    return [set(np.flatnonzero(of_mode < _NOTHING * sizes.max()).tolist()) for of_mode in sizes]


def _by_P(lmi: Lmi, u: Array, free: list[set[int]]) -> Array:
    """What is added to the objective: minus P relative to the P in u; plus that of free nodes, which has no end."""
    added = np.zeros(len(u))
    for s, mode in enumerate(lmi.modes):
        for i, Q_i in enumerate(mode.Q):
            places = np.diag(Q_i)
            added[places] = (1.0 if i in free[s] else -1.0) / np.maximum(np.abs(u[places]), 1.0)
    places = np.diag(lmi.R)
    added[places] = -1.0 / np.maximum(np.abs(u[places]), 1.0)
    return added


def _inverse_of_P(lmi: Lmi, s: int, u: Array, free: set[int], nw: int) -> Array:
    """1 over the diagonal of P(s) in u, 0 for free nodes, and 1 for w."""
    parts = [np.diag(lmi.R), *(np.diag(Q_i) for Q_i in lmi.modes[s].Q)]
    sizes = [
        np.zeros(len(part)) if k - 1 in free else 1.0 / np.maximum(np.abs(u[part]), 1.0) for k, part in enumerate(parts)
    ]
    return np.concatenate([*sizes, np.ones(nw)])
