"""What commands share that look on at a run: their options, and the run itself."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING

from agent.commands.options import Subcommands, add_command, load_gains
from agent.commands.roles import add_network_options, network_of

if TYPE_CHECKING:
    from agent.roles.onlooker import Onlooker as Onlooker


def add_looker(
    commands: Subcommands, name: str, call: Callable[[argparse.Namespace], int], about: str
) -> argparse.ArgumentParser:
    """Add a command that looks on; `look_on` reads its options."""
    parser = add_command(commands, name, call, about)
    parser.add_argument(
        "gains", type=Path, nargs="?", metavar="GAINS", help="gains file of the run (asked of the run itself)"
    )
    add_network_options(parser, run="name of the run (the only one that is there)")
    return parser


def look_on(options: argparse.Namespace) -> AbstractContextManager[Onlooker]:
    """The run that the options name, or the only one that is there."""
    from agent.contract.keys import VIEWER
    from agent.roles.onlooker import looking_on

    problem = load_gains(options.gains).problem if options.gains is not None else None
    return looking_on(network_of(options, VIEWER, problem), run=options.run)
