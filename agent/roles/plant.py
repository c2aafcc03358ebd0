"""The simulated plant: eqs. (1)-(3), one step for every mode that the coordinator gives out."""

from __future__ import annotations

import numpy as np

from agent.bus import Bus, Sample
from agent.contract.gains import Gains
from agent.contract.messages import MODE, PLANT_STATE, Measurement, Mode, PlantState, measurement
from agent.contract.problem import Problem
from agent.contract.schedule import DisturbanceSource, Losses
from agent.roles.joining import join


def run(bus: Bus, gains: Gains) -> None:
    """Take part as the plant until the run is closed (Bus.receive raises RunClosed)."""
    problem = gains.problem
    bus.subscribe([MODE])
    bus.advertise([PLANT_STATE, *map(measurement, problem.node_names)])
    start = join(bus, gains)
    plant = SimulatedPlant(problem, seed=start.seed)
    simulated = [name for name in problem.node_names if name not in start.external]
    while True:
        for item in bus.receive():
            if not isinstance(item, Sample):
                continue
            step = Mode.decode(item.payload).step
            state, measurements = plant.advance(step)
            for name in simulated:
                bus.publish(measurement(name), measurements[name])
            bus.publish(PLANT_STATE, state)


class SimulatedPlant:
    """x(k) from zero, and what every sensor delivers of it."""

    def __init__(self, problem: Problem, *, seed: int) -> None:
        self._problem = problem
        self._losses = Losses(problem, seed=seed)
        self._disturbance = DisturbanceSource(problem, seed=seed)
        self._x = np.zeros(problem.nx)
        self._step = 0

    def advance(self, step: int) -> tuple[PlantState, dict[str, Measurement]]:
        """The messages of step `step`; the steps must be asked for one after the other."""
        assert step == self._step
        plant, x = self._problem.plant, self._x
        w, theta = self._disturbance.at(step), self._losses.at(step)
        state = PlantState(
            step=step,
            x=x.tolist(),
            z=(plant.M @ x).tolist(),
            w=w.tolist(),
            arrived=[int(arrived) for arrived in theta],
        )
        measurements = {
            node.name: Measurement(step=step, y=(theta_i * (node.C @ x) + node.D @ w).tolist())
            for node, theta_i in zip(self._problem.nodes, theta, strict=True)
        }
        self._x = plant.A @ x + plant.B @ w
        self._step += 1
        return state, measurements
