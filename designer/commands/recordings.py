"""`peakmesh replay`: what a recording proves."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from agent.commands.options import Subcommands, add_command


def add_replay(commands: Subcommands) -> None:
    """Describe `replay` to the parser."""
    replay = add_command(commands, "replay", replay_command, "hold a recording against the centralised error model")
    replay.add_argument("recording", type=Path, metavar="RECORDING", help="recording, or the .part of one that was cut")
    replay.add_argument("--json", action="store_true", help="print one JSON object")


def replay_command(options: argparse.Namespace) -> int:
    """`peakmesh replay RECORDING`."""
    from designer.replay import replay

    verdict = replay(options.recording)
    print(json.dumps(verdict.document()) if options.json else verdict.text())
    return verdict.exit_code
