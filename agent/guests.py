"""Guests: programs of the user's that take part in a run on this machine, in place of roles of our own.

A guest is told where the run is: {run}, {node}, {address} of the coordinator and the file of the {gains} are put into
its command where they stand there, and are in its environment, as `peakmesh node` takes them from there.
"""

from __future__ import annotations

import shlex
import shutil
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from agent.contract.errors import InputError
from agent.contract.gains import Gains
from agent.contract.keys import PLANT, in_words, node_who, sensor_who

_VARIABLES = {"run": "PEAKMESH_RUN", "node": "PEAKMESH_NODE", "address": "PEAKMESH_CONNECT", "gains": "PEAKMESH_GAINS"}

Guests = Mapping[str, Sequence[str]]  # by who they are: the words of the command, none where somebody else starts it


class Program(NamedTuple):
    """A guest's command with what it is told, and the variables that say the same."""

    words: list[str]
    environment: dict[str, str]


def guests(
    gains: Gains,
    *,
    nodes: Mapping[str, str | Sequence[str]],
    sensors: Mapping[str, str | Sequence[str]],
    plant: str | Sequence[str] | None,
) -> dict[str, list[str]]:
    """By who they are, from commands by node. Raises InputError where there is no such node, or no such program."""
    for name in (*nodes, *sensors):
        gains.problem.node_index(name)
    commands = {node_who(name): command for name, command in nodes.items()}
    commands |= {sensor_who(name): command for name, command in sensors.items()}
    commands |= {PLANT: plant} if plant is not None else {}
    return {who: _words(who, command) for who, command in commands.items()}


def _words(who: str, command: str | Sequence[str]) -> list[str]:
    try:
        words = shlex.split(command) if isinstance(command, str) else [str(word) for word in command]
    except ValueError as error:
        raise InputError(f"the command of {in_words(who)}, {command}, cannot be read: {error}") from None
    if words and shutil.which(words[0]) is None:
        raise InputError(f"the command of {in_words(who)}, {words[0]}, cannot be started: there is no such program")
    return words


def programs(guests: Guests, *, run: str, address: str, gains: str) -> dict[str, Program]:
    """What to start, by who they are."""
    found = {}
    for who, words in ((who, words) for who, words in guests.items() if words):
        facts = {"run": run, "node": who.partition("-")[2], "address": address, "gains": gains}
        environment = {_VARIABLES[name]: value for name, value in facts.items()}
        found[who] = Program([_put_in(word, facts) for word in words], environment)
    return found


def _put_in(word: str, facts: Mapping[str, str]) -> str:
    for name, value in facts.items():
        word = word.replace(f"{{{name}}}", value)
    return word
