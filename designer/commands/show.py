"""`peakmesh show`: what a file is."""

from __future__ import annotations

import argparse
import json
import sys
from importlib.metadata import version
from pathlib import Path

from agent.commands.options import Subcommands, add_command
from agent.contract.errors import EXIT_GOOD, InputError
from agent.contract.files import refuse_overwrite, write_whole
from designer.commands import add_set
from designer.commands.recordings import Progress, add_choice

CITATION = """\
@software{{peakmesh,
  title = {{peakmesh: design, run and audit distributed peak-error filters}},
  version = {{{version}}},
  license = {{Apache-2.0}},
  year = {{2026}}
}}

@article{{zhu2020distributed,
  title = {{Distributed $l_2$-$l_\\infty$ filtering for sensor networks with missing measurements
    and switching topology}},
  author = {{Zhu, F. and Wen, J. and Peng, L. and Yang, R.}},
  journal = {{Control and Decision}},
  volume = {{35}},
  number = {{8}},
  pages = {{1841--1848}},
  year = {{2020}},
  doi = {{10.13195/j.kzyjc.2018.1301}}
}}
"""


def add_show(commands: Subcommands) -> None:
    """Describe `show` to the parser."""
    show = add_command(commands, "show", show_command, "what a file is; without one, the built-in problems")
    show.add_argument("file", nargs="?", metavar="FILE", help="problem, gains file or recording")
    add_set(show)
    show.add_argument(
        "--toml", action="store_true", help="a problem as its file, also a built-in one, or that of a gains file"
    )
    show.add_argument("--cite", action="store_true", help="how to cite peakmesh and the paper, as BibTeX")
    add_choice(show)
    show.add_argument(
        "--get", metavar="NAME", help="take an attachment out of a recording: layout.json, gains.json or problem.json"
    )
    show.add_argument("-o", "--output", type=Path, metavar="FILE", help="where --get and --toml write to (to stdout)")
    show.add_argument("--force", action="store_true", help="replace that file if it exists")
    show.add_argument("--json", action="store_true", help="print one JSON object")


def show_command(options: argparse.Namespace) -> int:
    """`peakmesh show [FILE]`."""
    from designer import show

    if options.cite:
        print(CITATION.format(version=version("peakmesh")), end="")
        return EXIT_GOOD
    if options.toml:
        return _toml(options)
    if options.get is not None:
        return _get(options)
    if options.output is not None:
        raise InputError("--output is for --get, which takes an attachment out of a recording, and for --toml")
    tell = Progress()
    facts = show.describe(
        options.file,
        run=options.run,
        gains=options.gains,
        report=lambda done, of: tell("reading", done, of),
        settings=options.settings,
    )
    print(json.dumps(facts) if options.json else show.text(facts))
    return EXIT_GOOD


def _toml(options: argparse.Namespace) -> int:
    """`peakmesh show PROBLEM --toml`."""
    from designer import show

    if options.file is None or options.get is not None or options.json:
        raise InputError("--toml prints one problem as its file; name the problem, and leave --get and --json out")
    text = show.as_toml(options.file, settings=options.settings)
    if options.output is None:
        print(text, end="")
    else:
        write_whole(options.output, text.encode(), force=options.force)
    return EXIT_GOOD


def _get(options: argparse.Namespace) -> int:
    """`peakmesh show RECORDING --get NAME`."""
    from designer import show

    if options.file is None:
        raise InputError("--get takes an attachment out of a recording; name the recording")
    if options.output is not None:
        refuse_overwrite(options.output, force=options.force)
    data = show.attachment(Path(options.file), options.get, run=options.run, gains=options.gains)
    if options.output is None:
        sys.stdout.buffer.write(data)
        return EXIT_GOOD
    write_whole(options.output, data, force=options.force)
    facts = {"attachment": options.get, "output": str(options.output), "bytes": len(data)}
    print(json.dumps(facts) if options.json else f"{options.get}, {len(data)} bytes: {options.output}")
    return EXIT_GOOD
