"""What a design costs and what it gives: the tables of docs/theory.md, measured anew.

    python benchmarks/design.py [--decomposed 4 8 12 25 50 100 200] [--literal 4 8 12]
                                [--exact 4 6 20 50 100 200] [--budget SECONDS]
                                [--problems zhu2020-ideal quadruple-tank ...]
                                [--networks zhu2020-ideal zhu2020-lossy ring-1 ...] [--seed 1]

First the networks `banded`, with 4 modes and 2 states: the paper's LMI as printed beside the decomposed one, large
networks, and the search for the least exact gain. Every design runs in a process of its own, so that its peak memory
is its own. "solver" is the solver's own part, "whole" everything from problem to certified gains, "cpu" the processor
time of the whole, which other programs on the machine disturb less; "verify" is the processor time of proving the
file again.

Then what the search found of the built-in problems: the LMI that it begins with, the exact gain of that one's gains,
the least gamma and the chosen one with the norm of the gains and their radius, and the floor. At last the ladder of
the paper's two examples and of four random networks: Theorem 2's gamma and the exact gain of its gains, the exact gain
of Kalman-consensus gains, what the search for the least exact gain certifies, and the floor.
An empty list leaves a part out.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from agent.contract.problem import Problem
from designer.problems import find
from designer.reproduce import PRINTED, Computed

REACH = 2
CHILD = """
import json, resource, sys, time
from agent.contract.gains import Gains
from benchmarks.design import network
from designer.proof.certificate import verify
from designer.patience import Budget
from designer.synthesis import design
problem, budget = network(sys.argv[2], seed=int(sys.argv[3])), float(sys.argv[4])
started, cpu = time.perf_counter(), time.process_time()
gains = design(problem, method=sys.argv[1], budget=Budget(budget, clock=time.process_time))
whole, cpu = time.perf_counter() - started, time.process_time() - cpu
started, proved = time.process_time(), gains.certificate
assert verify(Gains.from_bytes(gains.canonical(), source="memory")).holds
print(json.dumps({
    "solver": gains.solver.seconds, "whole": whole, "cpu": cpu, "certify": gains.seconds["certify"],
    "verify": time.process_time() - started,
    "lmi_gamma": proved.lmi_gamma, "lmi_exact": proved.lmi_exact, "gamma": proved.gamma,
    "exact": proved.exact, "floor": proved.floor,
    "form": proved.form, "status": gains.solver.status.partition(";")[0],
    "found": gains.solver.status.rpartition("; ")[2],
    "iterations": gains.solver.iterations, "file": len(gains.canonical()) / 1e6,
    "peak": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
}))
"""


def network(name: str, *, seed: int = 1) -> Problem:
    """A network by its name: "banded-12" has 12 nodes; else one of NETWORKS, or a built-in problem."""
    kind, _, number = name.partition("-")
    if kind == "banded":
        return banded(int(number), seed=seed)
    return NETWORKS[name](seed=seed) if name in NETWORKS else find(name)


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


def random_network(
    number: int, *, seed: int, n: int, nx: int, modes: int, arrival: tuple[float, float], ring: bool = False
) -> Problem:
    """A stable random plant with one disturbance, n sensors with a noise of their own each, a random chain.

    A ring hears the node before in every other mode, the node after in the rest; else each link is there with
    probability one half.
    """
    rng = np.random.default_rng([seed, number, n, nx, modes])
    A = rng.normal(size=(nx, nx))
    A *= rng.uniform(0.75, 0.9) / np.abs(np.linalg.eigvals(A)).max()
    transition = rng.uniform(0.1, 1.0, size=(modes, modes))
    adjacencies = []
    for s in range(modes):
        if ring:
            links = np.roll(np.eye(n), 1 if s % 2 else -1, axis=1)
        else:
            links = np.where(rng.uniform(size=(n, n)) < 0.5, 1.0, 0.0)
        adjacencies.append(np.clip(links + np.eye(n), 0.0, 1.0))
    noise = rng.uniform(0.3, 0.8, size=n)
    return Problem.from_document(
        {
            "name": "random",
            "plant": {
                "A": A.tolist(),
                "B": np.hstack([rng.normal(size=(nx, 1)), np.zeros((nx, n))]).tolist(),
                "M": rng.normal(size=(1, nx)).tolist(),
            },
            "node": [
                {
                    "name": str(i + 1),
                    "C": [rng.normal(size=nx).tolist()],
                    "D": [[0.0, *(noise[i] * np.eye(n)[i]).tolist()]],
                    "arrival_probability": float(rng.uniform(*arrival)),
                }
                for i in range(n)
            ],
            "topology": [{"name": str(s + 1), "adjacency": a.tolist()} for s, a in enumerate(adjacencies)],
            "markov": {
                "transition": (transition / transition.sum(axis=1, keepdims=True)).tolist(),
                "initial": "1",
            },
        }
    )


NETWORKS: dict[str, Callable[..., Problem]] = {
    "ring-1": partial(random_network, 1, n=3, nx=2, modes=2, arrival=(0.75, 0.95), ring=True),
    "ring-2": partial(random_network, 2, n=3, nx=2, modes=2, arrival=(0.75, 0.95), ring=True),
    "3-states": partial(random_network, 3, n=4, nx=3, modes=3, arrival=(0.75, 0.95)),
    "heavy-loss": partial(random_network, 4, n=4, nx=2, modes=2, arrival=(0.3, 0.5)),
}
PAPER = ["zhu2020-ideal", "zhu2020-lossy"]
PROBLEMS = [*PAPER, "quadruple-tank", "two-nodes", "inverted-pendulum"]
LADDER = [*PAPER, *NETWORKS]


def measure(method: str, name: str, seed: int, budget: float = math.inf) -> dict[str, Any]:
    """One design in a process of its own; `budget`: of processor time, for the method "exact"."""
    child = [sys.executable, "-c", CHILD, method, name, str(seed), str(budget)]
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}  # as the program does
    done = subprocess.run(child, capture_output=True, text=True, check=False, env=environment)
    if done.returncode:
        sys.exit(f"{method}, {name}: {done.stderr.strip().splitlines()[-1]}")
    return dict(json.loads(done.stdout))


def row(method: str, n: int, facts: dict[str, Any]) -> str:
    """One line of the table."""
    numbers = [f"{facts[name]:9.2f}" for name in ("solver", "whole", "cpu", "certify", "verify")]
    lmi = "-" if facts["lmi_gamma"] is None else f"{facts['lmi_gamma']:.6f}"
    sizes = f"{facts['peak']:8.0f} {facts['file']:8.3f} {lmi:>10} {facts['gamma']:10.6f}"
    said = f"{facts['form']}; {facts['status']}, {facts['iterations']} iterations"
    return f"{method:<10} {n:5d} {''.join(numbers)} {sizes}  {said}"


HEAD = (
    "method     nodes  solver s  whole s    cpu s certify s verify s  peak MB  file MB  LMI gamma  certified  P; solver"
)


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


def found_row(name: str) -> str:
    """What the search found of one problem."""
    facts = measure("exact", name, 1)
    lmi, own = (facts["lmi_gamma"], facts["lmi_exact"][1]) if facts["lmi_gamma"] else (math.nan, math.nan)
    before = f"{name:<18}LMI {lmi:.6f}, its gains {own:.6f}"
    return f"{before}; {facts['found']}; floor {facts['floor']:.6g}; {facts['cpu']:.1f} cpu s"


LADDER_HEAD = (
    f"{'network':<15}{'printed':>8}{'Theorem 2':>11}{'its exact':>11}{'consensus':>11}{'designed':>11}{'floor':>11}"
    f"{'against T2':>12}{'cpu s T2':>10}{'cpu s designed':>16}"
)


def ladder_row(name: str, seed: int) -> str:
    """One line of the ladder; Theorem 2 for the reduced state, so that larger networks get their turn."""
    lmi, best = measure("theorem2-reduced", name, seed), measure("exact", name, seed)
    consensus = Computed(network(name, seed=seed)).consensus
    values = [lmi["lmi_gamma"], lmi["exact"] and lmi["exact"][1], consensus, best["gamma"], best["floor"]]
    cells = "".join(f"{'not stable' if value is None else f'{value:.5f}':>11}" for value in values)
    gain = 100.0 * (best["gamma"] / lmi["lmi_gamma"] - 1.0)
    printed = f"{PRINTED[name]:g}" if name in PRINTED else ""
    return f"{name:<15}{printed:>8}{cells}{gain:>10.1f} %{lmi['cpu']:>10.1f}{best['cpu']:>16.1f}"


def main() -> None:
    """Measure and print, line by line."""
    parser = argparse.ArgumentParser(description="What a design costs and what it gives.")
    parser.add_argument("--literal", type=int, nargs="*", default=[4, 8, 12], metavar="NODES")
    parser.add_argument("--decomposed", type=int, nargs="*", default=[4, 8, 12, 25, 50, 100, 200], metavar="NODES")
    parser.add_argument("--exact", type=int, nargs="*", default=[4, 6, 20, 50, 100, 200], metavar="NODES")
    parser.add_argument(
        "--budget", type=float, default=math.inf, metavar="SECONDS", help="for exact, of processor time"
    )
    parser.add_argument("--problems", nargs="*", default=PROBLEMS, choices=PROBLEMS, metavar="NAME")
    parser.add_argument("--networks", nargs="*", default=LADDER, choices=LADDER, metavar="NAME")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    measured: dict[tuple[str, int], dict[str, Any]] = {}
    plan = [("decomposed", n) for n in options.decomposed] + [("theorem2", n) for n in options.literal]
    plan += [("exact", n) for n in options.exact]
    if plan:
        print(HEAD)
    for method, n in plan:
        measured[method, n] = measure(method, f"banded-{n}", options.seed, options.budget)
        print(row(method, n, measured[method, n]), flush=True)
    print("\n".join(summary(measured)))
    for name in options.problems:
        print(found_row(name), flush=True)
    if options.networks:
        print(LADDER_HEAD)
    for name in options.networks:
        print(ladder_row(name, options.seed), flush=True)


if __name__ == "__main__":
    main()
