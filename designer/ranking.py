"""Gains beside others on one problem: what is proved of each, and what noise leaves in its errors, in one table."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from agent.contract.errors import InputError, Unattainable, listed
from agent.contract.gains import LinkMatrices
from agent.contract.problem import Problem
from designer.analysis import GivenGains, load_given
from designer.box.extent import Box
from designer.box.robust import robust
from designer.gain.noise import steady_state
from designer.ladder import rounded_up
from designer.model.error_model import model_of_gains
from designer.search.exact_design import certify
from designer.synthesis import design, design_in_box, methods


class Rank(NamedTuple):
    """One row; no gamma where it is not proved, and then why."""

    gains: str
    gamma: float | None
    white_noise: float | None  # E|z_tilde|^2 in the steady state, w of unit covariance; None: not settled
    why: str | None = None
    in_box: float | None = None  # gamma for every model of the box, if one was given and it is proved

    def document(self) -> dict[str, Any]:
        """For --json."""
        return self._asdict()


def ranked(problem: Problem, given: GivenGains, against: Sequence[str], box: Box | None = None) -> list[Rank]:
    """The given gains and all those `against` them, each a file or a method of design, the least gamma first.

    With a box gamma for that counts, and methods design for it if they can. Raises InputError for what is neither file
    nor method, before anything is designed.
    """
    for name in against:
        if name not in methods() and not Path(name).exists():
            raise InputError(f"--against {name}: neither a file nor a method; the methods are {listed(methods())}")
    others = {name: None if name in methods() else load_given(Path(name), problem) for name in dict.fromkeys(against)}
    rows = [_of_given(problem, given, box)]
    rows += [
        _of_method(problem, name, box) if file is None else _of_given(problem, file, box)
        for name, file in others.items()
    ]
    return sorted(
        rows, key=lambda row: (box is not None and row.in_box is None, row.in_box, row.gamma is None, row.gamma)
    )


def _of_given(problem: Problem, given: GivenGains, box: Box | None) -> Rank:
    try:
        gamma = certify(problem, given.K, given.H).gamma
    except Unattainable as error:
        return Rank(given.source, None, None, str(error))
    in_box = None if box is None else robust(problem, given.K, given.H, box).gamma
    return Rank(given.source, gamma, _noise(problem, given.K, given.H), in_box=in_box)


def _of_method(problem: Problem, method: str, box: Box | None) -> Rank:
    in_box = None
    try:
        if box is None:
            gains = design(problem, method=method)
        else:
            found = design_in_box(problem, box, method=method)
            gains, in_box = found.gains, found.robust.gamma
    except Unattainable as error:
        return Rank(method, None, None, str(error))
    return Rank(method, gains.certificate.gamma, _noise(problem, gains.K, gains.H), in_box=in_box)


def _noise(problem: Problem, K: LinkMatrices, H: LinkMatrices) -> float | None:
    model = model_of_gains(problem, K, H)
    found = steady_state(model, initial=problem.mode_index(problem.markov.initial))
    return None if found is None else found.total


def table(rows: Sequence[Rank], *, in_box: bool = False) -> str:
    """The same for people; with a column for the box, by which they are ranked, where there is one."""
    cells = [["gamma, certified", "", "white noise, computed", "gains"]]
    least = min((row.gamma for row in rows if row.gamma), default=None)
    for row in rows:
        if row.gamma is None:
            cells.append(["-", "", "-", f"{row.gains}: {row.why}"])
            continue
        noise = "not settled" if row.white_noise is None else f"{row.white_noise:.6g}"
        cells.append([*_beside(row.gamma, least), noise, row.gains])
    if in_box:
        best = rows[0].in_box
        boxed = [["proved for the box", ""], *(_beside(row.in_box, best) for row in rows)]
        cells = [[*left, *right] for left, right in zip(boxed, cells, strict=True)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)][:-1]
    return "\n".join(
        "  ".join([*(cell.ljust(width) for cell, width in zip(row, widths, strict=False)), row[-1]]) for row in cells
    )


def _beside(gamma: float | None, least: float | None) -> list[str]:
    """A gamma, and how far it is above the least one."""
    if gamma is None:
        return ["-", ""]
    more = "" if least is None or gamma == least else f"+{100.0 * (gamma / least - 1.0):.1f} %"
    return [rounded_up(gamma), more]
