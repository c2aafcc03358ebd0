"""`peakmesh replay`: what a recording proves."""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from agent.commands.options import Subcommands, add_command
from agent.contract.errors import InputError
from designer.commands.more import add_more, replay_more

if TYPE_CHECKING:
    from designer.replay.part import Part

PATIENCE = 3.0  # seconds between words about progress


def add_replay(commands: Subcommands) -> None:
    """Describe `replay` to the parser."""
    replay = add_command(commands, "replay", replay_command, "hold a recording against the centralised error model")
    replay.add_argument(
        "recordings",
        type=Path,
        nargs="+",
        metavar="RECORDING",
        help="recording, or the .part of one that was cut; parts of one run are judged as one, several runs in a table",
    )
    add_choice(replay)
    replay.add_argument("--from", dest="first", type=_step, metavar="STEP", help="judge from this step on (0)")
    replay.add_argument("--to", dest="last", type=_step, metavar="STEP", help="judge up to this step (the last)")
    replay.add_argument("--node", metavar="NAME", help="judge what this node measured and sent alone")
    add_more(replay)
    replay.add_argument("--json", action="store_true", help="print one JSON object")


def add_choice(parser: argparse.ArgumentParser) -> None:
    """Add the options of every command that reads a run out of any file."""
    parser.add_argument("--run", metavar="NAME", help="which run, where a file holds several; its name or its start")
    parser.add_argument(
        "--gains", type=Path, metavar="FILE", help="the run's gains file, where a tool has left its attachments out"
    )


def replay_command(options: argparse.Namespace) -> int:
    """`peakmesh replay RECORDING...`."""
    from designer.replay import replay
    from designer.replay.several import replay_all, together

    groups = together(options.recordings, run=options.run)
    if options.other is not None or options.write is not None:
        return replay_more(groups, options, part=_part(options), report=Progress())
    with_options = {"run": options.run, "gains": options.gains, "part": _part(options), "report": Progress()}
    if len(groups) > 1:
        table = replay_all(groups, **with_options)
        print(json.dumps(table.document()) if options.json else table.text())
        return table.exit_code
    verdict = replay(groups[0], **with_options)
    print(json.dumps(verdict.document()) if options.json else verdict.text())
    return verdict.exit_code


def _part(options: argparse.Namespace) -> Part:
    from designer.replay.part import Part

    part = Part(node=options.node)
    if options.first is not None:
        part = part._replace(first=options.first)
    if options.last is not None:
        part = part._replace(last=options.last)
    if part.first > part.last:
        raise InputError(f"--from {part.first} --to {part.last}: there is no step between these")
    return part


def _step(text: str) -> int:
    if not (text.isdecimal() and len(text) < 19):
        raise argparse.ArgumentTypeError(f"{text} is not a step: 0, 1, 2, ...")
    return int(text)


class Progress:
    """Says on stderr how far something is, every few seconds."""

    def __init__(self) -> None:
        self._said = time.monotonic()

    def __call__(self, what: str, done: int, of: int) -> None:
        now = time.monotonic()
        if now >= self._said + PATIENCE:
            self._said = now
            print(f"{what} {100 * done // max(of, 1):3d} %", file=sys.stderr)
