"""Gains whose errors decay slowly: how long the exact gain and its proof take, and how far apart their ends are.

    python benchmarks/slow.py [--only WORD ...] [--limit 300]

Every system in a process of its own. "floats" is the bracket that `exact_gain` finds, "proved" what a certificate has,
each with its CPU seconds and its width, (high - low) / high.
Where gains ignore all measurements, gamma is known by the gramian, and it is said how far above that "proved" ends.
"""

from __future__ import annotations

import argparse
import math
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))

from networks import random_gains, random_problem, real_network

from agent.contract.arrays import Array
from agent.contract.errors import Unattainable
from agent.contract.gains import LinkMatrices
from agent.contract.problem import Problem
from designer.decay import decay
from designer.gain.exact import Gain, Operator, exact_gain
from designer.model.error_model import StackedGains, error_model, link_gains
from designer.search.exact_design import certify
from designer.search.starts import ignoring, least_variance_gains

System = tuple[Problem, StackedGains]
A_MINUTE = {  # a published glucose model, in continuous time: eigenvalues -0.004972, -0.021312, ...
    "A": [
        [0.9950404394361873, 177.6519014605265, 0.007723683012238061, 0.0011653232265738127, 5.576741982551014e-06],
        [0.0, 0.978913495908103, 8.494081238028801e-05, 1.929973345090534e-05, 1.233714040928098e-07],
        [0.0, 0.0, 0.9509707252819385, 0.4365204607892002, 0.0041957022275996994],
        [0.0, 0.0, 0.0, 0.9810575902232501, 0.018761858677055845],
        [0.0, 0.0, 0.0, 0.0, 0.9810575902232501],
    ],
    "B": [
        1.1196247791697457e-06,
        3.1012825805503155e-08,
        0.0014089301675096462,
        0.009441017003002141,
        0.99049860722625,
    ],
}


def plant(A: Array, B: Array, M: Array, *, nodes: int = 2, modes: int = 1, C: Array | None = None) -> Problem:
    """Nodes that measure all states together, each with a noise of its own; losses are hidden."""
    A, B, M = np.asarray(A), np.asarray(B), np.asarray(M)
    nx, nw = B.shape
    names = [f"n{i}" for i in range(nodes)]
    own = np.hstack([np.zeros((nodes, nw)), 0.5 * np.eye(nodes)])
    C = np.ones((1, nx)) if C is None else C
    rng = np.random.default_rng(nodes)
    topologies = []
    for s in range(modes):
        adjacency = (rng.random((nodes, nodes)) < 0.5) * 1.0
        np.fill_diagonal(adjacency, 1.0)
        topologies.append({"name": f"t{s}", "adjacency": adjacency.tolist()})
    return Problem.from_document(
        {
            "name": "slow",
            "plant": {
                "A": A.tolist(),
                "B": np.hstack([B, np.zeros((nx, nodes))]).tolist(),
                "M": M.tolist(),
            },
            "node": [
                {"name": name, "C": C.tolist(), "D": [own[i].tolist()], "arrival_probability": 0.9 - 0.2 * (i % 3)}
                for i, name in enumerate(names)
            ],
            "topology": topologies,
            "markov": {
                "transition": (np.full((modes, modes), 0.4 / modes) + 0.6 * np.eye(modes)).tolist(),
                "initial": "t0",
            },
        }
    )


def turning(*parts: tuple[float, float], **shape: int) -> Problem:
    """States that turn by an angle in each step while they decay."""
    order = 2 * len(parts)
    A, k = np.zeros((order, order)), np.arange(order)
    for i, (radius, angle) in enumerate(parts):
        turn = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
        A[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = radius * np.array(turn)
    return plant(A, np.stack([1.0 + 0.3 * k, 1.0 - 0.5 * k], axis=1), (1.0 - 0.7 * k)[None], **shape)


def scalar(radius: float, **shape: int) -> Problem:
    return plant([[radius]], [[1.0]], [[1.0]], **shape)


def jordan(radius: float, order: int, **shape: int) -> Problem:
    """One eigenvalue, one chain of states."""
    A = radius * np.eye(order) + 0.1 * np.eye(order, k=1)
    return plant(A, np.eye(order)[:, -1:], np.eye(order)[:1], **shape)


def glucose(minutes: float) -> Problem:
    """A chain of five states whose numbers differ by 1e9, sampled each so many minutes; two modes."""
    from scipy.linalg import expm, logm

    held = np.zeros((6, 6))
    held[:5, :5], held[:5, 5] = A_MINUTE["A"], A_MINUTE["B"]
    held[5, 5] = 1.0
    sampled = np.real(expm(np.real(logm(held)) * minutes))
    A = np.triu(sampled[:5, :5])
    return plant(A, sampled[:5, 5:], np.eye(5)[:1], modes=2, C=np.eye(5)[:1])


def scaled_network(seed: int, radius: float, nodes: int, **real: bool) -> Problem:
    """A random network, whose plant has this spectral radius."""
    return real_network(random_problem(seed, n=nodes), radius=radius, **real)


def unstable_but(seed: int, radius: float, nodes: int) -> System:
    """Random gains by such a part of themselves that L has this radius: losses and the chain act on what is slow."""
    problem = random_problem(seed, n=nodes)
    K, H = random_gains(problem, seed)

    def of(part: float) -> float:
        model = error_model(problem, part * K, part * H)
        operator = Operator(model)
        return decay(operator.corner, model.modes, operator.units, model.moves).radius

    low, high = 0.1, 10.0
    for _ in range(60):
        middle = math.sqrt(low * high)
        low, high = (middle, high) if of(middle) < radius else (low, middle)
    return problem, (low * K, low * H)


def ignored(problem: Problem) -> System:
    return problem, ignoring(problem)


def least(problem: Problem) -> System:
    return problem, least_variance_gains(problem)


SYSTEMS: dict[str, Callable[[], System]] = {
    "ignored 0.9": lambda: ignored(scalar(0.9)),
    "ignored 0.99": lambda: ignored(scalar(0.99)),
    "ignored 0.9999": lambda: ignored(scalar(0.9999)),
    "ignored 0.999999": lambda: ignored(scalar(0.999999)),
    "ignored 0.9999999": lambda: ignored(scalar(0.9999999)),
    "ignored, turns by 0.01, 0.9999": lambda: ignored(turning((0.9999, 0.01))),
    "ignored, turn by 1.5 and 0.05, 0.9999 and 0.999": lambda: ignored(turning((0.9999, 1.5), (0.999, 0.05))),
    "ignored, Jordan block of 3, 0.999": lambda: ignored(jordan(0.999, 3)),
    "ignored, 20 nodes of 4 states, 0.9999": lambda: ignored(turning((0.9999, 0.1), (0.99, 1.0), nodes=20, modes=2)),
    "ignored, glucose 60 s": lambda: ignored(glucose(1.0)),
    "ignored, glucose 6 s": lambda: ignored(glucose(0.1)),
    "ignored, glucose 0.5 s": lambda: ignored(glucose(0.5 / 60.0)),
    "glucose 60 s": lambda: least(glucose(1.0)),
    "glucose 6 s": lambda: least(glucose(0.1)),
    "turn by 1.5 and 0.05, 0.9999 and 0.999": lambda: least(turning((0.9999, 1.5), (0.999, 0.05))),
    "turn by 0.2 and 0.21, 0.999 and 0.9995, 3 nodes": lambda: least(turning((0.999, 0.2), (0.9995, 0.21), nodes=3)),
    "Jordan block of 2, 0.9999": lambda: least(jordan(0.9999, 2)),
    "3 nodes, 0.99999": lambda: least(scaled_network(11, 0.99999, 3)),
    "4 nodes, seen losses, 0.9999": lambda: least(scaled_network(5, 0.9999, 4, seen=True)),
    "8 nodes, 0.999": lambda: least(scaled_network(3, 0.999, 8)),
    "8 nodes, 0.99999": lambda: least(scaled_network(3, 0.99999, 8)),
    "20 nodes, 0.9999": lambda: least(scaled_network(2, 0.9999, 20)),
    "random gains of 3 nodes, L 0.9999": lambda: unstable_but(1, 0.9999, 3),
    "random gains of 6 nodes, L 0.9999": lambda: unstable_but(2, 0.9999, 6),
}


def measured(name: str) -> str:
    """A line of the table."""
    problem, gains = SYSTEMS[name]()
    K, H = link_gains(problem, *gains)
    model = error_model(problem, *gains)
    modes, n = model.modes, model.size
    started = time.process_time()
    gain = exact_gain(model)
    found = time.process_time() - started
    line = f"| {name} | {modes * n * (n + 1) // 2} | {found:.1f} | {width(gain.low, gain.high)} |"
    started = time.process_time()
    proved = _certified(problem, K, H, gain)
    line += f" {time.process_time() - started:.1f} | {width(*proved)} |"
    if name.startswith("ignored") and proved[1] < math.inf:
        line += f" {proved[1] / by_gramian(problem) - 1.0:.1e} |"
    return line


def _certified(problem: Problem, K: LinkMatrices, H: LinkMatrices, gain: Gain) -> tuple[float, float]:
    try:
        certificate = certify(problem, K, H, gain=gain)
    except Unattainable as error:
        print(error, file=sys.stderr)
        return 0.0, math.inf
    return certificate.exact or (0.0, certificate.gamma)


def width(low: float, high: float) -> str:
    return "none" if math.isinf(high) else f"{(high - low) / high:.1e}"


def by_gramian(problem: Problem) -> float:
    """The gain of a plant that nobody measures, by doubling in long doubles."""
    A, B, M = (np.asarray(each, dtype=np.longdouble) for each in (problem.plant.A, problem.plant.B, problem.plant.M))
    gramian, power = B @ B.T, A
    for _ in range(60):
        gramian, power = gramian + power @ gramian @ power.T, power @ power
    largest = np.linalg.eigvalsh(np.asarray(M @ gramian @ M.T, dtype=np.float64)).max()
    return math.sqrt(float((problem.weights**2).sum() * largest))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="*", default=[""], help="systems whose names have one of these words")
    parser.add_argument("--limit", type=float, default=300.0, help="seconds for each (300)")
    parser.add_argument("--here", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.here is not None:
        print(measured(options.here))
        return
    print("| system | entries of Y | floats, CPU s | width | proof, CPU s | width | above the gramian |")
    print("|---|---|---|---|---|---|---|")
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    for name in (name for name in SYSTEMS if any(word in name for word in options.only)):
        command = [sys.executable, __file__, "--here", name]
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=options.limit, env=environment)
        except subprocess.TimeoutExpired:
            print(f"| {name} | | over {options.limit:g} s | | | | |", flush=True)
            continue
        print(done.stdout.strip() or f"| {name} | {done.stderr.strip().splitlines()[-1]} |", flush=True)
        if done.stdout and done.stderr:
            print(f"    {done.stderr.strip().splitlines()[-1]}", flush=True)


if __name__ == "__main__":
    main()
