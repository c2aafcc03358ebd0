"""The designer's commands. Each module has, for each of its commands, `add_<command>`, which describes it to the
parser, and `<command>_command`, which carries it out and returns an exit code (agent/contract/errors.py).

Modules of this folder import the standard library and light modules only, so that `peakmesh --help` answers at once
and a sensor node started by this program never loads a solver; a command imports what it needs when it is called.
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from agent.contract.problem import Problem

PROBLEM = "problem file, or the name of a built-in problem (peakmesh show lists them)"


def tell_notes(problem: Problem) -> list[str]:
    """What the problem assumes (designer/diagnosis.py), on stderr and returned; of built-in ones `show` alone tells."""
    from designer.diagnosis import notes
    from designer.problems import is_built_in

    found = notes(problem)
    for note in [] if is_built_in(problem) else found:
        print(f"warning: {note}", file=sys.stderr)
    return found
