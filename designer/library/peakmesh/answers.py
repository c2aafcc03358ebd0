"""What the commands without processes answer. Files may be named by str or Path; problems by a built-in name, too."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from agent.contract.extras import needing
from agent.contract.gains import Gains
from agent.contract.problem import Problem
from designer import problems

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from numpy.typing import ArrayLike

    from designer.analysis import Analysis
    from designer.box.robust import Robust
    from designer.replay.log import Log
    from designer.replay.verdict import Verdict
    from designer.search.descent import Progress
    from designer.simulation import Ensemble

Name = str | Path  # of a file
Within = Mapping[str, float | str]  # how far off numbers may be, by the names of `peakmesh design --within`
Links = Mapping[str, Mapping[str, Mapping[str, Any]]]  # [mode][i][j]: a matrix for what node i hears from node j


def find(problem: Problem | Name) -> Problem:
    """A built-in problem by its name, or that of a problem file. Raises InputError where there is neither."""
    return problem if isinstance(problem, Problem) else problems.find(str(problem))


@needing("design")
def design(
    problem: Problem | Name,
    *,
    method: str | None = None,
    budget: float | None = None,
    peak_slack: float = 0.0,
    within: Within | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> Gains:
    """Gains with a proved gamma (`peakmesh design`); `budget` in seconds for all of it, by default as the command's.

    `peak_slack`: gamma may be that part larger than the least one that is found, 0.05 say, for the least noise.
    `within`: for every model of a box, {"probabilities": 0.02, "A,B,C,D": "1%"} say; without it for that of the
    problem, if its numbers have tolerances. What is proved of the problem's own is in `certificate.box`.

    Raises Unattainable where there are none, with the reason as far as it is known, InputError for a bad problem.
    """
    from designer import synthesis
    from designer.box.claim import with_claim
    from designer.box.extent import asked

    wanted, texts = find(problem), _texts(within)
    how: dict[str, Any] = {"method": method, "budget": budget, "peak_slack": peak_slack, "progress": progress}
    box = asked(wanted, texts)
    if box is None:
        return synthesis.design(wanted, **how)
    found = synthesis.design_in_box(wanted, box, **how)
    return found.gains if texts else with_claim(found.gains, found.robust)


@needing("analyse")
def analyse(
    problem: Problem | Name, gains: Gains | Name | tuple[Links, Links], *, within: Within | None = None
) -> Analysis:
    """What gains do on a problem, whoever made them (`peakmesh analyse`); (K, H) are those of eq. (5) by mode and link.

    K_ij: (nx, nx), H_ij: (nx, ny_j). `robust` says what is proved of the box `within`, as in `design`. Raises
    InputError where they do not fit.
    """
    from designer import analysis
    from designer.box.extent import asked

    wanted = find(problem)
    match gains:
        case Gains():
            source = f"what was designed for {gains.problem.name}"
            given = analysis.given(wanted, gains.K, gains.H, source=source, file=gains)
        case (K, H):
            given = analysis.given_plain(wanted, K, H)
        case _:
            given = analysis.load_given(Path(gains), wanted)
    return analysis.analyse(wanted, given, asked(wanted, _texts(within)))


class Proved(NamedTuple):
    """What `peakmesh verify` has proved: first all that `--json` says by the same names."""

    holds: bool
    gamma: float
    arithmetic: str
    failure: str | None  # where it does not hold
    margins: dict[str, float]  # of each inequality and mode
    low: float | None  # the exact gain is not below it
    interval_is_false: bool  # gamma is proved, and an end that was claimed of the exact gain proved false
    within: Robust | None  # its `gamma` is proved for every model of the box; None: no box


def verify(gains: Gains | Name, *, within: Within | None = None, balls: bool = False) -> Proved:
    """The certificate, proved again without a solver (`peakmesh verify`): `holds`, `gamma`, and why not.

    `within`, as in `design`: what is proved of that box; without it that of the problem, of which what the file claims
    has to be true. `balls`: in ball arithmetic alone. Raises InputError for a claim that cannot be about the problem.
    """
    from designer.box.claim import with_box
    from designer.proof.certificate import verify
    from designer.proof.prover import BALLS, FLOATS

    found = gains_of(gains)
    verdict = verify(found, makes=BALLS if balls else FLOATS + BALLS)
    verdict, in_box = with_box(verdict, found, found.problem, _texts(within), balls=balls)
    return Proved(**verdict._asdict(), within=in_box)


def simulate(
    gains: Gains | Name,
    *,
    runs: int = 1000,
    steps: int = 200,
    seed: int = 0,
    w: ArrayLike | None = None,
    processes: int = 1,
    dask: str | None = None,
) -> Ensemble:
    """Many runs at once (`peakmesh simulate`); `w` (rows, nw) takes the place of the problem's disturbance.

    One process, unless more are asked for: those import the script anew, so that it has to call this under
    `if __name__ == "__main__":`; `dask` is the address of a cluster.
    """
    import numpy as np

    from designer import simulation

    w = None if w is None else np.asarray(w, dtype=np.float64)
    found = gains_of(gains)
    return simulation.simulate(found, runs=runs, steps=steps, seed=seed, w=w, dask=dask, processes=processes)


def replay(*recordings: Name, run: str | None = None, gains: Name | None = None) -> Verdict:
    """A recording, or the parts of one, against the centralised error model (`peakmesh replay`).

    `run` chooses among several in a file, `gains` is their file where the recording has lost it. Raises InputError for
    what is no recording.
    """
    from designer.replay import replay

    return replay(_paths(recordings), run=run, gains=None if gains is None else Path(gains))


def load(*recordings: Name, run: str | None = None, gains: Name | None = None) -> Log:
    """What a recording holds, as arrays with a row for each step: x, z, w, mode, arrived, x_hat, ...; NaN is unknown.

    `run` and `gains` as in `replay`, which reads the same.
    """
    from designer.replay.log import load

    return load(_paths(recordings), run=run, gains=None if gains is None else Path(gains))


@needing("figures")
def figures(*recordings: Name, width: float = 7.16, run: str | None = None) -> dict[str, Figure]:
    """The figures of `peakmesh report --figures`, by name, `width` inches wide; they are the caller's to change."""
    from designer.report import figures
    from designer.report.account import Account
    from designer.report.pictures import pictures

    account = Account.of(*_paths(recordings), run=run)
    drawings = figures.drawings({chart.key: chart for chart in pictures(account)}, stop=account.settled)
    found = {name: draw(width) for name, draw in drawings.items()}
    found["topologies"] = figures.topologies(account.log.gains.problem, width)
    return found | ({"ladder": figures.ladder(account.rungs, width)} if account.rungs else {})


def _texts(within: Within | None) -> list[str]:
    return [f"{names}={size}" for names, size in (within or {}).items()]


def gains_of(gains: Gains | Name) -> Gains:
    """Those of a file, where it is one."""
    return gains if isinstance(gains, Gains) else Gains.load(gains)


def _paths(names: tuple[Name, ...]) -> list[Path]:
    if not names:
        raise TypeError("name a recording")
    return [Path(name) for name in names]
