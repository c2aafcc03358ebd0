"""How a paced run keeps time on this machine: substitutions, latencies, drift, and how soon a killed node is back.

    python benchmarks/paced.py [--period 20ms] [--seconds 60] [GAINS]

Each figure is of one run, and beside it stands how busy the machine was. The replay of each run must agree, with every
substitution explained, or there is nothing to measure.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from agent.commands.options import _period
from agent.contract.messages import LATE, Event, Mode
from agent.contract.recording.reader import RecordingReader
from designer.replay import replay
from designer.replay.pacing import Pacing

GOLDEN = Path(__file__).parents[1] / "recordings" / "golden" / "zhu2020-lossy.gains.json"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("gains", nargs="?", type=Path, default=GOLDEN)
    parser.add_argument("--period", default="20ms")
    parser.add_argument("--seconds", type=float, default=60.0)
    options = parser.parse_args()
    period = _period(options.period)
    steps = max(50, round(options.seconds / period))
    print(f"{os.cpu_count()} processors, load {os.getloadavg()[0]:.1f} before")
    facts, pacing, drift, late = run(options.gains, options.period, period, steps)
    told = facts["pacing"]
    print(f"{steps} steps of {options.period}: drift at the end {1e3 * drift:.2f} ms")
    share = pacing.pairs_substituted / pacing.pairs
    print(f"substituted {pacing.pairs_substituted} of {pacing.pairs} pairs ({share:.3%})")
    print(f"            {pacing.measurements_substituted} measurements; unexplained {pacing.unexplained_total}")
    for what, words in (("estimate", "measurement to estimate"), ("step", "tick to step")):
        times = [f"{1e3 * told[f'to_{what}_{which}']:.2f}" for which in ("median", "p99", "max")]
        print("{}: median {} ms, 99 % {} ms, most {} ms".format(words, *times))
    for line in ways(late):
        print(line)
    few = max(50, round(6.0 / period))
    _, killed, *_ = run(options.gains, options.period, period, few, "--fault", f"kill:node=2,step={few // 3}")
    (absence,) = killed.absences
    first, last = (int(word) for word in absence.rpartition("steps ")[2].split(" to "))
    print(f"a killed node was back after {period * (last - first + 1):.2f} s; load {os.getloadavg()[0]:.1f} after")


def run(
    gains: Path, text: str, period: float, steps: int, *more: str
) -> tuple[dict[str, Any], Pacing, float, list[Event]]:
    """What a run says of itself, what its replay says, by how many seconds its last tick was off, what was late."""
    with tempfile.TemporaryDirectory() as folder:
        recording = Path(folder) / "run.mcap"
        command = [sys.executable, "-m", "agent", "run", str(gains), "--json", "-o", str(recording)]
        command += ["--period", text, "--steps", str(steps), *more]
        facts = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout)
        verdict = replay(recording)
        assert verdict.agrees, verdict.text()
        assert verdict.pacing is not None
        sent, late = ticks_and_late(recording)
    return facts, verdict.pacing, sent[max(sent)] - sent[0] - period * max(sent), late


def ticks_and_late(recording: Path) -> tuple[dict[int, float], list[Event]]:
    """When the mode of each step went out, in seconds, and what nodes say of late messages."""
    found, late = {}, []
    with RecordingReader(recording) as reader:
        for message in reader.messages():
            if message.topic == "mode":
                found[Mode.decode(message.payload).step] = message.publish_time / 1e9
            elif message.topic == "event" and (event := Event.decode(message.payload)).kind == LATE:
                late.append(event)
    return found, late


def ways(late: list[Event]) -> Iterator[str]:
    """Where late messages lost their time: the latest of each event."""
    known = [event for event in late if event.way]
    if not known:
        return
    for place, words in enumerate(("in sending", "on the wire", "in receiving")):
        times = sorted(1e3 * event.way[place] for event in known)
        yield f"of {len(known)} late messages, {words}: median {times[len(times) // 2]:.2f} ms, most {times[-1]:.2f} ms"
    slow = sum(sum(event.way) < max(event.seconds) for event in known)
    yield f"{slow} of them were sent after their deadline already"


if __name__ == "__main__":
    main()
