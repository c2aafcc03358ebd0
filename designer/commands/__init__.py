"""The designer's commands. Each module has, for each of its commands, `add_<command>`, which describes it to the
parser, and `<command>_command`, which carries it out and returns an exit code (agent/contract/errors.py).

Modules of this folder import the standard library and light modules only, so that `peakmesh --help` answers at once
and a sensor node started by this program never loads a solver; a command imports what it needs when it is called.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

from agent.contract.errors import InputError

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


def add_table(parser: argparse.ArgumentParser, about: str) -> None:
    """Add --table; `refuse_both` holds it against --json."""
    parser.add_argument("--table", choices=("csv", "latex"), help=f"print {about} as a table alone")


def refuse_both(options: argparse.Namespace) -> None:
    """InputError where two forms of the same are asked for."""
    if options.table and options.json:
        raise InputError("--table and --json print the same in two forms; leave one of them out")


def find_to_design(text: str, settings: Sequence[str] = ()) -> Problem:
    """The problem that `text` names, which has something to estimate. InputError, with that name in it, otherwise."""
    from designer.diagnosis import refuse_nothing_to_estimate
    from designer.problems import find

    problem = find(text, settings)
    try:
        refuse_nothing_to_estimate(problem)
    except InputError as error:
        raise InputError(f"{text}: {error}") from None
    return problem


def tell_notes(problem: Problem) -> list[str]:
    """What may not be meant (designer/problems/notes.py), returned and on stderr; of built-in ones not there."""
    from designer.problems import is_built_in
    from designer.problems.notes import notes

    found = notes(problem)
    for note in [] if is_built_in(problem) else found:
        print(f"warning: {note}", file=sys.stderr)
    return found
