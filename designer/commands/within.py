"""--within of `analyse` and `verify`: a box of models for which gamma is asked."""

from __future__ import annotations

import argparse


def add_within(parser: argparse.ArgumentParser) -> None:
    """Add the option; `designer.box.extent.within` reads it."""
    parser.add_argument(
        "--within",
        action="append",
        default=[],
        metavar="NAME=SIZE",
        help="prove gamma for every model in a box too: probabilities=0.02, or 2%% of each, for those of arrival and "
        "delivery that are below 1; transition=0.05, total variation of each row; may be repeated",
    )
