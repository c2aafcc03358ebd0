"""`peakmesh conform`: whether a program can take a node's place, in any language."""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, NamedTuple

from agent.commands.options import Subcommands, add_command, load_gains, positive
from agent.contract.errors import EXIT_GOOD, EXIT_NO, InputError, Interrupted, listed
from agent.signals import heed, restore

if TYPE_CHECKING:
    from agent.conform.series import Result, Try
    from agent.contract.gains import Gains
    from designer.conformity import Network

ABOUT = (
    "The command is told what to be by the variables PEAKMESH_CONNECT (an address), PEAKMESH_RUN, PEAKMESH_NODE and "
    "PEAKMESH_GAINS (a file), and by {address}, {run}, {node} and {gains} in its words. docs/protocol.md says what it "
    "has to do. Exit code 0 where it passes all trials, 1 where it does not, 2 where it cannot be started."
)


class _Trial(NamedTuple):
    name: str
    what: str
    attempt: Try
    network: _Network | Network


class _Network(NamedTuple):
    """Gains of the user's, where designer.conformity has its own."""

    gains: Gains
    node: str


def add_conform(commands: Subcommands) -> None:
    """Describe `conform` to the parser."""
    conform = add_command(commands, "conform", conform_command, "try whether a program can take a node's place")
    conform.usage = "peakmesh conform [options] -- COMMAND [ARGUMENT ...]"
    conform.epilog = ABOUT
    conform.add_argument("program", nargs="*", metavar="COMMAND", help="the program, and what it takes")
    conform.add_argument("--gains", type=Path, metavar="FILE", help="in the network of these gains alone")
    conform.add_argument("--node", metavar="NAME", help="the node of --gains that the program is")
    conform.add_argument("--only", action="append", default=[], metavar="TRIAL", help="this trial; may be repeated")
    conform.add_argument("--skip", action="append", default=[], metavar="TRIAL", help="not this one; may be repeated")
    conform.add_argument("--list", action="store_true", help="say what the trials are, and try nothing")
    conform.add_argument(
        "--tolerance",
        type=positive,
        metavar="PART",
        help="for arithmetic other than float64 in the stated order: how far a number may be off what follows from the "
        "step before, as a part of the largest of its vector (not a bit)",
    )
    conform.add_argument("--wait", type=positive, default=60.0, metavar="S", help="seconds to join (60)")
    conform.add_argument("--deadline", type=positive, default=10.0, metavar="S", help="seconds for what is due (10)")
    conform.add_argument("--json", action="store_true", help="print one JSON object")


def conform_command(options: argparse.Namespace) -> int:
    """`peakmesh conform -- COMMAND`."""
    trials = _chosen(options)
    if options.list:
        print("\n".join(f"{trial.name:<8} {trial.what}" for trial in trials))
        return EXIT_GOOD
    if not options.program:
        raise InputError("there is no command to try: peakmesh conform -- ./my_node")
    results: list[Result] = []
    handlers = heed(_interrupt)
    try:
        for result in _results(options, trials):
            results.append(result)
            if not options.json:
                print(result.text(), flush=True)
    finally:
        restore(handlers)
    failed = sum(not result.passed for result in results)
    if options.json:
        print(json.dumps({"passed": not failed, "trials": [result.document() for result in results]}))
    else:
        print(f"{len(results) - failed} of {len(results)} trials passed")
    return EXIT_NO if failed else EXIT_GOOD


def _interrupt(number: int, frame: FrameType | None) -> None:
    """Once: the program is then ended, which a second signal is not to keep from being done."""
    heed(lambda number, frame: None)
    raise Interrupted(number)


def _results(options: argparse.Namespace, trials: list[_Trial]) -> Iterator[Result]:
    from agent.conform.play import Play
    from agent.conform.series import SEED, STEPS, tried
    from agent.conform.trial import Setting
    from agent.guests import guests

    first = trials[0].network
    (command,) = guests(first.gains, nodes={first.node: options.program}, sensors={}, plant=None).values()
    with tempfile.TemporaryDirectory(prefix="peakmesh-") as folder:
        for trial in trials:
            gains, path = trial.network.gains, options.gains
            if path is None:
                path = Path(folder) / "gains.json"
                gains.save(path, force=True)
            setting = Setting(
                command,
                path,
                Play(gains, steps=STEPS, seed=SEED),
                trial.network.node,
                wait=options.wait,
                deadline=options.deadline,
                end=options.deadline,
                tolerance=options.tolerance or 0.0,
            )
            yield tried(trial.name, trial.what, trial.attempt, setting)


def _chosen(options: argparse.Namespace) -> list[_Trial]:
    trials = list(_trials(options))
    names = [trial.name for trial in trials]
    for option, chosen in (("--only", options.only), ("--skip", options.skip)):
        for name in chosen:
            if name not in names:
                raise InputError(f"{option} {name}: there is no such trial; there are {listed(names)}")
    left = [name for name in options.only or names if name not in options.skip]
    if not left:
        raise InputError("--skip leaves nothing to try")
    return [trial for trial in trials if trial.name in left]


def _trials(options: argparse.Namespace) -> Iterator[_Trial]:
    from agent.conform.lockstep import whole
    from agent.conform.series import MORE

    if (options.gains is None) != (options.node is None):
        raise InputError("--gains FILE and --node NAME go together: a network, and the node that the program is in it")
    if options.gains is not None:
        own: _Network | Network = _Network(load_gains(options.gains), options.node)
        own.gains.problem.node_index(own.node)
        yield _Trial("whole", f"node {own.node} of {own.gains.problem.name}", whole, own)
    else:
        from designer.conformity import NETWORKS

        for name, network in NETWORKS.items():
            yield _Trial(name, network.what, whole, network)
        own = network
    for name, (what, attempt) in MORE.items():
        yield _Trial(name, what, attempt, own)
