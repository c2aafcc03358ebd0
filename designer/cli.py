"""The program `peakmesh`: the designer's commands, and the runtime's beside them.

Results on stdout, progress and errors on stderr; `--json` prints one object with the same facts. Commands import
what they need when they are called: a sensor node started by this program never loads a solver.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from datetime import datetime
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import agent.cli
from agent.contract.errors import EXIT_GOOD, EXIT_INPUT, EXIT_NO, InputError
from agent.contract.files import refuse_overwrite

if TYPE_CHECKING:
    from agent.contract.gains import Gains
    from agent.contract.problem import Problem
    from designer.descent import Progress

METHODS = (
    "theorem2 (the default): the LMI of Zhu et al. 2020; theorem2-reduced: the same for [x; e], faster; "
    "decomposed: the same optimum node by node, for large networks; exact: the least exact gain that descent finds"
)
PROBLEM = "problem file, or the name of a built-in problem (peakmesh show lists them)"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns its exit code (agent/contract/errors.py)."""
    parser = argparse.ArgumentParser(
        prog="peakmesh",
        description="Design, run and audit distributed peak-error filters.",
        epilog="Exit codes: 0 good; 1 the answer is no; 2 bad input; 3 the run broke; 130, 143 stopped by a signal.",
    )
    parser.add_argument("--version", action="version", version=f"peakmesh {version('peakmesh')}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND")
    _add_demo(commands)
    _add_design(commands)
    _add_verify(commands)
    _add_run(commands)
    _add_replay(commands)
    _add_report(commands)
    _add_show(commands)
    agent.cli.add_roles(commands)
    options = parser.parse_args(arguments)
    if options.command is None:
        parser.print_help(sys.stderr)
        return EXIT_INPUT
    return agent.cli.perform(options)


# demo
def _add_demo(commands: agent.cli.Subcommands) -> None:
    demo = agent.cli.add_command(
        commands, "demo", demo_command, "design, run, replay and picture an example (zhu2020-lossy)"
    )
    demo.add_argument("problem", nargs="?", default="zhu2020-lossy", metavar="PROBLEM", help=PROBLEM)
    agent.cli.add_run_options(demo, output=("FOLDER", "for the files (recordings/demo-<time>)"))


def demo_command(options: argparse.Namespace) -> int:
    """`peakmesh demo`: the whole job; its files go to a folder of their own."""
    from designer.problems import find
    from designer.replay import replay

    problem = find(options.problem)
    folder = options.output or Path("recordings") / f"demo-{datetime.now():%Y%m%d-%H%M%S}"
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder} is a file; --output takes the folder for the demo's files")
    folder.mkdir(parents=True, exist_ok=True)
    gains_path, options.output = folder / "gains.json", folder / "run.mcap"
    for path in (gains_path, options.output):
        refuse_overwrite(path, force=options.force)

    gains, designed = _design(problem, "theorem2", gains_path, force=options.force)
    _say(options, f"1. design\n{_design_text(designed)}")
    ran = agent.cli.run_gains(gains_path, gains, options)
    _say(options, f"\n2. run: {gains.problem.n + 3} processes\n{agent.cli.run_text(ran)}")
    verdict = replay(options.output)
    _say(options, f"\n3. replay\n{verdict.text()}")
    pictures = _pictures(options.output, folder, force=options.force)
    _say(options, "\n4. pictures\n" + "\n".join(pictures))
    if options.json:
        print(json.dumps({"design": designed, "run": ran, "replay": verdict.document(), "pictures": pictures}))
    return verdict.exit_code


# design
def _add_design(commands: agent.cli.Subcommands) -> None:
    design = agent.cli.add_command(commands, "design", design_command, "gains with a certificate, for a problem")
    design.add_argument("problem", metavar="PROBLEM", help=PROBLEM)
    design.add_argument("-o", "--output", type=Path, metavar="FILE", help="gains file (<problem>.gains.json)")
    design.add_argument("--method", default="theorem2", metavar="NAME", help=METHODS)
    design.add_argument("--force", action="store_true", help="replace the gains file if it exists")
    design.add_argument("--json", action="store_true", help="print one JSON object")


def design_command(options: argparse.Namespace) -> int:
    """`peakmesh design PROBLEM`."""
    from designer.problems import find

    _, result = _design(find(options.problem), options.method, options.output, force=options.force)
    print(json.dumps(result) if options.json else _design_text(result))
    return EXIT_GOOD


def _design(problem: Problem, method: str, output: Path | None, *, force: bool) -> tuple[Gains, dict[str, Any]]:
    """Design gains and save them; returns them and the facts to print."""
    path = output or Path(f"{problem.name}.gains.json")
    refuse_overwrite(path, force=force)
    from designer.synthesis import design  # only now: it loads a solver

    gains = design(problem, method=method, progress=_descent_progress())
    gains.save(path, force=force)
    proved = gains.certificate
    return gains, {
        "problem": problem.name,
        "method": gains.method,
        "gamma": proved.gamma,
        "lmi_gamma": proved.lmi_gamma,
        "exact": proved.exact,
        "floor": proved.floor,
        "holds": proved.holds,
        "solver": gains.solver.document(),
        "seconds": gains.seconds,
        "output": str(path),
    }


def _design_text(result: dict[str, Any]) -> str:
    solver, exact = result["solver"], result["exact"]
    lmi = "" if result["lmi_gamma"] is None else f" (the solver's value of the LMI {result['lmi_gamma']:.6f})"
    ladder = [f"floor {result['floor']:.6f}"] if result["floor"] is not None else []
    ladder += [f"what these gains really have {exact[1]:.6f}"] if exact is not None else []
    return (
        f"{result['problem']} by {result['method']}: gamma = {result['gamma']:.6f}, certified{lmi}\n"
        f"ladder     {' <= '.join([*ladder, 'gamma'])}\n"
        f"{solver['name']} {solver['version']}: {solver['status']}, {solver['iterations']} iterations; "
        f"{result['seconds']['total']:.1f} s in all\n"
        f"gains      {result['output']}\n"
        f"next       peakmesh run {result['output']}"
    )


def _descent_progress() -> Callable[[Progress], None]:
    """Prints where the descent is, every other second."""
    shown = 0.0

    def show(progress: Progress) -> None:
        nonlocal shown
        if progress.seconds >= shown + 2.0:
            shown = progress.seconds
            print(
                f"{progress.seconds:5.0f} s  from {progress.start}: gamma < {progress.gamma:.6f} "
                f"after {progress.steps} steps; Ctrl-C keeps the best so far",
                file=sys.stderr,
            )

    return show


# verify
def _add_verify(commands: agent.cli.Subcommands) -> None:
    verify = agent.cli.add_command(commands, "verify", verify_command, "check a certificate again, without a solver")
    verify.add_argument("gains", type=Path, metavar="GAINS", help="gains file")
    verify.add_argument("--json", action="store_true", help="print one JSON object")


def verify_command(options: argparse.Namespace) -> int:
    """`peakmesh verify GAINS`."""
    from designer.certificate import verify

    verdict = verify(agent.cli.load_gains(options.gains))
    if options.json:
        print(json.dumps(verdict._asdict()))
    elif verdict.holds:
        print(f"holds: gamma = {verdict.gamma:.6f} is proved in {verdict.arithmetic}")
    else:
        print(f"does not hold: gamma = {verdict.gamma:.6f} is not proved for {options.gains}: {verdict.failure}")
    return EXIT_GOOD if verdict.holds else EXIT_NO


# run
def _add_run(commands: agent.cli.Subcommands) -> None:
    run = agent.cli.add_command(commands, "run", run_command, "run every role as a process on this machine")
    run.add_argument("gains", metavar="PROBLEM_OR_GAINS", help=f"gains file, {PROBLEM}")
    agent.cli.add_run_options(run)


def run_command(options: argparse.Namespace) -> int:
    """`peakmesh run PROBLEM_OR_GAINS`: a problem is designed first, its gains stand beside the recording."""
    path = Path(options.gains)
    if path.suffix == ".json" or (path.is_file() and path.suffix != ".toml"):
        options.gains = path
        return agent.cli.run_command(options)
    from designer.problems import find

    problem = find(options.gains)
    if options.output is None:
        options.output = agent.cli.default_recording(f"{problem.name}-{datetime.now():%Y%m%d-%H%M%S}")
    refuse_overwrite(options.output, force=options.force)
    path = options.output.with_suffix(".gains.json")
    gains, _ = _design(problem, "theorem2", path, force=options.force)
    print(f"designed {path}, gamma = {gains.certificate.gamma:.6f}", file=sys.stderr)
    result = {"gains": str(path), **agent.cli.run_gains(path, gains, options)}
    print(json.dumps(result) if options.json else f"{agent.cli.run_text(result)}\ngains      {path}")
    return EXIT_GOOD


# replay
def _add_replay(commands: agent.cli.Subcommands) -> None:
    replay = agent.cli.add_command(
        commands, "replay", replay_command, "hold a recording against the centralised error model"
    )
    replay.add_argument("recording", type=Path, metavar="RECORDING", help="recording, or the .part of one that was cut")
    replay.add_argument("--json", action="store_true", help="print one JSON object")


def replay_command(options: argparse.Namespace) -> int:
    """`peakmesh replay RECORDING`."""
    from designer.replay import replay

    verdict = replay(options.recording)
    print(json.dumps(verdict.document()) if options.json else verdict.text())
    return verdict.exit_code


# report
def _add_report(commands: agent.cli.Subcommands) -> None:
    report = agent.cli.add_command(commands, "report", report_command, "pictures of a recording, as SVG and PNG")
    report.add_argument("recording", type=Path, metavar="RECORDING", help="MCAP file of a run")
    report.add_argument("-o", "--output", type=Path, metavar="FOLDER", help="where to (beside the recording)")
    report.add_argument("--force", action="store_true", help="replace pictures that exist")
    report.add_argument("--json", action="store_true", help="print one JSON object")


def report_command(options: argparse.Namespace) -> int:
    """`peakmesh report RECORDING`."""
    pictures = _pictures(options.recording, options.output or options.recording.parent, force=options.force)
    print(json.dumps({"pictures": pictures}) if options.json else "\n".join(pictures))
    return EXIT_GOOD


def _pictures(recording: Path, folder: Path, *, force: bool) -> list[str]:
    from designer import figures

    return [str(path) for path in figures.write(recording, folder, force=force)]


# show
def _add_show(commands: agent.cli.Subcommands) -> None:
    show = agent.cli.add_command(commands, "show", show_command, "what a file is; without one, the built-in problems")
    show.add_argument("file", nargs="?", metavar="FILE", help="problem, gains file or recording")
    show.add_argument("--json", action="store_true", help="print one JSON object")


def show_command(options: argparse.Namespace) -> int:
    """`peakmesh show [FILE]`."""
    from designer import show

    facts = show.describe(options.file)
    print(json.dumps(facts) if options.json else show.text(facts))
    return EXIT_GOOD


def _say(options: argparse.Namespace, text: str) -> None:
    """Print a part of the demo as soon as it is known; with --json only the object at the end."""
    if not options.json:
        print(text, flush=True)
