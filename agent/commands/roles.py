"""`peakmesh node`, `plant`, `coordinator`, `recorder`: one role in this process, for separate machines; and `live`."""

from __future__ import annotations

import argparse
import os
import signal
import sys
import threading
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from agent.commands.options import (
    RECORDING,
    Subcommands,
    add_command,
    add_deadline_option,
    add_output_options,
    add_plan_options,
    add_recording_options,
    default_recording,
    load_gains,
    plan_of,
    port,
    positive,
    recording_plan_of,
    run_name,
    size,
)
from agent.commands.security import (
    add_insecure_option,
    add_keys_option,
    credentials_of,
    default_listen,
    refuse_insecure,
)
from agent.commands.supervisor import tell_supervisor
from agent.commands.variables import Repeated, heed_variables
from agent.commands.words import say_broken_off, say_to_launcher, say_to_person
from agent.contract.errors import EXIT_BROKEN, EXIT_GOOD, InputError, RunBroken

LEAST_LEASE = 10.0  # s; where a run may stand still for longer, links last twice as long: the deadline decides

if TYPE_CHECKING:
    from agent.contract.gains import Gains
    from agent.contract.problem import Problem
    from agent.network.configuration import Network


def add_roles(commands: Subcommands, environment: Mapping[str, str] = os.environ) -> None:
    """Add the commands that take one role each; what their options are by default may stand in the environment."""
    node = _role(commands, "node", node_command, "take part as one sensor node")
    node.add_argument("--node", required=True, metavar="NAME", help="which node of the problem")
    plant = _role(commands, "plant", plant_command, "take part as the simulated plant")
    coordinator = _role(commands, "coordinator", coordinator_command, "start the run, give out the modes, end it")
    add_plan_options(coordinator)
    coordinator.add_argument("--hosts", action="store_true", help=argparse.SUPPRESS)  # guests, in a run on one machine
    recorder = _role(commands, "recorder", recorder_command, "write every message to a file")
    add_output_options(recorder, *RECORDING)
    add_recording_options(recorder)
    live = _role(commands, "live", live_command, "show a running network to Foxglove (peakmesh[foxglove])")
    live.add_argument("--host", default="127.0.0.1", metavar="HOST", help="where Foxglove connects to (127.0.0.1)")
    live.add_argument(
        "--port", type=port, default=8765, metavar="N", help="port for Foxglove (8765); 0 takes a free one"
    )
    router = add_command(commands, "router", router_command, "pass on what those say who cannot reach one another")
    router.add_argument(
        "--listen", default="tcp/127.0.0.1:7447", metavar="ADDRESS", help="where to be reached (tcp/127.0.0.1:7447)"
    )
    add_insecure_option(router)
    for role in (node, plant, coordinator):
        role.add_argument(
            "--keep",
            type=size,
            default=64e6,
            metavar="SIZE",
            help="in a run against the clock, how much to keep in memory for a recorder that stays away (64MB)",
        )
    for role in (node, plant, coordinator, recorder, live, router):
        heed_variables(role, environment)


def _role(
    commands: Subcommands, name: str, call: Callable[[argparse.Namespace], int], about: str
) -> argparse.ArgumentParser:
    parser = add_command(commands, name, call, about)
    parser.add_argument("gains", type=Path, metavar="GAINS", help="gains file, the same for everybody")
    add_network_options(parser)
    if name != "coordinator":
        add_deadline_option(
            parser, "as the coordinator has it: after twice as many seconds of silence a link is lost (10)"
        )
    return parser


def add_network_options(
    parser: argparse.ArgumentParser, *, run: str = "name of the run, the same for everybody (the problem's name)"
) -> None:
    """Add how a process reaches the others, `network_of` reads it; `run` is the help of --run."""
    parser.add_argument("--run", type=run_name, metavar="NAME", help=run)
    parser.add_argument(
        "--listen",
        metavar="ADDRESS",
        help="where to be reached (tcp/127.0.0.1:0, with --keys tls/127.0.0.1:0; port 0 takes a free one), or none: by "
        "nobody, everything goes through the one that --connect names",
    )
    parser.add_argument(
        "--connect",
        action=Repeated,
        default=[],
        metavar="ADDRESS",
        help="required, but for the coordinator: its address, for example tcp/127.0.0.1:7447, or that of a router; or "
        "multicast, for everybody, where it is to be found on the local network",
    )
    parser.add_argument("--wait", type=positive, default=60.0, metavar="S", help="seconds to wait for the others (60)")
    add_keys_option(parser)
    add_insecure_option(parser)
    parser.add_argument("--child", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--sockets", type=Path, help=argparse.SUPPRESS)  # of a run on one machine, a folder


def node_command(options: argparse.Namespace) -> int:
    """`peakmesh node GAINS --node NAME`."""
    from agent.contract.keys import node_who
    from agent.roles import node

    gains = load_gains(options.gains)
    gains.problem.node_index(options.node)
    return _publisher(options, gains, node_who(options.node), lambda bus: node.run(bus, gains, node=options.node))


def plant_command(options: argparse.Namespace) -> int:
    """`peakmesh plant GAINS`."""
    from agent.contract.keys import PLANT
    from agent.roles import plant

    gains = load_gains(options.gains)
    return _publisher(options, gains, PLANT, lambda bus: plant.run(bus, gains))


def coordinator_command(options: argparse.Namespace) -> int:
    """`peakmesh coordinator GAINS`."""
    from agent.contract.keys import COORDINATOR
    from agent.network.bus import Bus
    from agent.roles import coordinator

    gains = load_gains(options.gains)
    plan = plan_of(options, gains)
    say = say_to_launcher if options.child else say_to_person
    run = options.run or gains.problem.name
    with Bus(_place(options, gains, COORDINATOR), run=run, who=COORDINATOR) as bus:
        say({"listening": bus.locators() or list(options.connect)})
        _tell_supervisor(options, "the coordinator waits for everybody")
        summary = coordinator.run(bus, gains, plan, report=say)
    say({"summary": {key: value for key, value in summary._asdict().items() if value is not None}})
    return EXIT_BROKEN if summary.broken_off or summary.not_whole else EXIT_GOOD


def recorder_command(options: argparse.Namespace) -> int:
    """`peakmesh recorder GAINS -o FILE`."""
    from agent.contract.keys import RECORDER
    from agent.contract.recording import parts
    from agent.network.bus import Bus
    from agent.roles import recorder

    gains = load_gains(options.gains)
    run = options.run or gains.problem.name
    path = options.output or default_recording(run)
    with Bus(_place(options, gains, RECORDER), run=run, who=RECORDER) as bus:
        _tell_supervisor(options, "the recorder waits for everybody")
        recorder.run(bus, gains, path=path, force=options.force, plan=recording_plan_of(options), report=say_broken_off)
    print(f"recording  {parts.in_words(parts.files_of(path))}")
    return EXIT_GOOD


def live_command(options: argparse.Namespace) -> int:
    """`peakmesh live GAINS`: looks on, and takes no part."""
    from agent.contract.keys import VIEWER
    from agent.network.addresses import reaches_other_machines
    from agent.roles import viewer

    gains = load_gains(options.gains)
    if reaches_other_machines(f"tcp/{options.host}:0") and not options.insecure:
        raise InputError(
            f"--host {options.host}: others could look on, for Foxglove is sent everything in the clear; "
            "--insecure lets them"
        )
    viewer.run(
        network_of(options, VIEWER, gains.problem),
        gains,
        run=options.run or gains.problem.name,
        host=options.host,
        port=options.port,
        say=lambda address: print(f"open {address} in Foxglove", file=sys.stderr, flush=True),
    )
    return EXIT_GOOD


def router_command(options: argparse.Namespace) -> int:
    """`peakmesh router`: takes no part in any run."""
    from agent.network.addresses import NONE, refuse_addresses
    from agent.network.configuration import Network
    from agent.roles import router

    refuse_addresses(listen=options.listen, connect=())
    if options.listen == NONE:
        raise InputError("--listen none: nobody could reach the router")
    refuse_insecure(options.listen, (), keys=None, insecure=options.insecure)

    def say(addresses: list[str]) -> None:
        print(f"listening at {', '.join(addresses)}", file=sys.stderr, flush=True)
        tell_supervisor("the router passes on what it gets")

    router.run(Network(options.listen, routes=True), say=say)
    return EXIT_GOOD  # it has no other end than to be asked to


def _tell_supervisor(options: argparse.Namespace, status: str) -> None:
    """Whoever started a whole run hears nothing of its parts."""
    if not options.child:
        tell_supervisor(status)


def _publisher(options: argparse.Namespace, gains: Gains, who: str, role: Callable[[Any], None]) -> int:
    from agent.contract.keys import in_words
    from agent.network.bus import Bus

    run = options.run or gains.problem.name
    with Bus(_place(options, gains, who), run=run, who=who) as bus:
        if not options.child:
            print(f'{in_words(who)} waits for everybody of run "{run}"', file=sys.stderr)
        _tell_supervisor(options, f"{in_words(who)} waits for everybody")
        role(bus)
    return EXIT_GOOD


def _place(options: argparse.Namespace, gains: Gains, who: str) -> Network:
    """Where a participant is; in a run on one machine only the coordinator can be reached by an address, too."""
    from agent.contract.keys import COORDINATOR
    from agent.contract.sizes import largest
    from agent.network.links import sockets

    network = replace(network_of(options, who, gains.problem), largest=largest(gains.problem))
    if options.sockets is None:
        return network
    listen, hosts = (network.listen, options.hosts) if who == COORDINATOR else ("", False)
    return replace(network, listen=listen, sockets=sockets(gains.problem, who, options.sockets), hosts=hosts)


def network_of(options: argparse.Namespace, who: str, problem: Problem | None) -> Network:
    """What the options of `add_network_options` ask for, of `who`; without `problem` it believes every certificate."""
    from agent.network.addresses import NONE, refuse_addresses
    from agent.network.configuration import Network

    credentials = credentials_of(options, who, problem)
    listen = options.listen or default_listen(options)
    connect = tuple(options.connect)
    if options.child:
        if options.command != "coordinator" and options.sockets is None:
            connect = (sys.stdin.readline().strip(),)
            if connect == ("",):
                raise RunBroken("the launcher ended before the run had started")
        threading.Thread(target=_stop_with_launcher, daemon=True).start()
    elif not connect and (options.command != "coordinator" or options.listen == NONE):
        raise InputError("--connect is missing: it takes the coordinator's address, such as tcp/127.0.0.1:7447")
    refuse_addresses(listen=listen, connect=connect)
    refuse_insecure(listen, connect, keys=options.keys, insecure=options.insecure)
    deadline = options.deadline if "deadline" in options else 0.0  # a viewer's own patience is nobody's concern
    lease = max(LEAST_LEASE, 2.0 * deadline)
    network = Network(listen, connect, options.wait, lease=lease, credentials=credentials, problem=problem)
    return replace(network, keep=options.keep) if "keep" in options else network


def _stop_with_launcher() -> None:
    while os.read(sys.stdin.fileno(), 1):  # not sys.stdin.read: its lock would outlive us at exit
        pass
    os.kill(os.getpid(), signal.SIGTERM)
