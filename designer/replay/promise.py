"""What the certificate says of a run that is in a log: the ledger's account of it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from designer.ledger.account import Account, Flags, account, deviations
from designer.ledger.deviation import Deviation
from designer.replay.coupling import Coupling
from designer.replay.gamma import Gamma
from designer.replay.log import Log
from designer.replay.topics import Numbers

_NOTHING: Mapping[int, Deviation] = {}


def promise(log: Log, gamma: Gamma, faults: Mapping[int, Deviation] = _NOTHING) -> Account | None:
    """The account of the steps that are there; None where no gamma is proved. `faults` by step."""
    if not gamma.is_claimed or gamma.failure is not None or not log.steps:
        return None
    return account(log.gains, steps=log.steps, faults=faults, void=_outside(log), starts_anywhere=not log.has_plant)


def faults_of(coupling: Coupling, by_seed: Numbers) -> dict[int, Deviation]:
    """What was not as designed in a paced run, by step.

    Whether a message would have come that nobody asked for, in this mode and by the seed, is not known. It is taken to
    have failed where the pair failed at the nearest step, before or after, at which it was asked for. `by_seed`
    (steps, n) are the positions in `log.senders` of those that each node was to use.
    """
    log, n = coupling.log, coupling.log.gains.problem.n
    members = np.vstack([log.senders.members(), np.zeros((1, n), dtype=bool)])
    went_on = np.vstack([(log.heard[1:] >= 0) & (log.origin[1:] == -1), np.zeros((1, n), dtype=bool)])
    asked = members[by_seed] & ~np.eye(n, dtype=bool) & went_on[:, :, None]
    failed = asked & ~coupling.used
    return deviations(_filled(failed, asked), log.told == 0, coupling.absent(), log.origin)


def _filled(failed: Flags, asked: Flags) -> Flags:
    """`failed` (steps, n, n) with what was not asked for as at the nearest steps that were, where either failed."""
    none = np.zeros_like(failed[:1])
    found = failed.copy()
    for flags, known, out in ((failed, asked, found), (failed[::-1], asked[::-1], found[::-1])):
        step = np.where(known, np.arange(1, len(known) + 1)[:, None, None], 0)
        nearest = np.maximum.accumulate(step, axis=0)  # 0: at none so far
        out |= ~known & np.take_along_axis(np.concatenate([none, flags]), nearest, axis=0)
    return found


def _outside(log: Log) -> tuple[str, int] | None:
    """The first mode that the chain does not have, or does not go to from the one before, and its step."""
    chain, names = log.gains.problem.markov.transition, log.gains.problem.mode_names
    unknown = np.flatnonzero(log.mode >= len(names))
    known = np.where(log.mode < len(names), log.mode, -1)
    before, after = known[:-1], known[1:]
    impossible = np.flatnonzero((before >= 0) & (after >= 0) & (chain[before, after] == 0.0)) + 1
    places = [*unknown[:1].tolist(), *impossible[:1].tolist()]
    if not places:
        return None
    step = min(places)
    mode = log.modes.texts[int(log.mode[step])]
    if step in unknown[:1]:
        return f'mode "{mode}" is none of the chain', step
    return f'the chain never goes from mode "{names[int(log.mode[step - 1])]}" to "{mode}"', step
