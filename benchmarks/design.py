"""How long a design takes: the paper's LMI as printed beside the decomposed one, and large networks.

    python benchmarks/design.py [--literal 4 8 12] [--decomposed 4 8 12 25 50 100 200] [--seed 1]

Every design runs in a process of its own, so that its peak memory is its own. "solver" is the solver's own part,
"whole" everything from problem to certified gains, "cpu" the processor time of the whole, which other programs on
the machine disturb less. The networks are `banded`, with 4 modes and 2 states.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from typing import Any

import numpy as np

from agent.contract.problem import Problem
from designer.problems import find

REACH = 2
CHILD = """
import json, resource, sys, time
from benchmarks.design import banded
from designer.synthesis import design
problem = banded(int(sys.argv[2]), seed=int(sys.argv[3]))
started, cpu = time.perf_counter(), time.process_time()
gains = design(problem, method=sys.argv[1])
whole, cpu = time.perf_counter() - started, time.process_time() - cpu
proved = gains.certificate
print(json.dumps({
    "solver": gains.solver.seconds, "whole": whole, "cpu": cpu, "certify": gains.seconds["certify"],
    "lmi_gamma": proved.lmi_gamma, "gamma": proved.gamma, "form": proved.form, "status": gains.solver.status,
    "iterations": gains.solver.iterations, "file": len(gains.canonical()) / 1e6,
    "peak": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
}))
"""


def banded(n: int, *, seed: int = 1) -> Problem:
    """The paper's plant and chain, n random nodes in a row.

    A node can hear the two before it and the two after it; in each mode each of these links is there with
    probability one half.
    """
    rng = np.random.default_rng([seed, n])
    paper = find("zhu2020-lossy").document()
    names = [str(i + 1) for i in range(n)]
    nodes = [
        {
            "name": name,
            "C": [rng.uniform(0.1, 0.7, size=2).tolist()],
            "D": [[float(rng.uniform(0.4, 1.0))]],
            "arrival_probability": float(rng.uniform(0.75, 0.95)),
        }
        for name in names
    ]
    near = [[j for j in range(max(0, i - REACH), min(n, i + REACH + 1)) if j != i] for i in range(n)]
    topologies = []
    for mode in paper["topology"]:
        hears = {name: [names[j] for j in near[i] if rng.uniform() < 0.5] for i, name in enumerate(names)}
        topologies.append({"name": mode["name"], "hears": hears})
    return Problem.from_document({**paper, "name": f"banded-{n}", "node": nodes, "topology": topologies})


def measure(method: str, n: int, seed: int) -> dict[str, Any]:
    """One design in a process of its own."""
    child = [sys.executable, "-c", CHILD, method, str(n), str(seed)]
    done = subprocess.run(child, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"{method}, {n} nodes: {done.stderr.strip().splitlines()[-1]}")
    return dict(json.loads(done.stdout))


def row(method: str, n: int, facts: dict[str, Any]) -> str:
    """One line of the table."""
    numbers = [f"{facts[name]:9.2f}" for name in ("solver", "whole", "cpu", "certify")]
    sizes = f"{facts['peak']:8.0f} {facts['file']:8.3f} {facts['lmi_gamma']:10.6f} {facts['gamma']:10.6f}"
    said = f"{facts['form']}; {facts['status']}, {facts['iterations']} iterations"
    return f"{method:<10} {n:5d} {''.join(numbers)} {sizes}  {said}"


HEAD = "method     nodes  solver s  whole s    cpu s certify s  peak MB  file MB  LMI gamma  certified  P; solver"


def summary(measured: dict[tuple[str, int], dict[str, Any]]) -> list[str]:
    """Ratios where both methods were measured, and how the time of large networks grows."""
    lines = []
    for n in [n for method, n in measured if method == "theorem2" and ("decomposed", n) in measured]:
        literal, ours = measured["theorem2", n], measured["decomposed", n]
        whole, cpu = literal["whole"] / ours["whole"], literal["cpu"] / ours["cpu"]
        lines.append(f"{n} nodes: theorem2 takes {whole:.1f} times as long, {cpu:.1f} times the processor time")
    large = [n for method, n in measured if method == "decomposed" and n >= 25]
    for name, what in (("whole", "time"), ("cpu", "processor time")):
        if len(large) > 1:
            power = np.polyfit(np.log(large), np.log([measured["decomposed", n][name] for n in large]), 1)[0]
            lines.append(f"{large[0]} to {large[-1]} nodes: the {what} grows as nodes^{power:.2f} (least squares)")
    return lines


def main() -> None:
    """Measure and print, line by line."""
    parser = argparse.ArgumentParser(description="How long a design takes.")
    parser.add_argument("--literal", type=int, nargs="*", default=[4, 8, 12], metavar="NODES")
    parser.add_argument("--decomposed", type=int, nargs="*", default=[4, 8, 12, 25, 50, 100, 200], metavar="NODES")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    print(HEAD)
    measured: dict[tuple[str, int], dict[str, Any]] = {}
    plan = [("decomposed", n) for n in options.decomposed] + [("theorem2", n) for n in options.literal]
    for method, n in plan:
        measured[method, n] = measure(method, n, options.seed)
        print(row(method, n, measured[method, n]), flush=True)
    print("\n".join(summary(measured)))


if __name__ == "__main__":
    main()
