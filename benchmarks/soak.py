"""A long paced run with faults of every kind, drawn from a seed: what grows, what is lost, and what the replay says.

    python benchmarks/soak.py [--minutes 10] [--period 50ms] [--seed 1] [GAINS]

Memory and descriptors of each process are looked at every second. Of one that has lived for 100 s the last quarter of
its life is compared with the second: they are to be flat within 5 %. The run is to lose nothing, its replay to agree,
its ledger to be valid, and its errors to stay within the bound of their own path at every step. Exit code 1 where
something is not so. The disturbance is white noise, so that there is something to estimate until the end.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import subprocess
import sys
import tempfile
import threading
from collections import defaultdict
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

from agent.commands.options import _period
from agent.contract.gains import Gains
from agent.contract.problem import Problem
from designer.replay import replay
from designer.replay.verdict import Verdict

GOLDEN = Path(__file__).parents[1] / "recordings" / "golden" / "zhu2020-lossy.gains.json"
EVERY = 20.0  # seconds between faults, so that nobody is given up
SETTLED = 100.0  # seconds after which a process is judged
FLAT = 0.05  # part by which it may have grown
ROLES = ("coordinator", "recorder", "plant", "node")
KINDS = ("kill node", "kill plant", "kill recorder", "kill coordinator", "freeze", "mute-link", "delay", "drop")


class Sample(NamedTuple):
    """A process at a time."""

    at: float  # seconds
    memory: int  # resident, in kB
    descriptors: int


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("gains", nargs="?", type=Path, default=GOLDEN)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--period", default="50ms")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--every", type=float, default=EVERY, help=f"seconds between faults ({EVERY:g})")
    options = parser.parse_args()
    period = _period(options.period)
    steps = round(60.0 * options.minutes / period)
    with tempfile.TemporaryDirectory() as folder:
        gains = with_noise(Gains.load(options.gains))
        path = Path(folder) / "gains.json"
        gains.save(path)
        faults = drawn(options.seed, gains.problem, steps=steps, every=round(options.every / period))
        print(f"{steps} steps of {options.period}, {len(faults)} faults, load {os.getloadavg()[0]:.1f} before")
        recording = Path(folder) / "run.mcap"
        facts, lives = run(path, recording, ["--period", options.period, "--steps", str(steps)], faults)
        verdict = replay(recording)
    wrong = [*about_processes(lives), *about_the_run(facts, verdict)]
    print(*wrong, sep="\n")
    raise SystemExit(bool(wrong))


def with_noise(gains: Gains) -> Gains:
    """The same for a plant that is disturbed until the end; no certificate depends on the disturbance."""
    document = gains.problem.document() | {"disturbance": {"kind": "white", "deviation": 1.0}}
    problem = Problem.from_document(document)
    return gains.model_copy(update={"problem": problem, "problem_digest": problem.digest(), "worst_case": None})


def drawn(seed: int, problem: Problem, *, steps: int, every: int) -> list[str]:
    """Faults as `--fault` takes them, one every so many steps: each kind comes once before any comes again."""
    chance = random.Random(f"soak {seed}")
    kinds: list[str] = []
    found = []
    for first in range(every, steps - 2 * every, every):
        kinds = kinds or chance.sample(KINDS, len(KINDS))
        found.append(_one(kinds.pop(), chance, problem, first, first + every // 2))
    return found


def _one(kind: str, chance: random.Random, problem: Problem, first: int, last: int) -> str:
    name = chance.choice(problem.node_names)
    match kind.split():
        case ["kill", "node"]:
            return f"kill:node={name},step={first}"
        case ["kill", role]:
            return f"kill:{role},step={first}"
        case ["freeze"]:
            whom = chance.choice((f"node={name}", "plant", "recorder", "coordinator"))
            return f"freeze:{whom},step={first},for={chance.choice((300, 1000, 2000))}ms"
        case ["mute-link"]:
            return f"mute-link:{chance.choice(('plant', 'coordinator'))}>{name},steps={first}-{last}"
        case ["delay"]:
            return f"delay:node={name},by={chance.choice((10, 30, 100))}ms,steps={first}-{last}"
    return f"drop:probability={chance.choice((0.02, 0.1))},steps={first}-{last}"


def run(
    gains: Path, recording: Path, plan: list[str], faults: Sequence[str]
) -> tuple[dict[str, Any], dict[str, list[Sample]]]:
    """What the run says of itself, and of every process what was seen of it each second."""
    command = [sys.executable, "-m", "agent", "run", str(gains), "--json", "-o", str(recording), *plan]
    command += [word for fault in faults for word in ("--fault", fault)]
    lives: dict[str, list[Sample]] = defaultdict(list)
    over, second = threading.Event(), 0
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:

        def look() -> None:
            nonlocal second
            while not over.wait(1.0):
                second += 1
                for name, sample in seen(process.pid, float(second)):
                    lives[name].append(sample)

        looking = threading.Thread(target=look)
        looking.start()
        said, _ = process.communicate()
        over.set()
        looking.join()
    if process.returncode:
        raise SystemExit(f"the run ended with exit code {process.returncode}")
    return json.loads(said), dict(lives)


def seen(launcher: int, at: float) -> list[tuple[str, Sample]]:
    """Every role below a process, by its name and process id."""
    found, parents = [], {}
    for path in Path("/proc").iterdir():
        with suppress(OSError, ValueError, IndexError):  # no process, or it has ended meanwhile
            parents[int(path.name)] = int((path / "stat").read_text().rpartition(")")[2].split()[1])
    for pid in parents:
        with suppress(OSError, IndexError):
            words = Path(f"/proc/{pid}/cmdline").read_text().replace("\0", " ").split()
            role = next((word for word in words if word in ROLES), None)
            if role is None or launcher not in ancestors(pid, parents):
                continue
            whose = f" {words[words.index('--node') + 1]}" if role == "node" else ""
            pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
            descriptors = len(os.listdir(f"/proc/{pid}/fd"))
            if pages and descriptors:  # neither is there of one that is just ending
                memory = pages * os.sysconf("SC_PAGE_SIZE") // 1024
                found.append((f"{role}{whose} ({pid})", Sample(at, memory, descriptors)))
    return found


def ancestors(pid: int, parents: dict[int, int]) -> set[int]:
    """Of a process; where one has ended in between, as far as is known."""
    found: set[int] = set()
    while (pid := parents.get(pid, 0)) and pid not in found:
        found.add(pid)
    return found


class Growth(NamedTuple):
    """The medians of the second and of the last quarter of a life."""

    before: float
    after: float

    @property
    def part(self) -> float:
        return self.after / self.before - 1.0

    @classmethod
    def of(cls, values: Sequence[float]) -> Growth:
        quarter = len(values) // 4
        return cls(median(values[quarter : 2 * quarter]), median(values[-quarter:]))


def about_processes(lives: dict[str, list[Sample]], *, settled: float = SETTLED) -> list[str]:
    """Prints what each process took; returns what is not as it should be."""
    wrong, judged = [], 0
    for name, samples in lives.items():
        if samples[-1].at - samples[0].at < settled:
            continue
        judged += 1
        memory = Growth.of([sample.memory / 1024.0 for sample in samples])
        descriptors = Growth.of([float(sample.descriptors) for sample in samples])
        print(
            f"{name:24} {samples[-1].at - samples[0].at:4.0f} s: {memory.before:6.1f} -> {memory.after:6.1f} MB "
            f"({memory.part:+.1%}), {descriptors.before:.0f} -> {descriptors.after:.0f} descriptors"
        )
        for what, growth in (("memory", memory), ("descriptors", descriptors)):
            if growth.part > FLAT:
                wrong.append(f"{name}: {what} grew by {growth.part:.1%}")
    print(f"{judged} of {len(lives)} processes lived for {settled:g} s")
    return wrong


def about_the_run(facts: dict[str, Any], verdict: Verdict) -> list[str]:
    """Prints what became of the run; returns what is not as it should be."""
    assert verdict.pacing is not None
    pacing, ledger = verdict.pacing, verdict.ledger
    print(f"{facts['messages']} messages, {facts['missing']} missing; the replay {verdict.outcome}")
    print(f"substituted {pacing.pairs_substituted} of {pacing.pairs} pairs, unexplained {pacing.unexplained_total}")
    print(f"{len(pacing.beginnings)} beginnings; ledger: {ledger.text() if ledger else 'none'}")
    path = verdict.proofs[4]
    wrong = [f"{facts['missing']} messages are missing"] if facts["missing"] else []
    if verdict.exit_code:
        wrong.append(verdict.text())
    if ledger is not None and ledger.last.status == "void":
        wrong.append(f"the ledger is void: {ledger.last.text()}")
    if not path.holds:
        wrong.append(path.text())
    return wrong


if __name__ == "__main__":
    main()
