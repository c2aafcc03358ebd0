"""`peakmesh reproduce`: the paper's table, printed beside computed."""

from __future__ import annotations

import argparse
import json
import sys

from agent.commands.options import Subcommands, add_command
from agent.contract.errors import EXIT_GOOD


def add_reproduce(commands: Subcommands) -> None:
    """Describe `reproduce` to the parser."""
    reproduce = add_command(
        commands, "reproduce", reproduce_command, "the paper's two examples: printed beside computed (a minute or two)"
    )
    reproduce.add_argument("--json", action="store_true", help="print one JSON object")


def reproduce_command(options: argparse.Namespace) -> int:
    """`peakmesh reproduce`."""
    from designer.reproduce import reproduce

    table = reproduce(report=lambda said: print(said, file=sys.stderr))
    print(json.dumps(table.document()) if options.json else table.text())
    return EXIT_GOOD
