"""`peakmesh compare`: are two recordings the same run?"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from agent.commands.options import Subcommands, add_command


def add_compare(commands: Subcommands) -> None:
    """Describe `compare` to the parser."""
    compare = add_command(
        commands,
        "compare",
        compare_command,
        "two recordings: the same run bit for bit, or how far apart, and where first",
    )
    compare.add_argument("a", type=Path, metavar="A", help="recording")
    compare.add_argument("b", type=Path, metavar="B", help="recording")
    compare.add_argument("--json", action="store_true", help="print one JSON object")


def compare_command(options: argparse.Namespace) -> int:
    """`peakmesh compare A B`: exit code 1 where they differ."""
    from designer.compare import compare

    comparison = compare(options.a, options.b)
    print(json.dumps(comparison.document()) if options.json else comparison.text())
    return comparison.exit_code
