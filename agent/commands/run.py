"""`peakmesh run`: every role as a process on this machine."""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from agent.commands.options import (
    RECORDING,
    Subcommands,
    add_command,
    add_output_options,
    add_plan_options,
    default_recording,
    load_gains,
    plan_of,
    positive,
)
from agent.commands.words import progress, run_text
from agent.contract.errors import EXIT_GOOD

if TYPE_CHECKING:
    from agent.contract.gains import Gains


def add_run(commands: Subcommands) -> None:
    """Describe `run` to the parser."""
    run = add_command(commands, "run", run_command, "run every role as a process on this machine")
    run.add_argument("gains", type=Path, metavar="GAINS", help="gains file, from peakmesh design")
    add_run_options(run)


def add_run_options(parser: argparse.ArgumentParser, *, output: tuple[str, str] = RECORDING) -> None:
    """The options of `run`, but for what to run; `output` is what --output takes, and its help."""
    add_plan_options(parser)
    add_output_options(parser, *output)
    parser.add_argument(
        "--wait", type=positive, default=60.0, metavar="S", help="seconds to wait for all to start (60)"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")


def run_command(options: argparse.Namespace) -> int:
    """`peakmesh run GAINS`."""
    gains = load_gains(options.gains)
    result = run_gains(options.gains, gains, options)
    print(json.dumps(result) if options.json else run_text(result))
    return EXIT_GOOD


def run_gains(path: Path, gains: Gains, options: argparse.Namespace) -> dict[str, Any]:
    """Run the gains in `path` on this machine; returns the facts of the run."""
    from agent.contract.recording.writer import refuse_recording
    from agent.launch import launch

    plan = plan_of(options, gains)
    run = f"{gains.problem.name}-{os.urandom(4).hex()}"
    recording = options.output or default_recording(run)
    refuse_recording(recording, force=options.force)
    with progress(plan.steps) as report:
        summary = launch(
            path, gains, plan, run=run, recording=recording, force=options.force, wait=options.wait, report=report
        )
    return {"recording": str(recording), "run": run, "seed": plan.seed, **summary}
