"""The program `peakmesh`: the designer's commands (designer/commands), and the runtime's beside them.

Results on stdout, progress and errors on stderr; `--json` prints one object with the same facts.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from importlib.metadata import version

import agent.cli
from agent.commands.doctor import add_doctor
from agent.commands.roles import add_roles
from agent.contract.errors import EXIT_INPUT
from designer.commands import (
    analyse,
    compare,
    conform,
    design,
    export,
    identify,
    keys,
    new,
    program,
    recordings,
    recover,
    report,
    reproduce,
    runs,
    show,
    simulate,
    sweep,
    verify,
    watch,
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns its exit code (agent/contract/errors.py)."""
    agent.cli.open_streams()
    parser = argparse.ArgumentParser(
        prog="peakmesh",
        allow_abbrev=False,
        description="Design, run and audit distributed peak-error filters.",
        epilog="Exit codes: 0 good; 1 the answer is no; 2 bad input; 3 the run broke; 129, 130 or 143 by a signal.",
    )
    parser.add_argument("-V", "--version", action="version", version=f"peakmesh {version('peakmesh')}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND")
    runs.add_demo(commands)
    new.add_new(commands)
    design.add_design(commands)
    sweep.add_sweep(commands)
    analyse.add_analyse(commands)
    verify.add_verify(commands)
    runs.add_run(commands)
    recordings.add_replay(commands)
    recover.add_recover(commands)
    compare.add_compare(commands)
    export.add_export(commands)
    identify.add_identify(commands)
    simulate.add_simulate(commands)
    report.add_report(commands)
    reproduce.add_reproduce(commands)
    show.add_show(commands)
    add_roles(commands)
    conform.add_conform(commands)
    watch.add_watch(commands)
    keys.add_keys(commands)
    add_doctor(commands)
    program.add_completion(commands, parser)
    program.add_help(commands, parser)
    options = parser.parse_args(arguments)
    if options.command is None:
        parser.print_help(sys.stderr)
        return EXIT_INPUT
    return agent.cli.perform(options)
