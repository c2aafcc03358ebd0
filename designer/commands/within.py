"""--within of `design`, `analyse` and `verify`: a box of models for which gamma is asked."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from agent.contract.problem import Problem
    from designer.box.extent import Box


def add_within(parser: argparse.ArgumentParser, what: str = "prove gamma for every model in a box too") -> None:
    """Add the option; `asked` reads it."""
    parser.add_argument(
        "--within",
        action="append",
        default=[],
        metavar="NAME=SIZE",
        help=f"{what}, in place of the one that the problem has: probabilities=0.02, or 2%% of each, for those of "
        "arrival and delivery that are below 1; transition=0.05, total variation of each row; A,B,C,D,M=1%%, or a "
        "number, of each entry; may be repeated",
    )


def asked(problem: Problem, texts: Sequence[str]) -> Box | None:
    """The box that gamma is asked for: of --within, or else that of the problem."""
    from designer.box import extent

    return extent.asked(problem, texts)
