"""`run`: every role as a process on this machine, started from Python."""

from __future__ import annotations

import argparse
import os
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from agent.commands.options import default_recording, plan_of
from agent.contract.errors import InputError, RunBroken
from agent.contract.gains import Gains
from agent.contract.recording.parts import files_of, refuse_recording
from agent.guests import guests
from agent.launch import launch
from agent.plan import LARGEST_WINDOW, Pace, Plan
from peakmesh.answers import Name, replay
from peakmesh.functions import Cast, Command, Dynamics, Filter
from peakmesh.sensors import Measure

if TYPE_CHECKING:
    from designer.replay.verdict import Verdict


@dataclass(frozen=True)
class Run:
    """How a run went; the fields are the keys of `peakmesh run --json`."""

    recording: Path
    parts: tuple[Path, ...]  # the files of the recording
    run: str  # its name
    seed: int
    steps: int
    messages: int  # recorded
    missing: int
    recorded_steps: int
    broken_off: str  # why there is no whole recording; "" where there is one
    start_seconds: float  # until step 0
    rounds_per_second: float
    not_whole: str = ""  # who is not recorded to its last step, in a paced run
    pacing: dict[str, Any] | None = None  # of a paced run
    refused: dict[str, Any] | None = None  # messages that did not fit

    def replay(self) -> Verdict:
        """The recording against the centralised error model."""
        return replay(*self.parts)


def run(
    gains: Gains | Name,
    recording: Name | None = None,
    *,
    steps: int = 200,
    seed: int = 0,
    window: int = 32,
    nodes: Mapping[str, Filter | Command] | None = None,
    sensors: Mapping[str, Measure | Command] | None = None,
    plant: Dynamics | Command | None = None,
    external: Sequence[str] = (),
    period: float | None = None,
    faults: Sequence[str] = (),
    deadline: float = 10.0,
    wait: float = 60.0,
    name: str | None = None,
    force: bool = False,
    report: Callable[[dict[str, Any]], None] = lambda word: None,
) -> Run:
    """Run a network (`peakmesh run`) and wait for its end; in notebooks, too.

    `nodes`, `sensors` and `plant` are yours: commands, as `peakmesh run` takes them, or functions. A sensor is one of
    the step that returns y (ny_i,); a node one of the mode and of (x_hat, innovation) of every node that was heard, by
    name and with its own, that returns its next x_hat (nx,), eq. (5); the plant one of x (nx,) and w (nw,) that returns
    the next x, eq. (1). `external` names nodes whose sensors somebody else starts; `period`, in seconds, makes it a
    paced run, which survives `faults`; `deadline` is how many seconds without progress end it, `wait` how many all have
    to start.
    `report` is told what happens as it does: {"listening": addresses}, {"started": time}, {"complete": steps}, ...
    Raises InputError, RunBroken where it does not come to its end, Interrupted on a signal; no process is left.
    """
    found = gains if isinstance(gains, Gains) else Gains.load(gains)
    cast = Cast(found, nodes=nodes or {}, sensors=sensors or {}, plant=plant)
    named = [external] if isinstance(external, str) else external
    measured = list(dict.fromkeys([*named, *(sensors or {})]))
    plan = _plan(found, steps, seed, window, measured, period, faults, deadline)
    invited = guests(found, **cast.commands)
    name = name or new_name(found)
    path = default_recording(name) if recording is None else Path(recording)
    refuse_recording(path, force=force)

    def heed(word: dict[str, Any]) -> None:
        if "listening" in word:
            cast.start(run=name, address=word["listening"][0], wait=wait, deadline=deadline)
        report(word)

    with file_of(gains) as gains_path, closing(cast):
        try:
            summary = launch(
                gains_path, found, plan, run=name, recording=path, force=force, wait=wait, report=heed, guests=invited
            )
        except RunBroken as error:
            raise (RunBroken(why) if (why := cast.failures()) else error) from None
    return Run(recording=path, parts=tuple(files_of(path)), run=name, seed=seed, **summary)


def new_name(gains: Gains) -> str:
    """For a run of these gains, that no other run has."""
    return f"{gains.problem.name}-{os.urandom(4).hex()}"


@contextmanager
def file_of(gains: Gains | Name) -> Iterator[Path]:
    """Where gains stand in a file; those of this process in one that is there for so long."""
    if not isinstance(gains, Gains):
        yield Path(gains)
        return
    with tempfile.TemporaryDirectory(prefix="peakmesh-") as folder:
        path = Path(folder) / "gains.json"
        gains.save(path)
        yield path


def _plan(
    gains: Gains,
    steps: int,
    seed: int,
    window: int,
    external: Sequence[str],
    period: float | None,
    faults: Sequence[str],
    deadline: float,
) -> Plan:
    """The plan, refused like the options of the command."""
    for what, value, least, most in (
        ("steps", steps, 1, 2**31 - 1),
        ("seed", seed, 0, 2**63 - 1),
        ("window", window, 1, LARGEST_WINDOW),
    ):
        if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= most:
            raise InputError(f"{what} is {value!r}; it must be a whole number from {least} to {most}")
    if period is not None and not 1e-3 <= period <= 3600.0:
        raise InputError(f"period is {period!r}; it must be a number of seconds from 0.001 to 3600")
    options = argparse.Namespace(
        steps=steps,
        seed=seed,
        window=window,
        deadline=deadline,
        external=list(external),
        period=period,
        fault=[faults] if isinstance(faults, str) else list(faults),
        measure_by=Pace(1.0).measure_by,
        hear_by=Pace(1.0).hear_by,
    )
    return plan_of(options, gains)
