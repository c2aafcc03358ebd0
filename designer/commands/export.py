"""`peakmesh export`: a recording as a table for other programs, and a node's gains as C for a device."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from agent.commands.options import Subcommands, add_command, count, load_gains
from agent.contract.errors import EXIT_GOOD, EXIT_NO, InputError, counted, listed
from agent.contract.files import refuse_overwrite
from designer.commands.recordings import Progress, add_choice


def add_export(commands: Subcommands) -> None:
    """Describe `export` to the parser."""
    export = add_command(
        commands,
        "export",
        export_command,
        "a recording as a table: CSV, Parquet (peakmesh[parquet]) or MATLAB; a node of a gains file as C",
    )
    export.add_argument(
        "recordings",
        type=Path,
        nargs="+",
        metavar="FILE",
        help="recording, or the parts of one, cut ones too; with --c, --npz or --mat a gains file",
    )
    add_choice(export)
    to = export.add_mutually_exclusive_group(required=True)
    to.add_argument(
        "--csv", action="store_const", dest="to", const="csv", help="step, node, field and value in each row"
    )
    to.add_argument("--parquet", action="store_const", dest="to", const="parquet", help="the same in binary")
    to.add_argument(
        "--npz", action="store_const", dest="to", const="npz", help="of gains: K and H as one matrix for each mode"
    )
    to.add_argument(
        "--mat",
        action="store_const",
        dest="to",
        const="mat",
        help="the same for MATLAB; of a recording a row for each step",
    )
    to.add_argument(
        "--c", action="store_const", dest="to", const="c", help="a node's filter as C99 for a device, with a self-test"
    )
    export.add_argument("--wide", action="store_true", help="one row for each step, one column for each number")
    _add_c(export)
    export.add_argument(
        "-o", "--output", type=Path, metavar="FILE", help="where to (beside the recording); a folder with --c (node_N)"
    )
    export.add_argument("--force", action="store_true", help="replace what exists")
    export.add_argument("--json", action="store_true", help="print one JSON object")


def _add_c(export: argparse.ArgumentParser) -> None:
    """Add what goes with --c alone."""
    export.add_argument("--node", metavar="NAME", help="with --c: which node")
    export.add_argument("--float", dest="single", action="store_true", help="with --c: in float, not in double")
    export.add_argument(
        "--vectors", type=Path, metavar="RECORDING", help="with --c: what the self-test tells the node (made up)"
    )
    export.add_argument("--steps", type=count, metavar="N", help="with --c: steps of the self-test (200)")


def export_command(options: argparse.Namespace) -> int:
    """`peakmesh export FILE`."""
    only_c = {"--node": options.node, "--float": options.single, "--vectors": options.vectors, "--steps": options.steps}
    if options.to == "c":
        return _export_c(options)
    for name in (name for name, value in only_c.items() if value):
        raise InputError(f"{name} is for --c; a recording is exported whole")
    if options.to == "npz" or (options.to == "mat" and options.recordings[0].suffix == ".json"):
        return _export_gains(options)
    return _export_table(options)


def _export_c(options: argparse.Namespace) -> int:
    """A node as C; exit code 1 where a compiler of this machine makes a node of it that computes otherwise."""
    from agent.embed import STEPS, export
    from agent.embed.compiler import build
    from agent.embed.names import names_of

    if len(options.recordings) > 1:
        raise InputError(f"--c takes one gains file, not {len(options.recordings)}; --vectors names a recording")
    for name in (name for name in ("wide", "run", "gains") if getattr(options, name)):
        raise InputError(f"--{name} says something of a recording; --c takes a gains file")
    gains = load_gains(options.recordings[0])
    if options.node is None:
        raise InputError(f"--c is of one node; name it with --node: {listed(gains.problem.node_names)}")
    folder = options.output or Path(names_of(gains.problem, options.node).node)
    facts = export(
        gains,
        options.node,
        folder,
        single=options.single,
        recording=options.vectors,
        steps=options.steps or STEPS,
        force=options.force,
    )
    built = build(folder, facts["name"])
    facts["built"] = None if built is None else built._asdict()
    print(json.dumps(facts) if options.json else _text_of_c(facts))
    return EXIT_GOOD if built is None or built.passes else EXIT_NO


def _text_of_c(facts: dict[str, Any]) -> str:
    vectors = f"{facts['steps']} steps of {facts['recording'] or 'chance, as the agent answers them'}"
    begins = f", begun again {counted(facts['begins'], 'time')}" if facts["begins"] else ""
    lines = [f"node {facts['node']} of {facts['problem']} as C, in {facts['real']}: {facts['output']}"]
    lines += [f"files      {', '.join(facts['files'])}", f"vectors    {vectors}{begins}"]
    if facts["off"] is not None:
        off = f"{facts['off']:.2g} at most, of estimates up to {facts['largest']:.2g}"
        lines.append(f"float      an estimate is off the recorded one by {off}")
    built = facts["built"]
    if built is None:
        return "\n".join(
            [*lines, "self-test  not run, and sizes not known: there is no C compiler here (cc, gcc, clang)"]
        )
    lines.append(f"self-test  {'passes' if built['passes'] else 'FAILS'} with {built['compiler']}: {built['says']}")
    if built["text"] is not None:
        stack = "" if built["stack"] is None else f"; stack {built['stack']} bytes at most"
        lines.append(
            f"size       text {built['text']}, data {built['data']}, bss {built['bss']} bytes{stack}; -Os, here"
        )
    return "\n".join(lines)


def _export_table(options: argparse.Namespace) -> int:
    """What is not whole is exported as far as it goes, and stderr says so."""
    from designer.export import export
    from designer.replay.log import load

    if options.wide and options.to == "mat":
        raise InputError("--wide is for --csv and --parquet; a .mat file has arrays")
    output = options.output or options.recordings[0].with_suffix(f".{options.to}")
    refuse_overwrite(output, force=options.force)
    tell = Progress()
    log = load(
        options.recordings, run=options.run, gains=options.gains, report=lambda done, of: tell("reading", done, of)
    )
    facts = export(log, output, to=options.to, wide=options.wide, force=options.force)
    if facts["damage"]:
        print(f"warning: {log.label}: {facts['damage']}", file=sys.stderr)
    if facts["absent"]:
        print(
            f"warning: {counted(facts['absent'], 'message')} of the run not in it: NaN in their place", file=sys.stderr
        )
    print(json.dumps(facts) if options.json else _text(facts))
    return EXIT_GOOD


def _export_gains(options: argparse.Namespace) -> int:
    """`peakmesh export GAINS --npz` or `--mat`."""
    from designer import stacked

    path, *more = options.recordings
    if more:
        raise InputError(f"--{options.to} takes one gains file, not {1 + len(more)}")
    for name in (name for name in ("wide", "run", "gains") if getattr(options, name)):
        raise InputError(f"--{name} says something of a recording; {path} is to be a gains file")
    gains, output = load_gains(path), options.output or path.with_suffix(f".{options.to}")
    facts = stacked.save(gains, output, to=options.to, force=options.force)
    size = " and ".join(f"{letter} {' x '.join(map(str, facts[letter]))}" for letter in ("K", "H"))
    print(json.dumps(facts) if options.json else f"{counted(facts['modes'], 'mode')}, {size}\ngains      {output}")
    return EXIT_GOOD


def _text(facts: dict[str, Any]) -> str:
    return f"{facts['steps']} steps, {facts['rows']} rows, {facts['shape']}\ntable      {facts['output']}"
