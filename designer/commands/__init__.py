"""The designer's commands. Each module has, for each of its commands, `add_<command>`, which describes it to the
parser, and `<command>_command`, which carries it out and returns an exit code (agent/contract/errors.py).

Modules of this folder import the standard library and light modules only, so that `peakmesh --help` answers at once
and a sensor node started by this program never loads a solver; a command imports what it needs when it is called.
"""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from agent.contract.problem import Problem

PROBLEM = "problem file, or the name of a built-in problem (peakmesh show lists them)"


def add_set(parser: argparse.ArgumentParser, *, also: str = "") -> None:
    """Add the option of every command that takes a problem."""
    parser.add_argument(
        "--set",
        dest="settings",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="another value in the problem, such as 'node.*.arrival_probability=0.7' or plant.A.1.2=0.1, rows and "
        f"columns counted from 1; may be repeated{also}",
    )


def tell_notes(problem: Problem) -> list[str]:
    """What may not be meant (designer/problems/notes.py), returned and on stderr; of built-in ones not there."""
    from designer.problems import is_built_in
    from designer.problems.notes import notes

    found = notes(problem)
    for note in [] if is_built_in(problem) else found:
        print(f"warning: {note}", file=sys.stderr)
    return found
