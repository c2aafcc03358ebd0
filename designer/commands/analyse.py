"""`peakmesh analyse`: what any gains do on a problem."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from agent.commands.options import Subcommands, add_command
from agent.contract.errors import EXIT_GOOD, EXIT_NO
from agent.contract.files import refuse_overwrite
from designer.commands import PROBLEM, add_set, add_table, find_to_design, refuse_both, tell_notes
from designer.commands.within import add_within, asked


def add_analyse(commands: Subcommands) -> None:
    """Describe `analyse` to the parser."""
    analyse = add_command(
        commands, "analyse", analyse_command, "the exact gain of any gains on a problem, and the worst disturbances"
    )
    analyse.add_argument("problem", metavar="PROBLEM", help=PROBLEM)
    add_set(analyse)
    analyse.add_argument(
        "--gains",
        type=Path,
        required=True,
        metavar="FILE",
        help='gains file, or "K" and "H" alone, as JSON, .npz or .mat',
    )
    analyse.add_argument(
        "-o", "--output", type=Path, metavar="FILE", help="write them as a gains file, their exact gain certified"
    )
    analyse.add_argument(
        "--against",
        action="append",
        default=[],
        metavar="FILE|METHOD",
        help="rank them with other gains in one table, by gamma, or by that for the box if there is one; a file, or a "
        "method of design; may be repeated",
    )
    add_within(analyse)
    analyse.add_argument(
        "--radius",
        action="store_true",
        help="the largest boxes for which 1.05 gamma is proved, of all shapes; small networks have some anyway",
    )
    analyse.add_argument("--force", action="store_true", help="replace that file if it exists")
    add_table(analyse, "the ladder")
    analyse.add_argument("--json", action="store_true", help="print one JSON object")


def analyse_command(options: argparse.Namespace) -> int:
    """`peakmesh analyse PROBLEM --gains FILE`: exit code 1 where the errors are not mean-square stable."""
    from designer.analysis import analyse, certified, load_given
    from designer.ladder import rounded_up

    refuse_both(options)
    problem = find_to_design(options.problem, options.settings)
    if options.output is not None:
        refuse_overwrite(options.output, force=options.force)
    box = asked(problem, options.within)
    given = load_given(options.gains, problem)
    analysis = analyse(problem, given, box, radius="all" if options.radius else "cheap")
    facts, text = analysis.document() | {"notes": tell_notes(problem), "output": None}, analysis.text()
    if options.output is not None and analysis.stable:
        gains = certified(problem, given)
        gains.save(options.output, force=options.force)
        facts |= {"gamma": gains.certificate.gamma, "output": str(options.output)}
        text += f"\ngains      {options.output}, gamma = {rounded_up(gains.certificate.gamma)}, certified"
    if options.against:
        from designer.ranking import ranked, table

        rows = ranked(problem, given, options.against, box)
        facts["against"] = [row.document() for row in rows]
        text += f"\n\n{table(rows, in_box=box is not None)}"
    if options.table:
        print(analysis.ladder.table(problem.name, options.table), end="")
    else:
        print(json.dumps(facts) if options.json else text)
    return EXIT_GOOD if analysis.stable else EXIT_NO
