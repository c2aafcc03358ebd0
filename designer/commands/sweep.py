"""`peakmesh sweep`: gamma over the values of one key of a problem."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from agent.commands.options import Subcommands, add_command, add_output_options
from agent.contract.errors import EXIT_GOOD, EXIT_NO
from agent.contract.files import refuse_overwrite, write_whole
from designer.commands import PROBLEM, add_set, tell_notes
from designer.commands.design import add_method
from designer.commands.report import FORMATS, add_figures, refuse_lone_options

if TYPE_CHECKING:
    from designer.sweep import Point, Range

NAME = "sweep"  # of the picture


def add_sweep(commands: Subcommands) -> None:
    """Describe `sweep` to the parser."""
    sweep = add_command(commands, "sweep", sweep_command, "a design for each of several values in a problem, as CSV")
    sweep.add_argument("problem", metavar="PROBLEM", help=PROBLEM)
    add_set(sweep, also="; one is KEY=a:b:n, n values from a to b")
    add_method(sweep)
    sweep.add_argument("--dask", metavar="ADDRESS", help="the designs run on this Dask cluster")
    add_output_options(sweep, "FILE", "CSV file (to stdout)")
    add_figures(sweep, "draw the curve, at the width of one and of two columns, into this folder")
    sweep.add_argument("--json", action="store_true", help="print one JSON object")


def sweep_command(options: argparse.Namespace) -> int:
    """`peakmesh sweep PROBLEM --set KEY=a:b:n`: exit code 1 where no value has gains."""
    refuse_lone_options(options)
    if options.output is not None:
        refuse_overwrite(options.output, force=options.force)
    if options.figures is not None:
        from designer.report import figures

        figures.paths([NAME], options.figures, kind=options.format or FORMATS[0], force=options.force)
    from designer.sweep import as_csv, document, problems, sweep

    over, revised = problems(options.problem, options.settings)
    noted = tell_notes(revised[0])
    points = sweep(
        over,
        revised,
        method=options.method,
        budget=options.budget,
        dask=options.dask,
        report=_show,
    )
    if options.output is not None:
        write_whole(options.output, as_csv(over, points).encode(), force=options.force)
    files = [] if options.figures is None else [str(path) for path in _draw(over, points, options)]
    if options.json:
        more = {"notes": noted, "output": options.output and str(options.output), "figures": files}
        print(json.dumps(document(over, points) | more))
    else:
        print(as_csv(over, points) if options.output is None else f"table      {options.output}\n", end="")
        for file in files:
            print(f"figure     {file}", file=sys.stderr if options.output is None else sys.stdout)
    return EXIT_NO if all(point.gamma is None for point in points) else EXIT_GOOD


def _draw(over: Range, points: Sequence[Point], options: argparse.Namespace) -> list[Path]:
    """What is certified beside what there was to reach, and what is proved that no gains are below by an LMI."""
    from designer.report import figures
    from designer.report.curves import curve

    series = {"certified": "gamma", "floor": "floor", "least by the LMI": "theorem2_least"}
    found = {name: [getattr(point, field) for point in points] for name, field in series.items()}
    draw = {NAME: lambda width: curve(over.key, over.values, found, width)}
    return figures.write(draw, options.figures, kind=options.format or FORMATS[0], force=options.force)


def _show(done: int, of: int, what: str) -> None:
    print(f"{done:4d} of {of} designs, {what}", file=sys.stderr)
