"""`peakmesh reproduce`: the paper's table, printed beside computed, and its figures."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from agent.commands.options import Subcommands, add_command
from agent.contract.errors import EXIT_GOOD
from designer.commands import add_table, refuse_both
from designer.commands.report import FORMATS, add_figures, refuse_lone_options

if TYPE_CHECKING:
    from designer.reproduce import Reproduced


def add_reproduce(commands: Subcommands) -> None:
    """Describe `reproduce` to the parser."""
    reproduce = add_command(
        commands, "reproduce", reproduce_command, "the paper's two examples: printed beside computed (a minute or two)"
    )
    add_figures(reproduce, "write the paper's figures 2 to 6 into this folder, of a run with Theorem 2's gains")
    add_table(reproduce, "the examples")
    reproduce.add_argument("--force", action="store_true", help="replace figures that exist")
    reproduce.add_argument("--json", action="store_true", help="print one JSON object")


def reproduce_command(options: argparse.Namespace) -> int:
    """`peakmesh reproduce`."""
    refuse_lone_options(options)
    refuse_both(options)
    if options.figures is not None:
        from designer.report import figures, paper

        figures.paths(paper.NAMES, options.figures, kind=options.format or FORMATS[0], force=options.force)
    from designer.reproduce import reproduce

    table = reproduce(report=lambda said: print(said, file=sys.stderr))
    files = [] if options.figures is None else [str(path) for path in _write_figures(table, options)]
    if options.json:
        print(json.dumps(table.document() | {"figures": files}))
    elif options.table:
        print(table.table(options.table), end="")
    else:
        print("\n".join([table.text(), *([f"\n{len(files)} figures in {options.figures}"] if files else [])]))
    return EXIT_GOOD


def _write_figures(table: Reproduced, options: argparse.Namespace) -> list[Path]:
    from designer.report import figures, paper
    from designer.reproduce import EXAMPLES

    charts = paper.charts(*(table.computed[name].theorem2 for name in EXAMPLES))
    drawings = figures.drawings(charts, stop=paper.STEPS)
    return figures.write(drawings, options.figures, kind=options.format or FORMATS[0], force=options.force)
