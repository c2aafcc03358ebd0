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
    "exact": "mean-square stability by (17), and gamma by the recursion of the exact gain",
}


def add_verify(commands: Subcommands) -> None:
    """Describe `verify` to the parser."""
    verify = add_command(commands, "verify", verify_command, "prove a certificate again, without a solver")
    verify.add_argument("gains", type=Path, metavar="GAINS", help="gains file")
    verify.add_argument(
        "--balls", action="store_true", help="in ball arithmetic alone: slower, and nothing is assumed of numpy"
    )
    verify.add_argument("--json", action="store_true", help="print one JSON object")


def verify_command(options: argparse.Namespace) -> int:
    """`peakmesh verify GAINS`."""
    from designer.proof.certificate import verify
    from designer.proof.prover import BALLS, FLOATS

    gains = load_gains(options.gains)
    started = time.perf_counter()
    try:
        verdict = verify(gains, makes=BALLS if options.balls else FLOATS + BALLS)
    except InputError as error:
        raise InputError(f"{options.gains}: {error}") from None
    seconds, claim = time.perf_counter() - started, gains.certificate
    proved, how = [PROVED[claim.kind]], f"{verdict.arithmetic}; {seconds:.2f} s"
    if claim.theorem1_gamma is not None:
        proved.append(f"gamma = {claim.theorem1_gamma} too, by (17) and (18) of Theorem 1 for the same P")
    if options.json:
        said = {"kind": claim.kind, "theorem1_gamma": claim.theorem1_gamma, "seconds": seconds}
        print(json.dumps(verdict._asdict() | said))
    elif verdict.holds:
        print("\n".join([f"holds: gamma = {verdict.gamma} is proved", *(f"proved  {text}" for text in proved)]))
        print(f"in      {how}")
    else:
        print(f"does not hold: gamma = {verdict.gamma} is not proved for {options.gains}: {verdict.failure}")
        print(f"in      {how}")
    return EXIT_GOOD if verdict.holds else EXIT_NO
