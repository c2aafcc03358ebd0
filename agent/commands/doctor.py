"""`peakmesh doctor`: whether this machine can take part in a run."""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from agent.commands.options import Subcommands, add_command, load_gains, positive
from agent.commands.security import add_insecure_option, add_keys_option, credentials_of, refuse_insecure
from agent.commands.variables import Repeated, heed_variables
from agent.contract.errors import EXIT_GOOD, EXIT_NO

if TYPE_CHECKING:
    from agent.doctor.findings import Finding

NODES = 4  # of a run, where no gains are named
OTHERS = 4  # processes of a run beside its nodes: coordinator, plant, recorder, and the one that they are forked from


def add_doctor(commands: Subcommands, environment: Mapping[str, str] = os.environ) -> None:
    """Describe `doctor` to the parser; what its options are by default may stand in the environment, as for a role."""
    doctor = add_command(
        commands, "doctor", doctor_command, "look whether this machine can take part in a run, and at what is missing"
    )
    doctor.add_argument("gains", nargs="?", type=Path, metavar="GAINS", help=f"of the run (one of {NODES} nodes)")
    doctor.add_argument("--listen", metavar="ADDRESS", help="also try to listen there, such as tcp/192.168.0.7:7447")
    doctor.add_argument(
        "--connect", action=Repeated, default=[], metavar="ADDRESS", help="also look for a run there; may be repeated"
    )
    doctor.add_argument("--wait", type=positive, default=10.0, metavar="S", help="seconds to wait for an answer (10)")
    add_keys_option(doctor)
    add_insecure_option(doctor)
    doctor.add_argument("--json", action="store_true", help="print one JSON object")
    heed_variables(doctor, environment)


def doctor_command(options: argparse.Namespace) -> int:
    """`peakmesh doctor`: exit code 1 where something is wrong. The object of --json: good, and findings, a list of
    what, state (good, absent, warning, wrong) and said.
    """
    from agent.doctor.findings import State, text

    findings = list(_findings(options))
    good = all(finding.state is not State.WRONG for finding in findings)
    told = {"good": good, "findings": [finding.document() for finding in findings]}
    print(json.dumps(told) if options.json else text(findings))
    return EXIT_GOOD if good else EXIT_NO


def _whose(keys: Path | None) -> str:
    """Whose certificate is in a folder: a viewer's, who may look for any run, or that of whoever is to run here."""
    from agent.contract.keys import VIEWER

    found = set() if keys is None else {path.stem for path in keys.glob("*.pem")} - {"ca"}
    return VIEWER if VIEWER in found or not found else min(found)


def _findings(options: argparse.Namespace) -> Iterator[Finding]:
    from agent.doctor import machine, network, software
    from agent.network.addresses import NONE, refuse_addresses
    from agent.network.configuration import Network

    problem = None if options.gains is None else load_gains(options.gains).problem
    refuse_addresses(listen=options.listen or NONE, connect=options.connect)
    local = "tcp/127.0.0.1:0" if options.keys is None else "tls/127.0.0.1:0"
    refuse_insecure(options.listen or local, options.connect, keys=options.keys, insecure=options.insecure)
    credentials = credentials_of(options, _whose(options.keys), problem)
    yield software.python()
    yield from software.packages()
    yield from machine.machine((NODES if problem is None else problem.n) + OTHERS)
    yield network.loopback(options.wait)
    yield network.sockets(options.wait)
    if options.listen is not None:
        yield network.listening(Network(options.listen, credentials=credentials, problem=problem))
    if options.connect:
        yield from network.reached(
            Network(local, tuple(options.connect), options.wait, credentials=credentials, problem=problem)
        )
