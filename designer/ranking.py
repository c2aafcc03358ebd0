"""Gains beside others on one problem: what is proved of each, and what noise leaves in its errors, in one table."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from agent.contract.errors import InputError, Unattainable, listed
from agent.contract.gains import LinkMatrices
from agent.contract.problem import Problem
from designer.analysis import GivenGains, load_given
from designer.gain.noise import steady_state
from designer.ladder import rounded_up
from designer.model.error_model import error_model, stacked_links
from designer.search.exact_design import certify
from designer.synthesis import design, methods


class Rank(NamedTuple):
    """One row; no gamma where it is not proved, and then why."""

    gains: str
    gamma: float | None
    white_noise: float | None  # E|z_tilde|^2 in the steady state, w of unit covariance; None: not settled
    why: str | None = None

    def document(self) -> dict[str, Any]:
        """For --json."""
        return self._asdict()


def ranked(problem: Problem, given: GivenGains, against: Sequence[str]) -> list[Rank]:
    """The given gains and all those `against` them, each a file or a method of design, the least gamma first.

    Raises InputError for what is neither, before anything is designed.
    """
    for name in against:
        if name not in methods() and not Path(name).exists():
            raise InputError(f"--against {name}: neither a file nor a method; the methods are {listed(methods())}")
    others = {name: None if name in methods() else load_given(Path(name), problem) for name in dict.fromkeys(against)}
    rows = [_of_given(problem, given)]
    rows += [_of_method(problem, name) if file is None else _of_given(problem, file) for name, file in others.items()]
    return sorted(rows, key=lambda row: (row.gamma is None, row.gamma))


def _of_given(problem: Problem, given: GivenGains) -> Rank:
    try:
        gamma = certify(problem, given.K, given.H).gamma
    except Unattainable as error:
        return Rank(given.source, None, None, str(error))
    return Rank(given.source, gamma, _noise(problem, given.K, given.H))


def _of_method(problem: Problem, method: str) -> Rank:
    try:
        gains = design(problem, method=method)
    except Unattainable as error:
        return Rank(method, None, None, str(error))
    return Rank(method, gains.certificate.gamma, _noise(problem, gains.K, gains.H))


def _noise(problem: Problem, K: LinkMatrices, H: LinkMatrices) -> float | None:
    model = error_model(problem, *stacked_links(problem, K, H))
    found = steady_state(model, initial=problem.mode_index(problem.markov.initial))
    return None if found is None else found.total


def table(rows: Sequence[Rank]) -> str:
    """The same for people."""
    best = next((row.gamma for row in rows if row.gamma), None)
    cells = [("gamma, certified", "", "white noise, computed", "gains")]
    for row in rows:
        if row.gamma is None:
            cells.append(("-", "", "-", f"{row.gains}: {row.why}"))
            continue
        more = "" if best is None or row.gamma == best else f"+{100.0 * (row.gamma / best - 1.0):.1f} %"
        noise = "not settled" if row.white_noise is None else f"{row.white_noise:.6g}"
        cells.append((rounded_up(row.gamma), more, noise, row.gains))
    widths = [max(len(row[k]) for row in cells) for k in range(3)]
    return "\n".join(
        "  ".join([*(cell.ljust(width) for cell, width in zip(row, widths, strict=False)), row[3]]) for row in cells
    )
