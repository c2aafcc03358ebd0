"""Many nodes on this machine: start, lock-step, against the clock; what a node takes, whether the recorder keeps up.

    python benchmarks/many.py [--nodes 64 --nodes 128] [--steps 100] [--period 1s] [--seconds 20]

Each node hears one of two others, on a ring. Every run's replay must agree, with nothing missing and every substitution
explained, or there is nothing to measure. Sockets and memory are read while the run goes on: resident memory counts
what processes have in common for each of them, proportional memory counts it once. Times are of one run each, and
beside them stands how busy the machine was.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

from lockstep import TICK, children, role
from replay import ring

from agent.commands.options import _period
from agent.contract.gains import Gains
from agent.contract.keys import EVIDENCE, RECORDER
from agent.contract.recording.reader import RecordingReader
from agent.network.links import linked
from designer.replay import replay

LOOK_SECONDS = 0.5


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--nodes", type=int, action="append", help="may be repeated (64 and 128)")
    parser.add_argument("--steps", type=int, default=100, help="in lock-step")
    parser.add_argument("--period", default="1s")
    parser.add_argument("--seconds", type=float, default=20.0, help="of the run against the clock")
    options = parser.parse_args()
    print(f"{os.cpu_count()} processors")
    for nodes in options.nodes or [64, 128]:
        gains = ring(nodes)
        links = {len(linked(gains.problem, who)) for who in (f"node-{name}" for name in gains.problem.node_names)}
        print(f"\n{nodes} nodes, each with {' or '.join(map(str, sorted(links)))} links")
        measure(gains, "lock-step", "--steps", options.steps)
        steps = max(1, round(options.seconds / _period(options.period)))
        measure(gains, f"period {options.period}", "--steps", steps, "--period", options.period)


def measure(gains: Gains, name: str, *arguments: object) -> None:
    """Run, replay, and print."""
    with tempfile.TemporaryDirectory() as folder:
        path, recording = Path(folder) / "gains.json", Path(folder) / "run.mcap"
        gains.save(path)
        before = os.getloadavg()[0]
        command = [sys.executable, "-m", "agent", "run", str(path), "--json", "-o", str(recording)]
        with subprocess.Popen([*command, *map(str, arguments)], stdout=subprocess.PIPE, text=True) as process:
            watcher = Watcher(process.pid)
            watcher.start()
            printed, _ = process.communicate()
            watcher.ended.set()
            watcher.join()
        if process.returncode:
            raise SystemExit(process.returncode)
        facts, verdict = json.loads(printed), replay(recording)
        assert verdict.agrees, verdict.text()
        assert facts["missing"] + verdict.missing.total == 0, verdict.text()
        load = f"load {before:.1f} before, {os.getloadavg()[0]:.1f} after"
        print(
            f"  {name}: step 0 after {facts['start_seconds']:.1f} s, {facts['rounds_per_second']:.1f} steps/s; {load}"
        )
        if verdict.pacing is not None:
            pacing = verdict.pacing
            print(
                f"    substituted {pacing.pairs_substituted} of {pacing.pairs} pairs and "
                f"{pacing.measurements_substituted} measurements; unexplained {pacing.unexplained_total}"
            )
            assert pacing.unexplained_total == 0
        print_use(watcher, facts["rounds_per_second"] * facts["messages"] / facts["steps"])
        print_lag(recording)


def print_use(watcher: Watcher, rate: float) -> None:
    """Of the nodes the median and the most; of the recorder what it takes at a `rate` of messages a second."""
    nodes = [use for who, use in watcher.last.items() if who.startswith("node")]
    for what, words in (
        ("resident", "MB resident"),
        ("proportional", "MB proportional"),
        ("sockets", "sockets"),
        ("threads", "threads"),
    ):
        values = [getattr(use, what) for use in nodes]
        print(f"    a node: {statistics.median(values):.0f} {words}, {max(values):.0f} at most")
    first, last = watcher.first[RECORDER], watcher.last[RECORDER]
    if last.at > first.at:
        busy = (last.processor - first.processor) / (last.at - first.at)
        print(f"    recorder: {last.resident:.0f} MB, {last.sockets} sockets, {busy:.0%} of a processor", end="")
        print(f" for {rate:.0f} messages/s")


def print_lag(recording: Path) -> None:
    """From a message's publication to its receipt by the recorder; one that falls behind is later and later."""
    with RecordingReader(recording) as reader:
        lags = [(m.log_time - m.publish_time) / 1e6 for m in reader.messages() if m.topic != EVIDENCE]
    third = len(lags) // 3
    medians = [f"{statistics.median(some):.1f} ms" for some in (lags[:third], lags[third:-third], lags[-third:])]
    print(f"    recorder: has a message {', '.join(medians)} after it was sent, in the median of each third of the run")


class Use:
    """What a process takes."""

    def __init__(self, pid: int) -> None:
        folder, self.at = Path(f"/proc/{pid}"), time.monotonic()
        stat = (folder / "stat").read_text().rpartition(")")[2].split()
        self.processor = (int(stat[11]) + int(stat[12])) / TICK
        self.threads = int(stat[17])
        memory = dict(line.split(":") for line in (folder / "smaps_rollup").read_text().splitlines()[1:])
        self.resident, self.proportional = (int(memory[name].split()[0]) / 1024 for name in ("Rss", "Pss"))
        links = [os.readlink(folder / "fd" / fd) for fd in os.listdir(folder / "fd")]
        self.sockets = sum(link.startswith("socket:") for link in links)


class Watcher(threading.Thread):
    """Looks at the roles of a run now and then, until it has ended."""

    def __init__(self, launcher: int) -> None:
        super().__init__()
        self._launcher = launcher
        self.ended = threading.Event()
        self.first: dict[str, Use] = {}
        self.last: dict[str, Use] = {}

    def run(self) -> None:
        while not self.ended.wait(LOOK_SECONDS):
            for nursery in children(self._launcher):
                for pid in children(nursery):
                    try:
                        who, use = role(pid), Use(pid)
                    except OSError:  # it has ended
                        continue
                    use.sockets = max(use.sockets, self.first.setdefault(who, use).sockets)  # who leaves has fewer
                    self.last[who] = use


if __name__ == "__main__":
    main()
