"""`peakmesh export`: a recording as a table for other programs."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from agent.commands.options import Subcommands, add_command
from agent.contract.errors import EXIT_GOOD, InputError, counted
from agent.contract.files import refuse_overwrite
from designer.commands.recordings import Progress, add_choice


def add_export(commands: Subcommands) -> None:
    """Describe `export` to the parser."""
    export = add_command(
        commands, "export", export_command, "a recording as a table: CSV, Parquet (peakmesh[parquet]) or MATLAB"
    )
    export.add_argument(
        "recordings", type=Path, nargs="+", metavar="RECORDING", help="recording, or the parts of one; cut ones too"
    )
    add_choice(export)
    to = export.add_mutually_exclusive_group(required=True)
    to.add_argument(
        "--csv", action="store_const", dest="to", const="csv", help="step, node, field and value in each row"
    )
    to.add_argument("--parquet", action="store_const", dest="to", const="parquet", help="the same in binary")
    to.add_argument(
        "--mat", action="store_const", dest="to", const="mat", help="arrays for MATLAB, a row for each step"
    )
    export.add_argument("--wide", action="store_true", help="one row for each step, one column for each number")
    export.add_argument("-o", "--output", type=Path, metavar="FILE", help="where to (beside the recording)")
    export.add_argument("--force", action="store_true", help="replace what exists")
    export.add_argument("--json", action="store_true", help="print one JSON object")


def export_command(options: argparse.Namespace) -> int:
    """`peakmesh export RECORDING`: what is not whole is exported as far as it goes, and stderr says so."""
    from designer.export import export
    from designer.replay.log import load

    if options.wide and options.to == "mat":
        raise InputError("--wide is for --csv and --parquet; a .mat file has arrays")
    output = options.output or options.recordings[0].with_suffix(f".{options.to}")
    refuse_overwrite(output, force=options.force)
    tell = Progress()
    log = load(
        options.recordings, run=options.run, gains=options.gains, report=lambda done, of: tell("reading", done, of)
    )
    facts = export(log, output, to=options.to, wide=options.wide, force=options.force)
    if facts["damage"]:
        print(f"{log.label}: {facts['damage']}", file=sys.stderr)
    if facts["absent"]:
        print(f"{counted(facts['absent'], 'message')} of the run not in it: NaN in their place", file=sys.stderr)
    print(json.dumps(facts) if options.json else _text(facts))
    return EXIT_GOOD


def _text(facts: dict[str, Any]) -> str:
    return f"{facts['steps']} steps, {facts['rows']} rows, {facts['shape']}\ntable      {facts['output']}"
