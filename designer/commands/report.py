"""`peakmesh report`: a run as a page to look at, as figures for a paper, and as tables."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from agent.commands.options import Subcommands, add_command
from agent.contract.errors import EXIT_GOOD, InputError
from agent.contract.files import refuse_overwrite, write_whole
from designer.commands.recordings import Progress, add_choice

if TYPE_CHECKING:
    from designer.report.account import Account

FORMATS = ("pdf", "svg", "png")


def add_report(commands: Subcommands) -> None:
    """Describe `report` to the parser."""
    report = add_command(
        commands, "report", report_command, "a recording as one page: the verdict, and what happened, in pictures"
    )
    report.add_argument(
        "recordings", type=Path, nargs="+", metavar="RECORDING", help="recording, or the parts of one run"
    )
    report.add_argument("-o", "--output", type=Path, metavar="FILE", help="HTML file (RECORDING.html)")
    add_choice(report)
    add_figures(report, "write every picture for a paper into this folder; the page only where --output names it")
    report.add_argument("--data", action="store_true", help="with --figures: the numbers behind each as CSV beside it")
    report.add_argument("--force", action="store_true", help="replace files that exist")
    report.add_argument("--json", action="store_true", help="print one JSON object")


def add_figures(parser: argparse.ArgumentParser, about: str) -> None:
    """--figures and --format."""
    parser.add_argument("--figures", type=Path, metavar="FOLDER", help=about)
    parser.add_argument(
        "--format", choices=FORMATS, help="of the figures (pdf); each at the width of one and two columns"
    )


def report_command(options: argparse.Namespace) -> int:
    """`peakmesh report RECORDING`: the exit code says that it was written; the verdict is replay's to give.

    The object of --json: recording, agrees and outcome as replay says them, report (the page, or null), figures and
    data (files).
    """
    refuse_lone_options(options)
    output = options.output
    if output is None and options.figures is None:
        output = default_page(options.recordings[0])
    if output is not None:
        refuse_page(output, options.recordings, force=options.force)
    from designer.report.account import Account

    account = Account.of(*options.recordings, run=options.run, gains=options.gains, report=Progress())
    figures, data = write_figures(account, options) if options.figures is not None else ([], [])
    if output is not None:
        write_page(account, output, force=options.force)
    facts = {
        "recording": account.verdict.recording,
        "agrees": account.verdict.agrees,
        "outcome": account.verdict.outcome,
        "report": None if output is None else str(output),
        "figures": [str(path) for path in figures],
        "data": [str(path) for path in data],
    }
    print(json.dumps(facts) if options.json else _text(facts, account.verdict.headline(), options.figures))
    return EXIT_GOOD


def refuse_lone_options(options: argparse.Namespace) -> None:
    """What says something of figures needs figures."""
    for name in ("format", "data"):
        if options.figures is None and getattr(options, name, None):
            raise InputError(f"--{name} says something of the figures; name a folder for them with --figures")
    if options.figures is not None and options.figures.exists() and not options.figures.is_dir():
        raise InputError(f"{options.figures} is a file; --figures takes a folder")


def default_page(recording: Path) -> Path:
    """Beside the recording: run.html for run.mcap."""
    return recording.with_name(recording.name.removesuffix(".part").removesuffix(".mcap") + ".html")


def refuse_page(page: Path, recordings: Sequence[Path], *, force: bool) -> None:
    """Raise InputError where the page would replace what it must not."""
    if page.exists() and any(recording.exists() and page.samefile(recording) for recording in recordings):
        raise InputError(f"{page} is the recording itself; give the page another name")
    refuse_overwrite(page, force=force)


def write_page(account: Account, page: Path, *, force: bool) -> None:
    """The report as one HTML file."""
    from designer.report.page import page as text_of

    write_whole(page, text_of(account).encode(), force=force)


def write_figures(account: Account, options: argparse.Namespace) -> tuple[list[Path], list[Path]]:
    """Every picture at both widths, and where asked for the numbers behind it; returns the files."""
    from designer.report import figures, tables
    from designer.report.pictures import pictures

    problem, charts = account.log.gains.problem, {chart.key: chart for chart in pictures(account)}
    drawings = figures.drawings(charts, stop=account.settled)
    drawings["topologies"] = lambda width: figures.topologies(problem, width)
    if account.rungs:
        drawings["ladder"] = lambda width: figures.ladder(account.rungs, width)
    numbers = {}
    if options.data:
        numbers = {name: tables.of_chart(chart) for name, chart in charts.items()}
        numbers |= {"topologies": tables.of_topologies(problem), "ladder": tables.of_ladder(account.rungs)}
    written = figures.write(drawings, options.figures, kind=options.format or FORMATS[0], force=options.force)
    return written, tables.write(numbers, options.figures, force=options.force)


def _text(facts: dict[str, Any], headline: str, folder: Path | None) -> str:
    lines = [] if facts["report"] is None else [f"report     {facts['report']}"]
    for name in ("figures", "data"):
        lines += [f"{name:10} {len(facts[name])} files in {folder}"] if facts[name] else []
    return "\n".join([*lines, f"verdict    {headline}"])
