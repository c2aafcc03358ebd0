"""`peakmesh design`: gains with a certificate, for a problem or for what is left of it; and what each part is worth."""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from agent.commands.options import Subcommands, add_command
from agent.contract.errors import EXIT_GOOD, InputError, counted
from agent.contract.files import refuse_overwrite
from designer.commands import PROBLEM, add_set, add_table, find_to_design, refuse_both, tell_notes
from designer.commands.stopping import stoppable
from designer.commands.within import add_within, asked
from designer.patience import Budget

if TYPE_CHECKING:
    from agent.contract.gains import Gains
    from agent.contract.problem import Problem
    from designer.ladder import Ladder
    from designer.search.descent import Progress

_LONG_ENOUGH = 5.0  # seconds: whoever has waited so long is told what goes on after the search
METHODS = (
    "exact: the least exact gain that a descent finds; decomposed: the optimum of Theorem 2's LMI node by node, for "
    "large networks; theorem2: that LMI as Zhu et al. 2020 print it; theorem2-reduced: the same for [x; e], faster; "
    "to compare with: least-variance: least mean square under white noise; consensus: Kalman-consensus filters; "
    "diffusion: each its own Kalman filter, then the mean of all that it hears "
    "(default: exact; decomposed where more than 200 nodes hear too many others to be searched in windows)"
)


def add_design(commands: Subcommands) -> None:
    """Describe `design` to the parser."""
    design = add_command(commands, "design", design_command, "gains with a certificate, for a problem")
    design.add_argument("problem", metavar="PROBLEM", help=PROBLEM)
    add_set(design)
    design.add_argument("-o", "--output", type=Path, metavar="FILE", help="gains file (<problem>.gains.json)")
    add_method(design)
    design.add_argument(
        "--without-node", action="append", default=[], metavar="N", help="leave node N out; may be repeated"
    )
    design.add_argument(
        "--without-link",
        action="append",
        default=[],
        metavar="A:B",
        help="node A no longer hears node B, in any mode; may be repeated, B:A for the other direction",
    )
    design.add_argument(
        "--price",
        action="store_true",
        help="no gains, but a table: the certified gamma with each node and each link left out in turn",
    )
    design.add_argument(
        "--dask",
        metavar="ADDRESS",
        help="the designs of --price, or the windows of more than 200 nodes, run on this Dask cluster",
    )
    design.add_argument(
        "--peak-slack",
        type=share,
        default=0.0,
        metavar="PART",
        help="gamma may be so much above the least one, 5%% or 0.05, for gains that let through the least noise",
    )
    add_within(design, "design for every model in a box, and prove gamma for all of it")
    design.add_argument("--force", action="store_true", help="replace the gains file if it exists")
    add_table(design, "the ladder")
    design.add_argument("--json", action="store_true", help="print one JSON object")


def add_method(parser: argparse.ArgumentParser) -> None:
    """Add the option of every command that designs."""
    parser.add_argument("--method", metavar="NAME", help=METHODS)
    parser.add_argument(
        "--budget",
        type=duration,
        metavar="TIME",
        help="how long all may take: 90s, 10min, 2h; a share is kept for the proof of what there is then, and what "
        "there is no time for is left out and said (10min; 90s for small networks whose plant hardly decays)",
    )


def duration(text: str) -> float:
    """Seconds of "90s", "10min", "2h", "90"."""
    found = re.fullmatch(r"(\d+(?:\.\d*)?)(s|min|h|)", text)
    if found is None or not float(found[1]):
        raise argparse.ArgumentTypeError(f'"{text}" is no time; write 90s, 10min or 2h')
    return float(found[1]) * {"": 1.0, "s": 1.0, "min": 60.0, "h": 3600.0}[found[2]]


def share(text: str) -> float:
    """0.05 of "5%" or "0.05"."""
    found = re.fullmatch(r"(\d+(?:\.\d*)?(?:[eE]-?\d+)?)(%|)", text)
    if found is None:
        raise argparse.ArgumentTypeError(f'"{text}" is no part of gamma; write 5% or 0.05')
    return float(found[1]) / (100.0 if found[2] else 1.0)


def design_command(options: argparse.Namespace) -> int:
    """`peakmesh design PROBLEM`."""
    refuse_both(options)
    problem = find_to_design(options.problem, options.settings)
    problem = _what_is_left(problem, options.without_node, options.without_link)
    if options.price:
        return _price_command(problem, options)
    _, result = design_and_save(
        problem,
        options.method,
        options.output,
        force=options.force,
        budget=options.budget,
        dask=options.dask,
        peak_slack=options.peak_slack,
        within=options.within,
    )
    if options.table:
        print(ladder_in(result).table(problem.name, options.table), end="")
    else:
        print(json.dumps(result) if options.json else design_text(result))
    return EXIT_GOOD


def _what_is_left(problem: Problem, nodes: list[str], links: list[str]) -> Problem:
    from designer.what_if import without_link, without_node

    for link in dict.fromkeys(links):
        receiver, colon, sender = link.partition(":")
        if not (receiver and colon and sender):
            raise InputError(f"--without-link {link}: a link is A:B, two nodes of which A hears B")
        problem = without_link(problem, receiver, sender)
    for name in dict.fromkeys(nodes):
        problem = without_node(problem, name)
    return problem


def design_and_save(
    problem: Problem,
    method: str | None,
    output: Path | None,
    *,
    force: bool,
    budget: float | None = None,
    dask: str | None = None,
    peak_slack: float = 0.0,
    within: Sequence[str] = (),
) -> tuple[Gains, dict[str, Any]]:
    """Design gains and save them; returns them and the facts to print. A method of None chooses by the size."""
    limit = Budget()
    path = output or Path(f"{problem.name}.gains.json")
    refuse_overwrite(path, force=force)
    from designer.beyond_gamma import beyond_gamma
    from designer.box.claim import with_claim
    from designer.diagnosis import warnings
    from designer.ladder import ladder_of
    from designer.proof.certificate import stored_P
    from designer.search.effort import default_budget
    from designer.synthesis import SHARE_OF_BOX, design, from_nominal  # only now: it loads a solver

    box = asked(problem, within)
    warned = warnings(problem)
    for warning in warned:
        print(f"warning: {warning}", file=sys.stderr)
    noted = tell_notes(problem)
    method = method or _chosen_method(problem, budget)
    limit.seconds = default_budget(problem) if budget is None else budget
    if dask is not None:
        _refuse_nothing_to_spread(problem, method)
    progress = _descent_progress(limit.seconds, alone=box is None and not peak_slack)
    limit.tell = lambda words: _tell(words, limit.spent)
    how: dict[str, Any] = {"method": method, "progress": progress, "dask": dask, "peak_slack": peak_slack}
    with stoppable(limit):
        with limit.leaving(0.0 if box is None else SHARE_OF_BOX):
            gains = design(problem, budget=limit, **how)
        found = None if box is None else from_nominal(problem, box, gains, limit, progress=progress)
        if found is not None:
            gains = found.gains if within else with_claim(found.gains, found.robust)  # the file has its own box
        gains.save(path, force=force)
        reckon = partial(beyond_gamma, problem, gains.K, gains.H, stored_P(gains))
        beyond = limit.compared("noise, and the gains of single nodes", reckon)
    if box is not None and found is None:
        limit.left_out.append("what holds for every model of the box")
    if gains.solver.status.startswith("out of time"):
        print(
            f"warning: the search was out of time after {gains.solver.iterations} steps; --budget gives it more",
            file=sys.stderr,
        )
    proved, ladder = gains.certificate, ladder_of(gains)
    return gains, {
        "problem": problem.name,
        "method": gains.method,
        "gamma": proved.gamma,
        "theorem1_gamma": proved.theorem1_gamma,
        "lmi_gamma": proved.lmi_gamma,
        "exact": proved.exact,
        "floor": proved.floor,
        "ladder": (ladder if found is None else found.on(ladder)).document(),
        "within": None if found is None else found.document(),
        **(
            dict.fromkeys(("white_noise", "white_noise_sought", "start", "node_gains"))
            if beyond is None
            else beyond.document()
        ),
        "holds": proved.holds,
        "solver": gains.solver.document(),
        "seconds": gains.seconds,
        "left_out": limit.left_out,
        "warnings": warned,
        "notes": noted,
        "output": str(path),
    }


def _refuse_nothing_to_spread(problem: Problem, method: str) -> None:
    from designer.search.effort import MOST_NODES, in_windows

    if method != "exact" or not in_windows(problem):
        raise InputError(
            "--dask spreads the many designs of --price, and the windows in which method exact searches more than "
            f"{MOST_NODES} nodes; this design runs here"
        )


def _chosen_method(problem: Problem, budget: float | None) -> str:
    """The default for this problem; on stderr why, where it is not the best one or takes long."""
    from designer.search.effort import (
        LARGE,
        LONG,
        MOST_NODES,
        bytes_of_exact,
        default_budget,
        default_method,
        in_words,
        seconds_within,
    )

    method = default_method(problem)
    if method != "exact":
        print(
            f"method {method}: of more than {MOST_NODES} nodes some hear too many others to be searched in windows; "
            "--method exact asks for a search of all at once",
            file=sys.stderr,
        )
        return method
    least, usual, most = seconds_within(problem, default_budget(problem) if budget is None else budget)
    if min(usual, most) > LONG:
        rule = f", about {in_words(usual)} as a rule" if least < usual < most else ""
        memory, (number, unit) = bytes_of_exact(problem), in_words(least).split()
        at_least = f"{number if in_words(most).endswith(unit) else in_words(least)} to " if least < most else ""
        large = f"; up to {memory / 1e9:.1f} GB of memory" if memory > LARGE else ""
        print(
            f"method exact: it takes {at_least}{in_words(most)} here{rule}, the longer the more slowly errors turn out "
            f"to decay{large}; --budget 1min less, and --method decomposed is faster",
            file=sys.stderr,
        )
    return method


def ladder_in(result: dict[str, Any]) -> Ladder:
    """The ladder among the facts of a design."""
    from designer.ladder import Ladder

    return Ladder(**{name: result["ladder"][name] for name in Ladder._fields})


def design_text(result: dict[str, Any]) -> str:
    """The facts of a design, for people."""
    from designer.beyond_gamma import told
    from designer.ladder import rounded_up

    solver = result["solver"]
    ladder = "\n           ".join(ladder_in(result).lines())
    box = "".join(f"{line}\n" for line in (result["within"] or {"said": []})["said"])
    left_out = "".join(f"left out   {what}\n" for what in result["left_out"])
    beyond = "" if result["white_noise"] is None and left_out else "\n".join([*told(result), ""])
    return (
        f"{result['problem']} by {result['method']}: gamma = {rounded_up(result['gamma'])}, certified\n"
        f"ladder     {ladder}\n"
        f"{box}"
        f"{beyond}{left_out}"
        f"solver     {solver['name']} {solver['version']}: {solver['iterations']} iterations, "
        f"{result['seconds']['total']:.1f} s in all\n"
        f"status     {solver['status']}\n"
        f"gains      {result['output']}\n"
        f"next       peakmesh run {result['output']}"
    )


def _descent_progress(budget: float, *, alone: bool = True) -> Callable[[Progress], None]:
    """Prints every other second how much of the descent is done and what is in hand, and what comes after it.

    `alone`: no other search follows.
    """
    from designer.search.effort import in_words

    shown = 0.0

    def show(progress: Progress) -> None:
        nonlocal shown
        if progress.phase is not None:
            if progress.seconds >= _LONG_ENOUGH:
                print(f"{progress.seconds:5.0f} s  {progress.phase}", file=sys.stderr)
            return
        if progress.seconds >= shown + 2.0:
            shown = progress.seconds
            so_far = (
                f"from {progress.start}, {counted(progress.steps, 'change')} on: gamma over {progress.horizon} steps "
                f"< {progress.gamma:.6g}"
                if progress.noise is None
                else f"{counted(progress.steps, 'change')} on: noise over {progress.horizon} steps < "
                f"{progress.noise:.6g}, gamma < {progress.gamma:.6g}"
            )
            about = ""
            if alone and progress.whole < budget:
                about = f"about {in_words(progress.whole)} if {progress.horizon} steps are enough, "
            done = f"{progress.seconds:5.0f} s of {about}{in_words(budget)} at most"
            rounds = f", round {progress.round} of {progress.rounds}" if progress.rounds else ""
            print(f"{done}{rounds}, {so_far}; Ctrl-C keeps the best so far", file=sys.stderr)

    return show


def _tell(words: str, spent: float) -> None:
    """To whoever has waited long."""
    if spent >= _LONG_ENOUGH:
        print(f"{spent:5.0f} s  {words}", file=sys.stderr)


def _price_command(problem: Problem, options: argparse.Namespace) -> int:
    """`peakmesh design PROBLEM --price`."""
    from designer.what_if import price, price_method, price_text

    if options.table:
        raise InputError("--table prints the ladder of one design; --price has a table of its own, and --json")
    if options.peak_slack:
        raise InputError("--peak-slack is for one design; --price compares the least peaks")
    if options.within:
        raise InputError("--within is for one design; --price compares designs for the problem as it is")
    if options.budget is not None:
        raise InputError("--budget is for one design; --price goes to the end of each search, that all compare")
    if options.output is not None:
        raise InputError("--price writes no gains file; leave --output out, or --price")
    method = price_method(problem) if options.method is None else options.method

    def show(done: int, of: int, what: str) -> None:
        print(f"{done:4d} of {of} designs, {what}", file=sys.stderr)

    table = price(problem, method=method, dask=options.dask, report=show)
    print(json.dumps(table.document()) if options.json else price_text(table))
    return EXIT_GOOD
