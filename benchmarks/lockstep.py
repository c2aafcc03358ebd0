"""The real run beside the same run over raw AF_UNIX sockets, in one invocation.

    python benchmarks/lockstep.py [--steps 3000] [--repeat 3] [--keys FOLDER] [GAINS]

Prints rounds per second as medians, the ratio to both orders of the reference, CPU time and context switches per round
of every process, resident memory, and the seconds from the start of the command to step 0. The estimates of all runs
must be the same, bit for bit, or there is nothing to compare.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import unix_sockets

from agent.contract.gains import Gains
from agent.contract.keys import estimate
from agent.contract.recording.reader import RecordingReader

GOLDEN = Path(__file__).parents[1] / "recordings" / "golden" / "zhu2020-lossy.gains.json"
SEED = 1
TICK = os.sysconf("SC_CLK_TCK")
POOLS = ("rx-", "tx-", "net-", "acc-", "app-")  # names of Zenoh's threads


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("gains", nargs="?", type=Path, default=GOLDEN)
    parser.add_argument("--steps", type=int, default=3000)
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--window", type=int, action="append", help="of peakmesh; may be repeated (its default)")
    parser.add_argument("--keys", type=Path, help="once more with these, over TLS in place of Unix sockets")
    options = parser.parse_args()
    gains = Gains.load(options.gains)
    rates: dict[str, list[float]] = {}
    for _ in range(options.repeat):
        for name, window in (("AF_UNIX, strict", None), ("AF_UNIX, window 32", 32)):
            rate, digests = unix_sockets.run(gains, steps=options.steps, seed=SEED, window=window)
            rates.setdefault(name, []).append(rate)
        for window in options.window or [None]:
            run = peakmesh(options.gains, gains, options.steps, window)
            assert run["digests"] == digests, "the runs differ"
            rates.setdefault("peakmesh" if window is None else f"peakmesh, window {window}", []).append(run["rate"])
        if options.keys is not None:
            run = peakmesh(options.gains, gains, options.steps, None, "--keys", options.keys)
            assert run["digests"] == digests, "the runs differ"
            rates.setdefault("peakmesh, with keys", []).append(run["rate"])
    strict, windowed = (statistics.median(rates[name]) for name in ("AF_UNIX, strict", "AF_UNIX, window 32"))
    print(f"{'':24} rounds/s   (of {options.repeat}: least, most)   of strict   of windowed AF_UNIX")
    for name, several in rates.items():
        rate = statistics.median(several)
        spread = f"({min(several):.0f}, {max(several):.0f})"
        print(f"{name:24} {rate:8.0f}   {spread:>24}   {rate / strict:9.2f}   {rate / windowed:9.2f}")
    print(f"\nthe last peakmesh run: step 0 after {run['start_seconds']:.2f} s; per round")
    for who, use in run["use"].items():
        print(
            f"  {who:14} {use['user']:5.0f} us user {use['system']:5.0f} us system, {use['zenoh']:5.0f} us of both in "
            f"Zenoh's threads {use['switches']:6.1f} waits   {use['megabytes_at_first']:4.0f} MB resident at first, "
            f"{use['megabytes']:.0f} MB at last"
        )
    whole = sum(use["user"] + use["system"] for use in run["use"].values())
    print(f"  {'together':14} {whole:5.0f} us of processor time, {1e6 / run['rate']:.0f} us passed")


def peakmesh(path: Path, gains: Gains, steps: int, window: int | None, *more: object) -> dict[str, Any]:
    """One real run: its rate, what its processes used, and a digest of each node's estimates."""
    with tempfile.TemporaryDirectory() as folder:
        recording = Path(folder) / "run.mcap"
        command = [sys.executable, "-m", "agent", "run", str(path), "--json", "-o", str(recording)]
        command += ["--steps", str(steps), "--seed", str(SEED)]
        command += [] if window is None else ["--window", str(window)]
        command += map(str, more)
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        watcher = Watcher(process.pid, recording.with_name("run.mcap.part"))
        watcher.start()
        printed, _ = process.communicate()
        watcher.join()
        facts = json.loads(printed)
        return {
            "rate": facts["rounds_per_second"],
            "start_seconds": facts["start_seconds"],
            "use": watcher.use(steps),
            "digests": digests(recording, gains),
        }


def digests(recording: Path, gains: Gains) -> dict[str, str]:
    """Of each node's estimates, in the order of their steps."""
    found = {estimate(name): hashlib.sha256() for name in gains.problem.node_names}
    with RecordingReader(recording) as reader:
        for message in reader.messages():
            if message.topic in found:
                found[message.topic].update(message.payload)
    return {name: found[estimate(name)].hexdigest() for name in gains.problem.node_names}


class Watcher(threading.Thread):
    """Reads /proc of a launcher's children, from the start of the recording to its end."""

    def __init__(self, launcher: int, part: Path) -> None:
        super().__init__()
        self._launcher, self._part = launcher, part
        self._first: dict[str, list[float]] = {}
        self._last: dict[str, list[float]] = {}

    def run(self) -> None:
        while not self._part.exists():
            time.sleep(0.005)
        while self._part.exists():
            seen = {who: counts for pid in self._children() if (who := role(pid)) and (counts := counted(pid))}
            self._first = {**seen, **self._first}
            self._last |= seen
            time.sleep(0.1)

    def use(self, steps: int) -> dict[str, dict[str, float]]:
        """Per round, of each process."""
        found = {}
        for who, last in sorted(self._last.items()):
            user, system, zenoh, switches = (
                1e6 * (b - a) / steps for a, b in zip(self._first[who], last[:4], strict=False)
            )
            found[who] = {
                "user": user,
                "system": system,
                "zenoh": zenoh,
                "switches": switches / 1e6,
                "megabytes_at_first": self._first[who][4],
                "megabytes": last[4],
            }
        return found

    def _children(self) -> list[int]:
        return [role for nursery in children(self._launcher) for role in children(nursery)]


def children(parent: int) -> list[int]:
    try:
        text = Path(f"/proc/{parent}/task/{parent}/children").read_text()
    except OSError:
        return []
    return [int(pid) for pid in text.split()]


def role(pid: int) -> str:
    """`node 3`, `plant`, ... from a command line."""
    try:
        words = Path(f"/proc/{pid}/cmdline").read_text().replace("\0", " ").split()
    except OSError:
        return ""
    if words[:1] != ["peakmesh"]:
        return ""
    return f"node {words[words.index('--node') + 1]}" if words[1] == "node" else words[1]


def counted(pid: int) -> list[float]:
    """CPU seconds (user, system, of both in Zenoh's threads), voluntary context switches, resident megabytes."""
    used, zenoh, switches = [0.0, 0.0], 0.0, 0.0
    try:
        resident = _field(Path(f"/proc/{pid}/status").read_text(), "VmRSS") / 1024
        for task in Path(f"/proc/{pid}/task").iterdir():
            name, _, fields = (task / "stat").read_text().partition("(")[2].rpartition(")")
            seconds = [int(ticks) / TICK for ticks in fields.split()[11:13]]
            used = [a + b for a, b in zip(used, seconds, strict=True)]
            zenoh += sum(seconds) if name.startswith(POOLS) else 0.0
            switches += _field((task / "status").read_text(), "voluntary_ctxt_switches")
    except OSError:
        return []
    return [*used, zenoh, switches, resident]


def _field(status: str, name: str) -> int:
    return next(int(line.split()[1]) for line in status.splitlines() if line.startswith(name + ":"))


if __name__ == "__main__":
    main()
