"""`peakmesh report`: how a recording looks."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from agent.commands.options import Subcommands, add_command
from agent.contract.errors import EXIT_GOOD


def add_report(commands: Subcommands) -> None:
    """Describe `report` to the parser."""
    report = add_command(commands, "report", report_command, "pictures of a recording, as SVG and PNG")
    report.add_argument("recording", type=Path, metavar="RECORDING", help="MCAP file of a run")
    report.add_argument("-o", "--output", type=Path, metavar="FOLDER", help="where to (beside the recording)")
    report.add_argument("--force", action="store_true", help="replace pictures that exist")
    report.add_argument("--json", action="store_true", help="print one JSON object")


def report_command(options: argparse.Namespace) -> int:
    """`peakmesh report RECORDING`."""
    pictures = write_pictures(options.recording, options.output or options.recording.parent, force=options.force)
    print(json.dumps({"pictures": pictures}) if options.json else "\n".join(pictures))
    return EXIT_GOOD


def write_pictures(recording: Path, folder: Path, *, force: bool) -> list[str]:
    """Draw the pictures of a recording into a folder; returns the files."""
    from designer.report import figures

    return [str(path) for path in figures.write(recording, folder, force=force)]
