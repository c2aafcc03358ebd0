"""Simulated networks by the thousand: the production roles on a simulated bus, and what must hold of every run.

    python benchmarks/networks.py [--seeds 10000] [--first 0] [--processes 2]
    python benchmarks/networks.py --first 4711 --seeds 1 --trace

A seed and a state of the code give the same run every time; `--trace` shows all that happened in it. Exit code 1 where
a law does not hold. `tests/support/simulated` has the scenarios and the laws.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import sys
import time
from collections import Counter
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "tests" / "support"))

from simulated.night import Finding, look_at, simulated
from simulated.scenario import scenario


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=10_000, help="how many (10000)")
    parser.add_argument("--first", type=int, default=0, help="from this one on (0)")
    parser.add_argument("--processes", type=int, default=os.cpu_count(), help="at a time (all processors)")
    parser.add_argument("--trace", action="store_true", help="show all that happens")
    options = parser.parse_args()
    seeds = range(options.first, options.first + options.seeds)
    if options.trace:
        for seed in seeds:
            trace(seed)
    began = time.monotonic()
    with multiprocessing.get_context("spawn").Pool(options.processes) as pool:
        findings = list(pool.imap_unordered(told, seeds, chunksize=20))
    report(findings, time.monotonic() - began)
    raise SystemExit(any(finding.broken for finding in findings))


def told(seed: int) -> Finding:
    """What came of a seed; what is broken is said at once."""
    finding = look_at(seed)
    for words in finding.broken:
        print(f"{scenario(seed).text()}\n    {words}", flush=True)
    return finding


def report(findings: list[Finding], seconds: float) -> None:
    for kind, number in sorted(Counter(finding.kind for finding in findings).items()):
        print(f"{number:6}  {kind}")
    simulated_seconds = sum(finding.seconds for finding in findings)
    print(f"{len(findings)} networks in {seconds:.0f} s: {simulated_seconds / 3600.0:.1f} hours of theirs")
    broken = sorted(finding.seed for finding in findings if finding.broken)
    print(f"{len(broken)} in which a law does not hold{': ' if broken else ''}{' '.join(map(str, broken))}")


def trace(seed: int) -> None:
    with simulated(scenario(seed)) as outcome:
        print(outcome.scenario.text(), *outcome.trace, sep="\n")


if __name__ == "__main__":
    main()
