"""`peakmesh verify`: a certificate proved again, without a solver."""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

from agent.commands.options import Subcommands, add_command, load_gains
from agent.contract.errors import EXIT_GOOD, EXIT_NO, InputError

PROVED = {
    "lyapunov": "mean-square stability, and gamma by (17) and (18) of Theorem 1 in every mode",
    "exact": "mean-square stability by (17), and gamma by the recursion of the exact gain and by its tail",
}


def add_verify(commands: Subcommands) -> None:
    """Describe `verify` to the parser."""
    verify = add_command(commands, "verify", verify_command, "prove a certificate again, without a solver")
    verify.add_argument("gains", type=Path, metavar="GAINS", help="gains file")
    verify.add_argument("--json", action="store_true", help="print one JSON object")


def verify_command(options: argparse.Namespace) -> int:
    """`peakmesh verify GAINS`."""
    from designer.proof.certificate import verify

    gains = load_gains(options.gains)
    started = time.perf_counter()
    try:
        verdict = verify(gains)
    except InputError as error:
        raise InputError(f"{options.gains}: {error}") from None
    seconds = time.perf_counter() - started
    kind, how = gains.certificate.kind, f"{verdict.arithmetic}; {seconds:.2f} s"
    if options.json:
        print(json.dumps(verdict._asdict() | {"kind": kind, "seconds": seconds}))
    elif verdict.holds:
        print(f"holds: gamma = {verdict.gamma} is proved\nproved  {PROVED[kind]}\nin      {how}")
    else:
        print(f"does not hold: gamma = {verdict.gamma} is not proved for {options.gains}: {verdict.failure}")
        print(f"in      {how}")
    return EXIT_GOOD if verdict.holds else EXIT_NO
