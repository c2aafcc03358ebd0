"""Figures 2 to 6 of Zhu et al. 2020, of one run of each example with the gains of Theorem 2.

The paper does not say which run it shows; here it is that of one seed, the same for both examples, so that both have
the modes of figure 2.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from agent.contract import schedule
from agent.contract.arrays import Array
from agent.contract.gains import Gains
from agent.contract.problem import Problem
from designer.model.error_model import error_model, stacked_gains, step
from designer.replay.topics import Numbers
from designer.report.chart import Chart
from designer.report.pictures import errors, modes, outputs

STEPS, SEED = 50, 0
NAMES = tuple(f"figure-{number}" for number in range(2, 7))


class Run(NamedTuple):
    """One run, computed with the centralised error model."""

    problem: Problem
    mode: Numbers  # (steps,)
    z: Array  # (steps, nz)
    z_tilde: Array  # (steps, n, nz)


def run(gains: Gains, *, steps: int = STEPS, seed: int = SEED) -> Run:
    """Eqs. (1) and (10) from x = 0 and e = 0, with the draws of a live run of this seed."""
    problem, plant = gains.problem, gains.problem.plant
    model, chain = error_model(problem, *stacked_gains(gains)), schedule.modes(problem, seed=seed)
    losses, deliveries = schedule.Losses(problem, seed=seed), schedule.Deliveries(problem, seed=seed)
    disturbance = schedule.DisturbanceSource(problem, seed=seed, worst_case=gains.worst_case)
    mode = np.array([next(chain) for _ in range(steps)], dtype=np.int64)
    z, z_tilde = np.empty((steps, problem.nz)), np.empty((steps, problem.n, problem.nz))
    x, eta = np.zeros(problem.nx), np.zeros(model.size)
    for k in range(steps):
        z[k], z_tilde[k] = plant.M @ x, (model.M @ eta).reshape(problem.n, -1)
        w = disturbance.at(k)
        eta = step(model, int(mode[k]), losses.at(k), eta, w, deliveries.at(k))
        x = plant.A @ x + plant.B @ w
    return Run(problem, mode, z, z_tilde)


def charts(example_1: Gains, example_2: Gains) -> dict[str, Chart]:
    """By their `NAMES`."""
    ideal, lossy = run(example_1), run(example_2)
    found = [
        modes(lossy.problem, lossy.mode),
        _outputs(ideal),
        _outputs(lossy),
        errors(ideal.problem, ideal.z_tilde)[0],
        errors(lossy.problem, lossy.z_tilde)[0],
    ]
    return dict(zip(NAMES, found, strict=True))


def _outputs(of: Run) -> Chart:
    z_hat = of.z[:, None, :] - of.z_tilde
    return outputs(of.problem, of.z, z_hat.reshape(len(z_hat), -1))[0]
