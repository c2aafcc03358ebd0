"""`peakmesh new`: a problem file to begin with."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from agent.commands.options import Subcommands, add_command, add_output_options
from agent.contract.errors import EXIT_GOOD
from agent.contract.files import write_whole


def add_new(commands: Subcommands) -> None:
    """Describe `new` to the parser."""
    new = add_command(commands, "new", new_command, "write a problem file with comments, to put your numbers in")
    new.add_argument("name", metavar="NAME", help="of the problem")
    add_output_options(new, "FILE", "where to (NAME.toml)")
    new.add_argument("--json", action="store_true", help="print one JSON object")


def new_command(options: argparse.Namespace) -> int:
    """`peakmesh new NAME`."""
    from designer.problems import template

    text = template(options.name)
    path = options.output or Path(f"{options.name}.toml")
    write_whole(path, text.encode(), force=options.force)
    facts = {"problem": options.name, "output": str(path)}
    print(json.dumps(facts) if options.json else f"problem    {path}\nnext       peakmesh design {path}")
    return EXIT_GOOD
