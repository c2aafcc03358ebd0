"""`peakmesh identify`: recorded runs against the probabilities of their model."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from agent.commands.options import Subcommands, add_command, add_output_options
from agent.contract.errors import InputError
from agent.contract.files import refuse_overwrite, write_whole
from designer.commands.recordings import Progress, add_choice

if TYPE_CHECKING:
    from agent.contract.problem import Problem


def add_identify(commands: Subcommands) -> None:
    """Describe `identify` to the parser."""
    identify = add_command(
        commands, "identify", identify_command, "test recorded losses, deliveries and modes against the model"
    )
    identify.add_argument(
        "recordings", type=Path, nargs="+", metavar="RECORDING", help="recordings of runs of the same gains"
    )
    add_choice(identify)
    identify.add_argument(
        "--level", type=_level, default=0.01, help="probability that a model that is right is said not to fit (0.01)"
    )
    add_output_options(identify, "PROBLEM", "write the problem with what was observed")
    identify.add_argument("--json", action="store_true", help="print one JSON object")


def identify_command(options: argparse.Namespace) -> int:
    """`peakmesh identify RECORDING... [-o PROBLEM]`: exit code 1 where something does not fit."""
    from designer.identify import identify
    from designer.replay.log import load
    from designer.replay.several import together

    if options.output is not None:
        refuse_overwrite(options.output, force=options.force)
    tell = Progress()
    logs = [
        load(group, run=options.run, gains=options.gains, report=lambda done, of: tell("reading", done, of))
        for group in together(options.recordings, run=options.run)
    ]
    for log in logs:
        if log.is_doubtful:
            raise InputError(f"{log.label}: {log.damage}; what it says cannot be counted")
    found = identify(logs, level=options.level)
    if options.output is not None:
        if found.problem is None:
            raise InputError(f"{options.output} is not written: {found.refusal}")
        _write(found.problem, options.output, force=options.force)
    print(json.dumps(found.document()) if options.json else found.text())
    if options.output is not None:
        print(f"written    {options.output}", file=sys.stderr if options.json else sys.stdout)
    return found.exit_code


def _write(problem: Problem, path: Path, *, force: bool) -> None:
    """problem.toml, and the CSV file of its disturbance beside it, first."""
    from designer.problems.written import to_toml

    table = path.with_suffix(".csv")
    if problem.disturbance.kind == "csv":
        rows = "\n".join(",".join(map(repr, row)) for row in problem.disturbance.values.tolist())
        write_whole(table, (rows + "\n").encode(), force=force)
    write_whole(path, to_toml(problem, csv=table.name).encode(), force=force)


def _level(text: str) -> float:
    try:
        level = float(text)
    except ValueError:
        level = 0.0
    if not 1e-3 <= level <= 0.5:
        raise argparse.ArgumentTypeError(f"{text} is not a level between 0.001 and 0.5")
    return level
