"""`peakmesh show`: what a file is."""

from __future__ import annotations

import argparse
import json

from agent.commands.options import Subcommands, add_command
from agent.contract.errors import EXIT_GOOD
from designer.commands.recordings import Progress, add_choice


def add_show(commands: Subcommands) -> None:
    """Describe `show` to the parser."""
    show = add_command(commands, "show", show_command, "what a file is; without one, the built-in problems")
    show.add_argument("file", nargs="?", metavar="FILE", help="problem, gains file or recording")
    add_choice(show)
    show.add_argument("--json", action="store_true", help="print one JSON object")


def show_command(options: argparse.Namespace) -> int:
    """`peakmesh show [FILE]`."""
    from designer import show

    tell = Progress()
    facts = show.describe(
        options.file, run=options.run, gains=options.gains, report=lambda done, of: tell("reading", done, of)
    )
    print(json.dumps(facts) if options.json else show.text(facts))
    return EXIT_GOOD
