"""MATLAB's .mat: arrays with a row for each step, and the model that they belong to."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.io import savemat

from agent.contract.arrays import Array
from agent.contract.files import writing_whole
from designer.replay.log import Log


def write_mat(log: Log, output: Path, *, force: bool) -> int:
    """Returns the steps. Modes and nodes are counted from 1, as MATLAB counts."""
    problem, steps = log.gains.problem, log.steps
    ny = [len(node.C) for node in problem.nodes]
    modes = np.where((log.mode >= 0) & (log.mode < len(problem.topologies)), log.mode + 1.0, np.nan)
    members = np.vstack([log.senders.members(), np.full((1, problem.n), np.nan)])  # -1, of a missing message: the last
    content = {
        "run": log.run.get("run", ""),
        "seed": float(log.seed),
        "node_names": _cells(problem.node_names),
        "mode_names": _cells(problem.mode_names),
        "A": problem.plant.A,
        "B": problem.plant.B,
        "M": problem.plant.M,
        "step": np.arange(steps, dtype=float)[:, None],
        "mode": modes[:, None],
        "x": log.x,
        "z": log.z,
        "w": log.w,
        "arrived": log.theta,
        "y": log.y,
        "innovation": log.innovation,
        "y_node": np.repeat(np.arange(1.0, problem.n + 1), ny)[None],
        "x_hat": _by_node(log.x_hat, problem.n),
        "z_hat": _by_node(log.z_hat, problem.n),
        "heard": members[log.heard],
    }
    with writing_whole(output, force=force) as part, part.open("wb") as file:
        savemat(file, content, do_compression=True)
    return steps


def _by_node(stacked: Array, n: int) -> Array:
    """(steps, width, n) from (steps, n width)."""
    return np.asarray(stacked.reshape(len(stacked), n, stacked.shape[1] // n).transpose(0, 2, 1))


def _cells(names: tuple[str, ...]) -> Array:
    cells = np.empty((1, len(names)), dtype=object)
    cells[0, :] = names
    return cells
