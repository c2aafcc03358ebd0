"""Sizes and times as people write them."""

from __future__ import annotations

import argparse

import pytest

from agent.commands.options import add_recording_options, recording_plan_of
from agent.commands.roles import add_roles, network_of
from agent.network.configuration import zenoh_configuration
from agent.plan import RecordingPlan


@pytest.mark.parametrize(
    ("words", "plan"),
    [
        ([], RecordingPlan()),
        (["--split-size", "100MB"], RecordingPlan(split_size=100_000_000)),
        (["--split-size", "1.5 gb"], RecordingPlan(split_size=1_500_000_000)),
        (["--split-size", "2KiB"], RecordingPlan(split_size=2048)),
        (["--split-size", "1000"], RecordingPlan(split_size=1000)),
        (["--split-duration", "10min"], RecordingPlan(split_seconds=600.0)),
        (["--split-duration", "1.5h"], RecordingPlan(split_seconds=5400.0)),
        (["--split-duration", "90"], RecordingPlan(split_seconds=90.0)),
        (["--on-record-failure", "continue"], RecordingPlan(goes_on=True)),
    ],
)
def test_sizes_and_times_are_read(words: list[str], plan: RecordingPlan) -> None:
    parser = argparse.ArgumentParser()
    add_recording_options(parser)
    assert recording_plan_of(parser.parse_args(words)) == plan


@pytest.mark.parametrize(("deadline", "lease"), [("0.5", 10.0), ("10", 20.0), ("60", 120.0)])
@pytest.mark.parametrize("role", ["coordinator", "plant", "recorder"])
def test_a_link_lasts_as_long_as_the_deadline(role: str, deadline: str, lease: float) -> None:
    """It is the deadline that ends a run which an outage holds up, not a link that was given up before."""
    parser = argparse.ArgumentParser()
    add_roles(parser.add_subparsers(dest="command"), {})
    network = network_of(
        parser.parse_args([role, "g", "--connect", "tcp/127.0.0.1:1", "--deadline", deadline]), role, None
    )
    assert network.lease == lease
    assert zenoh_configuration(network, run="r")["transport"]["link"]["tx"]["lease"] == 1000 * lease
