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
    add_guest_options,
    add_output_options,
    add_plan_options,
    add_recording_options,
    default_recording,
    guests_of,
    load_gains,
    plan_of,
    positive,
    recording_plan_of,
)
from agent.commands.security import add_keys_option
from agent.commands.words import progress, run_text
from agent.contract.errors import EXIT_BROKEN, EXIT_GOOD

if TYPE_CHECKING:
    from agent.contract.gains import Gains
    from agent.plan import RecordingPlan


def add_run(commands: Subcommands) -> None:
    """Describe `run` to the parser."""
    run = add_command(commands, "run", run_command, "run every role as a process on this machine")
    run.add_argument("gains", type=Path, metavar="GAINS", help="gains file, from peakmesh design")
    add_run_options(run)
    add_recording_options(run)


def add_run_options(parser: argparse.ArgumentParser, *, output: tuple[str, str] = RECORDING) -> None:
    """The options of `run`, but for what to run and how to record it; `output` is what --output takes, and its help."""
    add_plan_options(parser)
    add_guest_options(parser)
    add_output_options(parser, *output)
    parser.add_argument(
        "--wait", type=positive, default=60.0, metavar="S", help="seconds to wait for all to start (60)"
    )
    add_keys_option(parser)
    parser.add_argument("--json", action="store_true", help="print one JSON object")


def run_command(options: argparse.Namespace) -> int:
    """`peakmesh run GAINS`."""
    gains = load_gains(options.gains)
    result = run_gains(options.gains, gains, options, recording_plan_of(options))
    print(json.dumps(result) if options.json else run_text(result))
    return exit_code_of(result)


def exit_code_of(result: dict[str, Any]) -> int:
    """A run that was not recorded to its end is broken, also where it was allowed to go on, and of whomever."""
    return EXIT_BROKEN if result["broken_off"] or result["not_whole"] else EXIT_GOOD


def run_gains(
    path: Path, gains: Gains, options: argparse.Namespace, recording_plan: RecordingPlan | None = None
) -> dict[str, Any]:
    """Run the gains in `path` on this machine; returns the facts of the run."""
    from agent.contract.recording.parts import files_of, refuse_recording
    from agent.launch import launch

    external, sensors = options.external, [name for name, _ in options.sensor]
    options.external = list(dict.fromkeys([*external, *sensors]))
    plan = plan_of(options, gains)
    guests = guests_of(options, gains)
    run = f"{gains.problem.name}-{os.urandom(4).hex()}"
    recording = options.output or default_recording(run)
    refuse_recording(recording, force=options.force)
    keys = "" if options.keys is None else f" --keys {options.keys}"
    live = f"peakmesh live {path} --run {run}{keys}"
    with progress(
        plan.steps, live=live, run=run, external=[name for name in external if name not in sensors]
    ) as report:
        summary = launch(
            path,
            gains,
            plan,
            run=run,
            recording=recording,
            force=options.force,
            wait=options.wait,
            report=report,
            recording_plan=recording_plan,
            keys=options.keys,
            guests=guests,
        )
    parts = [str(part) for part in files_of(recording)]
    return {"recording": str(recording), "parts": parts, "run": run, "seed": plan.seed, **summary}
