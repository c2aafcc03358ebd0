"""The runtime's commands: run, and one for each role. Results on stdout, progress and errors on stderr."""

from __future__ import annotations

import argparse
import json
import os
import re
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # small matrices: threads only cost memory and time

from agent.contract.errors import (
    EXIT_BROKEN,
    EXIT_GOOD,
    EXIT_INPUT,
    EXIT_INTERRUPTED,
    InputError,
    PeakmeshError,
    RunBroken,
)
from agent.plan import LARGEST_WINDOW

if TYPE_CHECKING:
    from agent.contract.gains import Gains
    from agent.network.configuration import Network
    from agent.plan import Plan

Subcommands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"  # what add_subparsers returns


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns its exit code."""
    parser = argparse.ArgumentParser(prog="peakmesh", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    add_commands(commands)
    return perform(parser.parse_args(arguments))


def perform(options: argparse.Namespace) -> int:
    """Call the chosen command; an error becomes one sentence on stderr and an exit code."""
    try:
        code = options.call(options)
        sys.stdout.flush()
        return int(code)
    except PeakmeshError as error:
        if options.verbose:
            traceback.print_exc()
        print(f"peakmesh: {error}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        print("peakmesh: interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED
    except BrokenPipeError:  # the reader of our output has gone
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_GOOD
    except MemoryError as error:
        why = f" ({error})" if str(error) else ""
        print(f"peakmesh: {options.command}: there is too little memory for this{why}; ask for less", file=sys.stderr)
        return EXIT_BROKEN
    except OSError as error:
        print(f"peakmesh: {error.filename or options.command}: {error.strerror or error}", file=sys.stderr)
        return EXIT_INPUT
    except Exception:  # a defect of peakmesh: 1 would mean that the answer is no
        traceback.print_exc()
        return EXIT_BROKEN


def add_commands(commands: Subcommands) -> None:
    """Add the runtime's commands to a parser."""
    run = add_command(commands, "run", run_command, "run every role as a process on this machine")
    run.add_argument("gains", type=Path, metavar="GAINS", help="gains file, from peakmesh design")
    add_run_options(run)
    add_roles(commands)


def add_roles(commands: Subcommands) -> None:
    """Add the commands that take one role each."""
    node = _role(commands, "node", node_command, "take part as one sensor node")
    node.add_argument("--node", required=True, metavar="NAME", help="which node of the problem")
    _role(commands, "plant", plant_command, "take part as the simulated plant")
    coordinator = _role(commands, "coordinator", coordinator_command, "start the run, give out the modes, end it")
    _plan_options(coordinator)
    recorder = _role(commands, "recorder", recorder_command, "write every message to a file")
    _output_options(recorder, *RECORDING)


RECORDING = "FILE", "recording (recordings/<run>.mcap)"


def add_run_options(parser: argparse.ArgumentParser, *, output: tuple[str, str] = RECORDING) -> None:
    """The options of `run`, but for what to run; `output` is what --output takes, and its help."""
    _plan_options(parser)
    _output_options(parser, *output)
    parser.add_argument(
        "--wait", type=_positive, default=30.0, metavar="S", help="seconds to wait for all to start (30)"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")


def run_command(options: argparse.Namespace) -> int:
    """`peakmesh run GAINS`."""
    gains = load_gains(options.gains)
    result = run_gains(options.gains, gains, options)
    print(json.dumps(result) if options.json else run_text(result))
    return EXIT_GOOD


def run_gains(path: Path, gains: Gains, options: argparse.Namespace) -> dict[str, Any]:
    """Run the gains in `path` on this machine; returns the facts of the run."""
    from agent.contract.recording.writer import refuse_recording
    from agent.launch import launch

    plan = _plan(options, gains)
    run = f"{gains.problem.name}-{os.urandom(4).hex()}"
    recording = options.output or default_recording(run)
    refuse_recording(recording, force=options.force)
    with _progress(plan.steps) as report:
        summary = launch(
            path, gains, plan, run=run, recording=recording, force=options.force, wait=options.wait, report=report
        )
    return {"recording": str(recording), "run": run, "seed": plan.seed, **summary}


def run_text(result: dict[str, Any]) -> str:
    """The facts of a run, for people."""
    return (
        f"{result['steps']} steps, seed {result['seed']}: {result['messages']} messages recorded, "
        f"{result['missing']} missing\n"
        f"step 0 after {result['start_seconds']:.2f} s, then {result['rounds_per_second']:.0f} steps/s\n"
        f"recording  {result['recording']}\n"
        f"next       peakmesh replay {result['recording']}"
    )


def node_command(options: argparse.Namespace) -> int:
    """`peakmesh node GAINS --node NAME`."""
    from agent.contract.messages import node_who
    from agent.roles import node

    gains = load_gains(options.gains)
    gains.problem.node_index(options.node)
    return _publisher(options, gains, node_who(options.node), lambda bus: node.run(bus, gains, node=options.node))


def plant_command(options: argparse.Namespace) -> int:
    """`peakmesh plant GAINS`."""
    from agent.contract.messages import PLANT
    from agent.roles import plant

    gains = load_gains(options.gains)
    return _publisher(options, gains, PLANT, lambda bus: plant.run(bus, gains))


def coordinator_command(options: argparse.Namespace) -> int:
    """`peakmesh coordinator GAINS`."""
    from agent.contract.messages import COORDINATOR
    from agent.network.bus import Bus
    from agent.roles import coordinator

    gains = load_gains(options.gains)
    plan = _plan(options, gains)
    say = _say_to_launcher if options.child else _say_to_person
    with Bus(_network(options), run=options.run or gains.problem.name, who=COORDINATOR) as bus:
        say({"listening": bus.locators()})
        summary = coordinator.run(bus, gains, plan, report=say)
    say({"summary": summary._asdict()})
    return EXIT_GOOD


def recorder_command(options: argparse.Namespace) -> int:
    """`peakmesh recorder GAINS -o FILE`."""
    from agent.contract.messages import RECORDER
    from agent.network.bus import Bus
    from agent.roles import recorder

    gains = load_gains(options.gains)
    run = options.run or gains.problem.name
    path = options.output or default_recording(run)
    with Bus(_network(options), run=run, who=RECORDER) as bus:
        recorder.run(bus, gains, path=path, force=options.force)
    print(f"recording  {path}")
    return EXIT_GOOD


def _publisher(options: argparse.Namespace, gains: Gains, who: str, role: Callable[[Any], None]) -> int:
    from agent.contract.messages import in_words
    from agent.network.bus import Bus

    run = options.run or gains.problem.name
    with Bus(_network(options), run=run, who=who) as bus:
        if not options.child:
            print(f'{in_words(who)} waits for everybody of run "{run}"', file=sys.stderr)
        role(bus)
    return EXIT_GOOD


# Options.
def add_command(
    commands: Subcommands, name: str, call: Callable[[argparse.Namespace], int], about: str
) -> argparse.ArgumentParser:
    """Add a command that `perform` will call."""
    parser = commands.add_parser(name, help=about, description=f"{about[:1].upper()}{about[1:]}.")
    parser.set_defaults(call=call)
    parser.add_argument("-v", "--verbose", action="store_true", help="show where an error came from")
    return parser


def _role(
    commands: Subcommands, name: str, call: Callable[[argparse.Namespace], int], about: str
) -> argparse.ArgumentParser:
    parser = add_command(commands, name, call, about)
    parser.add_argument("gains", type=Path, metavar="GAINS", help="gains file, the same for everybody")
    _network_options(parser)
    return parser


def _plan_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--steps", type=count, default=200, metavar="N", help="how many steps (200)")
    parser.add_argument("--seed", type=seed, default=0, metavar="N", help="of modes, losses, disturbance (0)")
    parser.add_argument(
        "--window", type=_window, default=32, metavar="W", help="steps that the modes may run ahead (32); 1 is strict"
    )
    parser.add_argument(
        "--deadline", type=_positive, default=10.0, metavar="S", help="seconds without progress that stop a run (10)"
    )
    parser.add_argument(
        "--external",
        action="append",
        default=[],
        metavar="NODE",
        help="the measurements of this node come from a sensor, not from the simulated plant; may be repeated",
    )


def _output_options(parser: argparse.ArgumentParser, metavar: str, about: str) -> None:
    parser.add_argument("-o", "--output", type=Path, metavar=metavar, help=about)
    parser.add_argument("--force", action="store_true", help="replace what exists")


def _network_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--run", type=_run_name, metavar="NAME", help="name of the run, the same for everybody (the problem's name)"
    )
    parser.add_argument(
        "--listen",
        default="tcp/127.0.0.1:0",
        metavar="ADDRESS",
        help="where to be reached (tcp/127.0.0.1:0; port 0 takes a free one)",
    )
    parser.add_argument(
        "--connect",
        action="append",
        default=[],
        metavar="ADDRESS",
        help="required: of the coordinator, for example tcp/127.0.0.1:7447",
    )
    parser.add_argument("--wait", type=_positive, default=60.0, metavar="S", help="seconds to wait for the others (60)")
    parser.add_argument("--child", action="store_true", help=argparse.SUPPRESS)


def _run_name(text: str) -> str:
    if not re.fullmatch(r"[A-Za-z0-9_-]{1,128}", text):  # it becomes one part of every key expression
        raise argparse.ArgumentTypeError(f'{text!r} is not a legal name: use letters, digits, "-" and "_"')
    return text


def _positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0.0 < value < 1e9:
        raise argparse.ArgumentTypeError(f"{text} is not a positive number of seconds")
    return value


def _whole(text: str, *, least: int, most: int) -> int:
    if not (text.isdecimal() and len(text) < 20 and least <= int(text) <= most):
        raise argparse.ArgumentTypeError(f"{text} is not a whole number from {least} to {most}")
    return int(text)


def count(text: str) -> int:
    """The type of options that say how many."""
    return _whole(text, least=1, most=2**31 - 1)


def _window(text: str) -> int:
    return _whole(text, least=1, most=LARGEST_WINDOW)


def seed(text: str) -> int:
    """The type of --seed."""
    return _whole(text, least=0, most=2**63 - 1)


def load_gains(path: Path) -> Gains:
    """Read a gains file, importing what that needs only now."""
    from agent.contract.gains import Gains

    return Gains.load(path)


def _plan(options: argparse.Namespace, gains: Gains) -> Plan:
    from agent.plan import Plan

    for name in options.external:
        gains.problem.node_index(name)
    most = (2**32 - 1) // (gains.problem.n + 1) - 1  # the plant's messages are numbered in 32 bits
    if options.steps > most:
        raise InputError(f"--steps {options.steps}: a recording of {gains.problem.n} nodes holds at most {most}")
    return Plan(options.steps, options.seed, options.window, options.deadline, tuple(options.external))


def _network(options: argparse.Namespace) -> Network:
    from agent.network.configuration import Network

    connect = tuple(options.connect)
    if options.child:
        if options.command != "coordinator":
            connect = (sys.stdin.readline().strip(),)
            if connect == ("",):
                raise RunBroken("the launcher ended before the run had started")
        threading.Thread(target=_stop_with_launcher, daemon=True).start()
    elif options.command != "coordinator" and not connect:
        raise InputError("--connect is missing: it takes the coordinator's address, such as tcp/127.0.0.1:7447")
    for option, addresses in (("--listen", (options.listen,)), ("--connect", connect)):
        for address in addresses:
            if not re.fullmatch(r"[a-z0-9-]+/\S+", address):
                raise InputError(f"{option} {address}: an address looks like tcp/127.0.0.1:7447")
    return Network(options.listen, connect, options.wait)


def _stop_with_launcher() -> None:
    while os.read(sys.stdin.fileno(), 1):  # not sys.stdin.read: its lock would outlive us at exit
        pass
    os.kill(os.getpid(), signal.SIGTERM)


def default_recording(run: str) -> Path:
    """recordings/<run>.mcap, in the current folder."""
    folder = Path("recordings")
    folder.mkdir(exist_ok=True)
    return folder / f"{run}.mcap"


# Words of the coordinator.
def _say_to_launcher(word: dict[str, Any]) -> None:
    print(json.dumps(word), flush=True)


def _say_to_person(word: dict[str, Any]) -> None:
    from agent.contract.messages import in_words

    match word:
        case {"listening": addresses}:
            print(f"listening at {', '.join(addresses)}", file=sys.stderr)
        case {"joined": who}:
            print(f"{in_words(who)} is there", file=sys.stderr)
        case {"started": _}:
            print("everybody is there: the run starts", file=sys.stderr)
        case {"summary": summary}:
            print(f"{summary['steps']} steps, {summary['messages']} messages recorded")


@contextmanager
def _progress(steps: int) -> Iterator[Callable[[dict[str, Any]], None]]:
    """A bar on stderr, where that is a terminal; the function takes the coordinator's words."""
    if not sys.stderr.isatty():
        yield lambda word: None
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("waiting for everybody", total=steps)

        def show(word: dict[str, Any]) -> None:
            if "started" in word:
                bar.update(task, description="steps")
            elif "complete" in word:
                bar.update(task, completed=word["complete"])

        yield show
