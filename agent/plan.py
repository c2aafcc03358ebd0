"""What a coordinator is to do, and a recorder."""

from __future__ import annotations

from dataclasses import dataclass

LARGEST_WINDOW = 1024  # so that what runs ahead always fits into the channels that wait for it


@dataclass(frozen=True)
class Plan:
    """The facts of a run that only the coordinator decides; the others learn them at the start."""

    steps: int
    seed: int
    window: int = 32  # steps that modes and measurements may run ahead of what is recorded
    deadline: float = 10.0  # seconds without progress
    external: tuple[str, ...] = ()  # nodes whose measurements come from a sensor


@dataclass(frozen=True)
class RecordingPlan:
    """What only the recorder decides."""

    split_size: int | None = None  # bytes of messages after which a new part of the recording begins
    split_seconds: float | None = None
    goes_on: bool = False  # whether the run does where it cannot be recorded any more
