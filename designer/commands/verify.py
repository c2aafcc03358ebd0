"""`peakmesh verify`: a certificate again, without a solver."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import agent.cli
from agent.contract.errors import EXIT_GOOD, EXIT_NO


def add_verify(commands: agent.cli.Subcommands) -> None:
    """Describe `verify` to the parser."""
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
