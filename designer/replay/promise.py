"""What the certificate says of a run that is in a log: the ledger's account of it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from designer.ledger.account import Account, account
from designer.ledger.deviation import Deviation
from designer.replay.gamma import Gamma
from designer.replay.log import Log

_NOTHING: Mapping[int, Deviation] = {}


def promise(log: Log, gamma: Gamma, faults: Mapping[int, Deviation] = _NOTHING) -> Account | None:
    """The account of the steps that are there; None where no gamma is proved. `faults` by step."""
    if not gamma.is_claimed or gamma.failure is not None or not log.steps:
        return None
    return account(log.gains, steps=log.steps, faults=faults, void=_outside(log), starts_anywhere=not log.has_plant)


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
