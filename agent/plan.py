"""What a coordinator is to do, and a recorder."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from agent.contract.problem import Problem

LARGEST_WINDOW = 1024  # so that what runs ahead always fits into the channels that wait for it


class Pace(NamedTuple):
    """The clock of a paced run."""

    period: float  # seconds from one step to the next
    measure_by: float = 0.4  # part of a period until which a measurement is waited for
    hear_by: float = 0.8  # and the neighbours' pairs


@dataclass(frozen=True)
class Plan:
    """The facts of a run that only the coordinator decides; the others learn them at the start."""

    steps: int
    seed: int
    window: int = 32  # steps that modes and measurements may run ahead of what is recorded
    deadline: float = 10.0  # seconds without progress
    external: tuple[str, ...] = ()  # nodes whose measurements come from a sensor
    pace: Pace | None = None  # None: lock-step
    faults: tuple[str, ...] = ()  # that a paced run is to survive, as agent.faults describes them

    def needs_no_plant(self, problem: Problem) -> bool:
        """Whether no plant takes part: the run is paced, and every node has a sensor."""
        return self.pace is not None and set(problem.node_names) <= set(self.external)


@dataclass(frozen=True)
class RecordingPlan:
    """What only the recorder decides."""

    split_size: int | None = None  # bytes of messages after which a new part of the recording begins
    split_seconds: float | None = None
    goes_on: bool = False  # whether the run does where it cannot be recorded any more
