"""`peakmesh recover`: a recording written anew from what can be read of it."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from agent.commands.options import Subcommands, add_command
from agent.contract.errors import EXIT_GOOD, counted
from designer.commands.recordings import Progress, add_choice


def add_recover(commands: Subcommands) -> None:
    """Describe `recover` to the parser."""
    recover = add_command(
        commands, "recover", recover_command, "write a recording anew, whole and indexed, from what can be read of it"
    )
    recover.add_argument(
        "recordings", type=Path, nargs="+", metavar="RECORDING", help="recording, or all parts that there are of one"
    )
    recover.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="where to")
    add_choice(recover)
    recover.add_argument("--force", action="store_true", help="replace that file if it exists")
    recover.add_argument("--json", action="store_true", help="print one JSON object")


def recover_command(options: argparse.Namespace) -> int:
    """`peakmesh recover RECORDING... -o FILE`: exit code 0 where a recording was written, whatever was lost."""
    from agent.contract.recording.recover import recover

    tell = Progress()
    found = recover(
        options.recordings,
        options.output,
        run=options.run,
        gains=options.gains,
        force=options.force,
        report=lambda done, of: tell("reading", done, of),
    )
    if options.json:
        print(json.dumps({"recording": str(options.output), **found._asdict()}))
        return EXIT_GOOD
    lines = [f"{options.output}: {counted(found.messages, 'message')}, {counted(found.steps, 'complete step')}"]
    lines += [f"lost       {found.damage}"] if found.damage else []
    lines += [f"left out   {counted(found.copies, 'copy')} of messages that are there"] if found.copies else []
    lines += [f"left out   {counted(found.foreign, 'message')} of others"] if found.foreign else []
    lines += [f"note       {note}" for note in found.notes]
    print("\n".join([*lines, f"next       peakmesh replay {options.output}"]))
    return EXIT_GOOD
