"""How gains of large networks are found and proved, part by part: tables of docs/theory.md, measured anew.

    python benchmarks/scale.py [--nodes 20 25 50 100 200] [--seed 1] [--budget SECONDS] [--part 0.01]

The networks are `banded` of benchmarks/design.py, and every number of seconds is processor time of one core. Of each
network: gains of least variance and their proof, by floats and, up to 20 nodes, by balls; windows, where there are
more than one; a gradient of the search over 20 steps; the search from gains of least variance, for each node at most
`--budget` seconds; and the proof of what it chose. Searches are compared where they are equally near to their own ends:
where gamma in hand has come within `--part` of the last, for good. The start is counted.
"""

from __future__ import annotations

import argparse
import math
import os
import resource
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import TypeVar

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the program does

import numpy as np
from design import banded

from agent.contract.gains import LinkMatrices
from agent.contract.problem import Problem
from designer.gain.exact import exact_gain
from designer.model.error_model import StackedGains, error_model, link_gains
from designer.patience import Budget
from designer.proof.findings import Verdict
from designer.proof.prover import BALLS, FLOATS, Make, Prover
from designer.search.barrier import Barrier
from designer.search.descent import Progress, descend
from designer.search.starts import least_variance_gains
from designer.search.windows import WEIGHT, window_gains, windows

BY_BALLS = 20  # nodes
GRADIENTS, HORIZON = 5, 20
Made = TypeVar("Made")


def main() -> None:
    """Measure and print, line by line."""
    parser = argparse.ArgumentParser(description="How gains of large networks are found and proved, part by part.")
    parser.add_argument("--nodes", type=int, nargs="+", default=[20, 25, 50, 100, 200])
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--budget", type=float, default=math.inf, metavar="SECONDS", help="of a search, for each node")
    parser.add_argument("--part", type=float, default=0.01, help="above the last gamma, where searches are compared")
    options = parser.parse_args()
    near = [measure(n, options.seed, options.budget, options.part) for n in options.nodes]
    if len(near) > 1:
        power = np.polyfit(np.log(options.nodes), np.log(near), 1)[0]
        print(f"to within {options.part:.1%} of the last gamma the time grows as nodes^{power:.2f} (least squares)")


def measure(n: int, seed: int, budget: float, part: float) -> float:
    """All of one network; returns the seconds until its search is near its end."""
    problem = banded(n, seed=seed)
    print(f"banded-{n}, seed {seed}", flush=True)
    start, starting = timed(lambda: least_variance_gains(problem))
    say(f"least variance: {starting:.2f} s; {proof(problem, start)}")
    if len(windows(problem)) > 1:
        windowed, seconds = timed(lambda: one_core(lambda: window_gains(problem, start, budget=Budget()).gains))
        say(f"windows: {seconds:.1f} s; exact gain {exact_gain(error_model(problem, *windowed)).high:.6f}")
    say(f"a gradient over {HORIZON} steps: {1e3 * gradient(problem, start):.1f} ms")
    seen: list[Progress] = []
    clock = Budget(n * budget, clock=time.process_time)
    found = descend(problem, {"least variance": start}, budget=clock, progress=seen.append)
    steps = [at for at in seen if at.phase is None]
    last, far = steps[-1], [at.seconds for at in steps if at.gamma > (1.0 + part) * steps[-1].gamma]
    near = starting + max(far, default=0.0)
    say(f"search: {clock.spent:.1f} s, {found.steps} steps, {found.ended} at mu = {last.mu:g}, T = {last.horizon}")
    say(f"near its end, gamma in hand {last.gamma:.6f}, after {near:.1f} s with the start")
    say(f"chosen: {proof(problem, found.chosen[:2])}")
    say(f"most memory so far: {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB")
    return near


def proof(problem: Problem, gains: StackedGains) -> str:
    """The exact gain, and how long it takes to prove it as it is."""
    found, seconds = timed(lambda: exact_gain(error_model(problem, *gains)))
    said = f"exact gain {found.high:.6f} (radius {found.radius:.3f}) in {seconds:.2f} s"
    links = link_gains(problem, *gains)
    for name, makes in (("floats", FLOATS), ("balls", BALLS[:1])):
        if name == "floats" or problem.n <= BY_BALLS:
            verdict, seconds = timed(partial(proved, problem, links, makes, found.high))
            said += f", {'proved' if verdict.holds else 'NOT proved'} by {name} in {seconds:.2f} s"
    return said


def proved(problem: Problem, links: tuple[LinkMatrices, LinkMatrices], makes: Sequence[Make], gamma: float) -> Verdict:
    """Gains are made into matrices of the proof's arithmetic, P is found: everything from the gains on."""
    return Prover(problem, *links, makes=makes).exact(gamma)


def gradient(problem: Problem, start: StackedGains) -> float:
    """Seconds that J and its derivative take at the start of a search."""
    barrier = Barrier(problem, HORIZON)
    v = barrier.entries.pack(*start)
    g = 2.0 * exact_gain(barrier.model(v)).high ** 2
    J, x = barrier.descent(WEIGHT), np.append(v, math.log(g))
    return min(timed(lambda: J(x))[1] for _ in range(GRADIENTS))


def one_core(work: Callable[[], Made]) -> Made:
    """Without other processes, whose time would not be counted."""
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(cores)})
    try:
        return work()
    finally:
        os.sched_setaffinity(0, cores)


def timed(work: Callable[[], Made]) -> tuple[Made, float]:
    """And the seconds of processor time that it takes."""
    begun = time.process_time()
    return work(), time.process_time() - begun


def say(what: str) -> None:
    print(f"    {what}", flush=True)


if __name__ == "__main__":
    main()
