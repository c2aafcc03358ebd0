"""`peakmesh run` and `peakmesh demo`: a whole network on this machine."""

from __future__ import annotations

import argparse
import json
import sys
from datetime import datetime
from pathlib import Path
from typing import Any

import agent.commands.run
from agent.commands.options import (
    Subcommands,
    add_command,
    add_recording_options,
    default_recording,
    load_gains,
    recording_plan_of,
)
from agent.commands.words import run_text
from agent.contract.errors import InputError, RecordingFailed
from agent.contract.files import refuse_overwrite
from designer.commands import PROBLEM, add_set, find_to_design
from designer.commands.design import add_method, design_and_save, design_text
from designer.commands.report import write_page


def add_demo(commands: Subcommands) -> None:
    """Describe `demo` to the parser."""
    demo = add_command(commands, "demo", demo_command, "design, run, replay and report an example (zhu2020-lossy)")
    demo.add_argument("problem", nargs="?", default="zhu2020-lossy", metavar="PROBLEM", help=PROBLEM)
    add_set(demo)
    add_method(demo)
    agent.commands.run.add_run_options(demo, output=("FOLDER", "for the files (recordings/demo-<time>)"))


def demo_command(options: argparse.Namespace) -> int:
    """`peakmesh demo`: the whole job; its files go to a folder of their own."""
    from designer.report.account import Account

    problem = find_to_design(options.problem, options.settings)
    folder = options.output or Path("recordings") / f"demo-{datetime.now():%Y%m%d-%H%M%S}"
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder} is a file; --output takes the folder for the demo's files")
    folder.mkdir(parents=True, exist_ok=True)
    gains_path, options.output = folder / "gains.json", folder / "run.mcap"
    page = folder / "report.html"
    for path in (gains_path, options.output, page):
        refuse_overwrite(path, force=options.force)

    gains, designed = design_and_save(problem, options.method, gains_path, force=options.force, budget=options.budget)
    _say(options, f"1. design\n{design_text(designed)}")
    ran = agent.commands.run.run_gains(gains_path, gains, options)
    if ran["broken_off"]:
        raise RecordingFailed(ran["broken_off"])
    _say(options, f"\n2. run: {gains.problem.n + 3} processes\n{run_text(ran)}")
    account = Account.of(options.output)
    _say(options, f"\n3. replay\n{account.verdict.text()}")
    write_page(account, page, force=options.force)
    _say(options, f"\n4. report\n{page}")
    if options.json:
        done = {"design": designed, "run": ran, "replay": account.verdict.document(), "report": str(page)}
        print(json.dumps(done))
    return account.verdict.exit_code or agent.commands.run.exit_code_of(ran)


def _say(options: argparse.Namespace, text: str) -> None:
    """Print a part of the demo as soon as it is known; with --json only the object at the end."""
    if not options.json:
        print(text, flush=True)


def add_run(commands: Subcommands) -> None:
    """Describe `run` to the parser."""
    run = add_command(commands, "run", run_command, "run every role as a process on this machine")
    run.add_argument("gains", metavar="PROBLEM_OR_GAINS", help=f"gains file, {PROBLEM}")
    add_set(run)
    add_method(run)
    agent.commands.run.add_run_options(run)
    add_recording_options(run)


def run_command(options: argparse.Namespace) -> int:
    """`peakmesh run PROBLEM_OR_GAINS`: a problem is designed first, its gains stand beside the recording."""
    path = Path(options.gains)
    if path.suffix == ".json" or (path.is_file() and path.suffix != ".toml"):
        if options.settings:
            raise InputError(f"--set {options.settings[0]} changes a problem; {path} has its gains already")
        for option in ("method", "budget"):
            if getattr(options, option) is not None:
                raise InputError(f"--{option} says how to design a problem; {path} has its gains already")
        ran = agent.commands.run.run_gains(path, load_gains(path), options, recording_plan_of(options))
        return _tell(ran, options)
    from agent.contract.recording.parts import refuse_recording
    from designer.ladder import rounded_up

    problem = find_to_design(options.gains, options.settings)
    if options.output is None:
        options.output = default_recording(f"{problem.name}-{datetime.now():%Y%m%d-%H%M%S}")
    refuse_recording(options.output, force=options.force)
    path = options.output.with_suffix(".gains.json")
    gains, _ = design_and_save(problem, options.method, path, force=options.force, budget=options.budget)
    print(f"designed {path}, gamma = {rounded_up(gains.certificate.gamma)}", file=sys.stderr)
    ran = agent.commands.run.run_gains(path, gains, options, recording_plan_of(options))
    return _tell({"gains": str(path), **ran}, options)


def _tell(ran: dict[str, Any], options: argparse.Namespace) -> int:
    """How the run went; of a paced one, what the bound says of it, too, which its recording tells."""
    lines = [run_text(ran)]
    if "pacing" in ran and not ran["broken_off"]:
        from designer.replay import ledger

        account = ledger([Path(part) for part in ran["parts"]])
        ran["ledger"] = account.document() if account is not None else None
        lines += [f"ledger     {account.text()}" if account is not None else "ledger     none: gamma is not proved"]
    lines += [f"gains      {ran['gains']}"] if "gains" in ran else []
    print(json.dumps(ran) if options.json else "\n".join(lines))
    return agent.commands.run.exit_code_of(ran)
