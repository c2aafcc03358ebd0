"""`peakmesh design`: gains with a certificate, and what to say of them."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import agent.cli
from agent.contract.errors import EXIT_GOOD
from agent.contract.files import refuse_overwrite
from designer.commands import PROBLEM

if TYPE_CHECKING:
    from agent.contract.gains import Gains
    from agent.contract.problem import Problem
    from designer.descent import Progress

METHODS = (
    "theorem2 (the default): the LMI of Zhu et al. 2020; theorem2-reduced: the same for [x; e], faster; "
    "decomposed: the same optimum node by node, for large networks; exact: the least exact gain that descent finds"
)


def add_design(commands: agent.cli.Subcommands) -> None:
    """Describe `design` to the parser."""
    design = agent.cli.add_command(commands, "design", design_command, "gains with a certificate, for a problem")
    design.add_argument("problem", metavar="PROBLEM", help=PROBLEM)
    design.add_argument("-o", "--output", type=Path, metavar="FILE", help="gains file (<problem>.gains.json)")
    design.add_argument("--method", default="theorem2", metavar="NAME", help=METHODS)
    design.add_argument("--force", action="store_true", help="replace the gains file if it exists")
    design.add_argument("--json", action="store_true", help="print one JSON object")


def design_command(options: argparse.Namespace) -> int:
    """`peakmesh design PROBLEM`."""
    from designer.problems import find

    _, result = design_and_save(find(options.problem), options.method, options.output, force=options.force)
    print(json.dumps(result) if options.json else design_text(result))
    return EXIT_GOOD


def design_and_save(problem: Problem, method: str, output: Path | None, *, force: bool) -> tuple[Gains, dict[str, Any]]:
    """Design gains and save them; returns them and the facts to print."""
    path = output or Path(f"{problem.name}.gains.json")
    refuse_overwrite(path, force=force)
    from designer.synthesis import design  # only now: it loads a solver

    gains = design(problem, method=method, progress=_descent_progress())
    gains.save(path, force=force)
    proved = gains.certificate
    return gains, {
        "problem": problem.name,
        "method": gains.method,
        "gamma": proved.gamma,
        "lmi_gamma": proved.lmi_gamma,
        "exact": proved.exact,
        "floor": proved.floor,
        "holds": proved.holds,
        "solver": gains.solver.document(),
        "seconds": gains.seconds,
        "output": str(path),
    }


def design_text(result: dict[str, Any]) -> str:
    """The facts of a design, for people."""
    solver, exact = result["solver"], result["exact"]
    lmi = "" if result["lmi_gamma"] is None else f" (the solver's value of the LMI {result['lmi_gamma']:.6f})"
    ladder = [f"floor {result['floor']:.6f}"] if result["floor"] is not None else []
    ladder += [f"what these gains really have {exact[1]:.6f}"] if exact is not None else []
    return (
        f"{result['problem']} by {result['method']}: gamma = {result['gamma']:.6f}, certified{lmi}\n"
        f"ladder     {' <= '.join([*ladder, 'gamma'])}\n"
        f"{solver['name']} {solver['version']}: {solver['status']}, {solver['iterations']} iterations; "
        f"{result['seconds']['total']:.1f} s in all\n"
        f"gains      {result['output']}\n"
        f"next       peakmesh run {result['output']}"
    )


def _descent_progress() -> Callable[[Progress], None]:
    """Prints where the descent is, every other second."""
    shown = 0.0

    def show(progress: Progress) -> None:
        nonlocal shown
        if progress.seconds >= shown + 2.0:
            shown = progress.seconds
            print(
                f"{progress.seconds:5.0f} s  from {progress.start}: gamma < {progress.gamma:.6f} "
                f"after {progress.steps} steps; Ctrl-C keeps the best so far",
                file=sys.stderr,
            )

    return show
