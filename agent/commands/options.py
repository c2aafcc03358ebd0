"""What commands take: how options are declared, and what is read from them."""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from agent.commands.variables import Repeated
from agent.contract.errors import InputError
from agent.plan import LARGEST_WINDOW, Pace, Plan, RecordingPlan

if TYPE_CHECKING:
    from agent.contract.gains import Gains

Subcommands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"  # what add_subparsers returns

RECORDING = "FILE", "recording (recordings/<run>.mcap)"


def add_command(
    commands: Subcommands, name: str, call: Callable[[argparse.Namespace], int], about: str
) -> argparse.ArgumentParser:
    """Add a command that `perform` will call."""
    parser = commands.add_parser(name, help=about, description=f"{about[:1].upper()}{about[1:]}.", allow_abbrev=False)
    parser.set_defaults(call=call)
    parser.add_argument("-v", "--verbose", action="store_true", help="show where an error came from")
    parser.add_argument("-q", "--quiet", action="store_true", help="on stderr nothing but errors and warnings")
    return parser


def add_plan_options(parser: argparse.ArgumentParser) -> None:
    """Add what the coordinator decides; `plan_of` reads it."""
    parser.add_argument("--steps", type=count, default=200, metavar="N", help="how many steps (200)")
    parser.add_argument("--seed", type=seed, default=0, metavar="N", help="of modes, losses, disturbance (0)")
    parser.add_argument(
        "--window", type=_window, default=32, metavar="W", help="steps that the modes may run ahead (32); 1 is strict"
    )
    add_deadline_option(parser, "seconds without progress that stop a run (10)")
    parser.add_argument(
        "--external",
        action=Repeated,
        default=[],
        metavar="NODE",
        help="the measurements of this node come from a sensor, not from the simulated plant; may be repeated",
    )
    parser.add_argument(
        "--period", type=_period, metavar="TIME", help="one step every TIME, such as 20ms; what is late is substituted"
    )
    parser.add_argument(
        "--fault",
        action=Repeated,
        default=[],
        metavar="FAULT",
        help="that a paced run is to survive, such as kill:node=2,step=100, freeze:node=3,step=50,for=2s, "
        "mute-link:1>3,steps=50-80, delay:node=2,by=30ms, drop:probability=0.05; may be repeated",
    )
    parser.add_argument(
        "--measure-by", type=_part, default=0.4, metavar="PART", help="of a period, to wait for a measurement (0.4)"
    )
    parser.add_argument(
        "--hear-by", type=_part, default=0.8, metavar="PART", help="of a period, to wait for what nodes hear (0.8)"
    )


def add_guest_options(parser: argparse.ArgumentParser) -> None:
    """Add programs of the user's in place of our own; `guests_of` reads it, and `plan_of` who measures."""
    places = "{run}, {node}, {address} and {gains} are put in, and are in its environment"
    for what, about in (
        ("node", f'start this in place of a node, such as 2="./my_node"; {places}; may be repeated'),
        ("sensor", 'start this as a sensor, such as 3="python sensor.py {run} {node} {address}", with --external 3'),
    ):
        parser.add_argument(f"--{what}", type=_guest, action=Repeated, default=[], metavar="NODE=COMMAND", help=about)
    parser.add_argument("--plant", metavar="COMMAND", help="start this in place of the plant")


def guests_of(options: argparse.Namespace, gains: Gains) -> dict[str, list[str]]:
    """What the options of `add_guest_options` ask for. Raises InputError where that cannot be started."""
    from agent.guests import guests

    for what in ("node", "sensor"):
        names = [name for name, _ in getattr(options, what)]
        for name in names:
            if names.count(name) > 1:
                raise InputError(f"--{what} {name}=...: it is there twice")
    if options.plant is not None and not options.plant.strip():
        raise InputError("--plant is empty; it takes a command")
    return guests(gains, nodes=dict(options.node), sensors=dict(options.sensor), plant=options.plant)


def _guest(text: str) -> tuple[str, str]:
    name, equals, command = text.partition("=")
    if not (name and equals and command.strip()):
        raise argparse.ArgumentTypeError(f'{text!r} is not NODE=COMMAND, such as 2="./my_node"')
    return name, command


def add_deadline_option(parser: argparse.ArgumentParser, about: str) -> None:
    parser.add_argument("--deadline", type=positive, default=10.0, metavar="S", help=about)


def add_output_options(parser: argparse.ArgumentParser, metavar: str, about: str) -> None:
    """Add where to write, and whether over what is there."""
    parser.add_argument("-o", "--output", type=Path, metavar=metavar, help=about)
    parser.add_argument("--force", action="store_true", help="replace what exists")


def add_recording_options(parser: argparse.ArgumentParser) -> None:
    """Add what the recorder decides; `recording_plan_of` reads it."""
    parser.add_argument(
        "--split-size",
        type=size,
        metavar="SIZE",
        help="begin a new part of the recording after so much, for example 100MB: FILE, FILE.part2, ... (never)",
    )
    parser.add_argument(
        "--split-duration", type=_duration, metavar="TIME", help="or after so long, for example 90s, 10min, 2h (never)"
    )
    parser.add_argument(
        "--on-record-failure",
        choices=("stop", "continue"),
        default="stop",
        help="what the run does where it cannot be recorded any more (stop); the exit code is 3 in both cases",
    )


def recording_plan_of(options: argparse.Namespace) -> RecordingPlan:
    """What the options of `add_recording_options` ask for."""
    return RecordingPlan(options.split_size, options.split_duration, options.on_record_failure == "continue")


def run_name(text: str) -> str:
    """The type of --run."""
    if not re.fullmatch(r"[A-Za-z0-9_-]{1,128}", text):  # it becomes one part of every key expression
        raise argparse.ArgumentTypeError(f'{text!r} is not a legal name: use letters, digits, "-" and "_"')
    return text


def positive(text: str) -> float:
    """The type of options that say how many seconds."""
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0.0 < value < 1e9:
        raise argparse.ArgumentTypeError(f"{text} is not a positive number of seconds")
    return value


_BYTES = {"": 1, "b": 1, "kb": 10**3, "mb": 10**6, "gb": 10**9, "kib": 2**10, "mib": 2**20, "gib": 2**30}
_SECONDS = {"ms": 1e-3, "": 1.0, "s": 1.0, "min": 60.0, "h": 3600.0}


def size(text: str) -> int:
    """The type of options that say how many bytes."""
    found = _with_unit(text, _BYTES)
    if not 1000 <= found <= 1e15:
        raise argparse.ArgumentTypeError(f"{text} is not a size from 1kB on, such as 500kB, 100MB or 2GB")
    return int(found)


def _duration(text: str) -> float:
    seconds = _with_unit(text, _SECONDS)
    if not 1 <= seconds <= 1e9:
        raise argparse.ArgumentTypeError(f"{text} is not a time from 1s on, such as 90s, 10min or 2h")
    return seconds


def _period(text: str) -> float:
    seconds = _with_unit(text, _SECONDS)
    if not 1e-3 <= seconds <= 3600.0:
        raise argparse.ArgumentTypeError(f"{text} is not a time from 1ms to 1h, such as 20ms or 0.5s")
    return seconds


def _with_unit(text: str, units: Mapping[str, float]) -> float:
    """A number with one of the units; 0 for anything else."""
    found = re.fullmatch(r"([0-9]{1,15}(?:\.[0-9]{1,15})?) ?([a-z]*)", text.lower())
    return float(found[1]) * units[found[2]] if found and found[2] in units else 0.0


def _part(text: str) -> float:
    part = _with_unit(text, {"": 1.0})
    if not 0.0 < part <= 1.0:
        raise argparse.ArgumentTypeError(f"{text} is not a part of a period, above 0 and at most 1")
    return part


def _whole(text: str, *, least: int, most: int) -> int:
    if not (text.isdecimal() and len(text) < 20 and least <= int(text) <= most):
        raise argparse.ArgumentTypeError(f"{text} is not a whole number from {least} to {most}")
    return int(text)


def count(text: str) -> int:
    """The type of options that say how many."""
    return _whole(text, least=1, most=2**31 - 1)


def port(text: str) -> int:
    """The type of --port."""
    return _whole(text, least=0, most=2**16 - 1)


def _window(text: str) -> int:
    return _whole(text, least=1, most=LARGEST_WINDOW)


def seed(text: str) -> int:
    """The type of --seed."""
    return _whole(text, least=0, most=2**63 - 1)


def load_gains(path: Path) -> Gains:
    """Read a gains file, importing what that needs only now."""
    from agent.contract.gains import Gains

    return Gains.load(path)


def plan_of(options: argparse.Namespace, gains: Gains) -> Plan:
    """What the options of `add_plan_options` ask for. Raises InputError where the gains do not go with it."""
    for name in options.external:
        gains.problem.node_index(name)
    most = (2**32 - 1) // (gains.problem.n + 1) - 1  # the plant's messages are numbered in 32 bits
    if options.steps > most:
        raise InputError(f"--steps {options.steps}: a recording of {gains.problem.n} nodes holds at most {most}")
    pace = None
    if options.period is not None:
        pace = Pace(options.period, options.measure_by, options.hear_by)
        if pace.measure_by >= pace.hear_by:
            raise InputError(f"--measure-by {pace.measure_by:g} must be less than --hear-by {pace.hear_by:g}")
    if options.fault and pace is None:
        raise InputError(f"--fault {options.fault[0]}: a lock-step run survives nothing; --period makes it a paced one")
    if options.fault:
        from agent.faults import parse

        for text in options.fault:
            parse(text, gains.problem, steps=options.steps)
    external, faults = tuple(options.external), tuple(options.fault)
    return Plan(options.steps, options.seed, options.window, options.deadline, external, pace, faults)


def default_recording(run: str) -> Path:
    """recordings/<run>.mcap, in the current folder."""
    folder = Path("recordings")
    folder.mkdir(exist_ok=True)
    return folder / f"{run}.mcap"
