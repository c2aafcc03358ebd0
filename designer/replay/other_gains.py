"""What would other gains have done in a recorded run?

They run centrally, by (10) from step 0, on what was recorded: modes, losses, deliveries and disturbance, or where
sensors of their own gave the measurements, these. The nodes' arithmetic has no part in it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agent.contract.arrays import Array
from agent.contract.gains import LinkMatrices
from designer.replay.central import Central
from designer.replay.free_run import complete, free_run
from designer.replay.inputs import Inputs, draw, logged_inputs, logged_plant
from designer.replay.log import Log

_STEPS_AT_ONCE = 256


@dataclass(frozen=True)
class Sizes:
    """How large a signal z~ is that every node has its part of; infinite or NaN where it grew beyond float64."""

    peak: float  # the largest |z~(k)| over all nodes
    step: int  # where it is, -1 where no step is known
    energy: float  # sum over k of |z~(k)|^2
    rms: tuple[float, ...]  # of each node: the root of the mean over k of |z~_i(k)|^2; NaN where no step is known

    @classmethod
    def of(cls, signal: Array, known: NDArray[np.bool_]) -> Sizes:
        """Of (steps, n, nz), over the steps of each node that are `known`, (steps, n); the peak where all are."""
        squares = np.where(known, (signal**2).sum(axis=2), 0.0)
        norms = np.where(known.all(axis=1), np.sqrt(squares.sum(axis=1)), -1.0)
        beyond = np.flatnonzero(np.isnan(norms))
        step = int(beyond[0]) if len(beyond) else int(norms.argmax()) if len(norms) else -1
        if step >= 0 and norms[step] == -1.0:
            step = -1
        counts = known.sum(axis=0)
        rms = np.sqrt(np.where(counts > 0, squares.sum(axis=0) / np.maximum(counts, 1), np.nan))
        return cls(float(norms[step]) if step >= 0 else math.nan, step, float(squares.sum()), tuple(rms.tolist()))

    def document(self) -> dict[str, Any]:
        """For --json; None for what is no finite number."""
        peak, energy, *rms = (value if math.isfinite(value) else None for value in (self.peak, self.energy, *self.rms))
        return {"peak": peak, "peak_step": self.step, "error_energy": energy, "rms": rms}


@dataclass(frozen=True)
class OtherGains:
    """The errors of the recorded gains beside those of others; None where no plant was simulated."""

    source: str
    node_names: tuple[str, ...]
    recorded: Sizes | None
    other: Sizes | None
    apart: Sizes  # z_hat of the one less that of the other
    energy: float | None  # sum over k of |w(k)|^2, the same for both; None where it is not known

    def document(self) -> dict[str, Any]:
        """For --json."""
        return {
            "gains": self.source,
            "nodes": list(self.node_names),
            "recorded": self.recorded.document() if self.recorded else None,
            "other": self.other.document() if self.other else None,
            "apart": self.apart.document(),
            "energy": self.energy,
        }

    def text(self) -> str:
        rows: list[tuple[str, float, float]] = []
        if self.recorded is not None and self.other is not None:
            one, two = self.recorded, self.other
            rows.append((f"peak |z~|, at steps {one.step} and {two.step}", one.peak, two.peak))
            rows.append(("sum of |z~|^2", one.energy, two.energy))
            rms = zip(self.node_names, one.rms, two.rms, strict=True)
            rows += [(f'rms of z~ of node "{name}"', before, after) for name, before, after in rms]
        width = max([24, *(len(name) for name, _, _ in rows)]) + 2
        lines = [f"what if {self.source} had run, on the recorded modes, losses, deliveries and disturbance"]
        if rows:
            lines.append(f"{'':{width}}{'recorded':>12}{'other':>12}")
            lines += [
                f"{name:{width}}{before:12.5g}{after:12.5g}{_change(before, after)}" for name, before, after in rows
            ]
            if self.energy is not None:
                lines.append(f"{'sum of |w|^2':{width}}{self.energy:12.5g}{self.energy:12.5g}")
            return "\n".join(lines)
        lines += ["no simulated plant: nothing is known of the error, but how far the estimates z_hat are apart"]
        apart = zip(self.node_names, self.apart.rms, strict=True)
        return "\n".join(lines + [f'rms of node "{name}": {size:.5g}' for name, size in apart])


def run_other(log: Log, K: LinkMatrices, H: LinkMatrices, *, source: str) -> OtherGains:
    """Run gains for the links of the recorded problem in place of the recorded ones, over the steps of the log.

    A step where a message is missing counts for neither. `source` says where the gains are from.
    """
    problem = log.gains.problem
    central = Central.of_links(problem, K, H)
    drawn = draw(log, central)
    shape = log.steps, problem.n, problem.nz
    with np.errstate(over="ignore", invalid="ignore"):  # gains may let the errors grow without end
        inputs = complete(logged_inputs(log, central, drawn), drawn, log, central)
        recorded, other = log.z_hat.reshape(shape), _estimates(log, central, inputs).reshape(shape)
        said = np.asarray(np.isfinite(recorded).all(axis=2))
        apart = Sizes.of(recorded - other, said)
        if not log.is_simulated:
            return OtherGains(source, problem.node_names, None, None, apart, None)
        z = log.z[:, None]
        known = np.asarray(said & np.isfinite(z).all(axis=2))
        energy = float((inputs.w**2).sum()) if log.has_plant else None
        one, two = Sizes.of(z - recorded, known), Sizes.of(z - other, known)
        return OtherGains(source, problem.node_names, one, two, apart, energy)


def _estimates(log: Log, central: Central, inputs: Inputs) -> Array:
    """z_hat_i(k) = M (x(k) - e_i(k)) of all nodes, (steps, n, nz)."""
    n, nx, p = central.problem.n, central.problem.nx, central.model.plant_states
    x_hat = np.empty((log.steps, n, nx))
    for part in free_run(log, central, inputs, block=_STEPS_AT_ONCE):
        now = slice(part.first, part.first + len(part.eta))
        x = part.x if log.has_plant else logged_plant(log)[now]
        x_hat[now] = x[:, None] - part.eta[:, p:].reshape(-1, n, nx)
    return np.asarray(x_hat @ central.problem.plant.M.T)


def _change(before: float, after: float) -> str:
    return f"{after / before - 1.0:+12.1%}" if before > 0.0 and math.isfinite(after) else ""
