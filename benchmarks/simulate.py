"""How fast an ensemble is simulated, beside one run after the other in plain Python.

    python benchmarks/simulate.py [--runs 10000] [--steps 200] [--reference 20]

The gains are the golden ones of the paper's second example. The reference is a loop over runs, steps and nodes with
the runtime's own plant, innovation and step; both give the same errors, which is checked. One process; processor
time, since others may share the machine.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from agent import filter as node
from agent.contract import schedule
from agent.contract.gains import Gains
from agent.roles.plant import SimulatedPlant
from designer.simulation import network_of, simulate, states

GAINS = Path(__file__).parents[1] / "recordings" / "golden" / "zhu2020-lossy.gains.json"


def one_by_one(gains: Gains, *, runs: int, steps: int) -> np.ndarray:
    """|z_tilde(k)|^2 of every run and step, (runs, steps), as the runtime computes it."""
    problem, sizes = gains.problem, np.empty((runs, steps))
    slices = {name: gains.for_node(name) for name in problem.node_names}
    hears = [
        {name: [problem.node_names[j] for j in problem.neighbours(s, i)] for i, name in enumerate(problem.node_names)}
        for s in range(len(problem.topologies))
    ]
    for seed in range(runs):
        plant, chain = SimulatedPlant(problem, seed=seed), schedule.modes(problem, seed=seed)
        x_hat = {name: np.zeros(problem.nx) for name in slices}
        for k in range(steps):
            state, measured = plant.advance(k)
            z = np.array(state.z)
            sizes[seed, k] = sum(float(((z - own.M @ x_hat[name]) ** 2).sum()) for name, own in slices.items())
            pairs = {
                name: node.Pair(x_hat[name], node.innovation(own, np.array(measured[name].y), x_hat[name]))
                for name, own in slices.items()
            }
            s = next(chain)
            mode = problem.mode_names[s]
            x_hat = {
                name: node.step(own, mode, {other: pairs[other] for other in hears[s][name]})
                for name, own in slices.items()
            }
    return sizes


def largest_difference(gains: Gains, sizes: np.ndarray) -> float:
    """Between |z_tilde(k)| of these runs and of the same runs of an ensemble."""
    runs, steps = sizes.shape
    network, difference = network_of(gains, steps=steps), 0.0
    for k, state in enumerate(states(network, range(runs), steps=steps)):
        z_tilde = state.e.reshape(-1, gains.problem.nx) @ network.M.T
        size = np.sqrt((z_tilde**2).reshape(runs, -1).sum(axis=1))
        difference = max(difference, float(np.abs(size - np.sqrt(sizes[:, k])).max()))
    return difference


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=10_000)
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--reference", type=int, default=20, help="runs of the reference (20)")
    options = parser.parse_args()
    gains = Gains.load(GAINS)

    began = time.process_time()
    sizes = one_by_one(gains, runs=options.reference, steps=options.steps)
    reference = options.reference * options.steps / (time.process_time() - began)
    assert largest_difference(gains, sizes) < 1e-12

    print(f"{gains.problem.name}, {options.steps} steps, one process\n")
    print("| runs | processor seconds | runs x steps per second | of one run after the other |")
    print("|---|---|---|---|")
    seconds = options.reference * options.steps / reference
    print(f"| {options.reference}, one after the other | {seconds:.2f} | {reference:,.0f} | 1 |")
    for runs in sorted({100, 1000, options.runs}):
        wall, began = time.perf_counter(), time.process_time()
        ensemble = simulate(gains, runs=runs, steps=options.steps, processes=1)
        seconds, wall = time.process_time() - began, time.perf_counter() - wall
        rate = runs * options.steps / seconds
        print(f"| {runs} | {seconds:.2f} | {rate:,.0f} | {rate / reference:,.0f} |")
    print(f"\nthe last took {wall:.1f} s by the clock; root mean square at its peak {ensemble.mean.max() ** 0.5:.6f}")


if __name__ == "__main__":
    main()
