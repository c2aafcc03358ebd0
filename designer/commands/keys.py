"""`peakmesh keys` of the runtime, for built-in problems too."""

from __future__ import annotations

from typing import TYPE_CHECKING

import agent.commands.keys
from agent.commands.options import Subcommands
from designer.commands import PROBLEM

if TYPE_CHECKING:
    from agent.contract.problem import Problem


def add_keys(commands: Subcommands) -> None:
    """Describe `keys` to the parser."""
    agent.commands.keys.add_keys(commands, find=_find, about=PROBLEM)


def _find(text: str) -> Problem:
    from designer.problems import find

    return find(text)
