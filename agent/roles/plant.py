"""The simulated plant: eqs. (1)-(3), one step for every mode that the coordinator gives out."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from pydantic import ValidationError

from agent.contract.arrays import Array
from agent.contract.errors import RunBroken
from agent.contract.gains import Gains
from agent.contract.keys import MODE, PLANT, PLANT_STATE, measurement
from agent.contract.messages import CEILING, Control, Measurement, PlantState, beyond_ceiling
from agent.contract.problem import Problem
from agent.contract.problem.parts import Node
from agent.contract.schedule import DisturbanceSource, Losses
from agent.faults import Ordeal, parse
from agent.guard import UNTIMELY
from agent.network.bus import Bus
from agent.product import product
from agent.roles.joining import take_part
from agent.roles.suffering import suffer

Dynamics = Callable[[Array, Array], Array]  # x(k + 1) of x(k) and w(k)


def run(bus: Bus, gains: Gains, *, dynamics: Dynamics | None = None) -> None:
    """Take part as the plant until the run has ended; `dynamics` stands in place of eq. (1)."""
    problem = gains.problem
    SimulatedPlant(problem, seed=0, worst_case=gains.worst_case)  # where a worst case is lacking, say so before the run
    modes = bus.channel(MODE)
    bus.advertise([PLANT_STATE, *map(measurement, problem.node_names)])

    def work(start: Control) -> None:
        plant = SimulatedPlant(problem, seed=start.seed, worst_case=gains.worst_case, dynamics=dynamics)
        faults = [parse(text, problem, steps=start.steps) for text in start.faults]
        ordeal = Ordeal(faults, PLANT, begin=start.step, again=bus.is_late)
        if start.period:
            bus.trace()
        while True:
            step = first = modes.next().message.step
            if not start.period and step != plant.step:
                bus.guard.refuse(MODE, UNTIMELY)
                continue
            if start.period:
                if step < max(plant.step, start.step):
                    continue  # a coordinator that has come back gives out again what the recorder has not got
                suffer(ordeal.due(step))
                if plant.step or not start.step:
                    first = plant.step  # whose mode may have gone with the coordinator: late is better than never
                plant.skip_to(first)
                bus.step = step + 1
            for k in range(first, step + 1):
                state, measurements = plant.advance(k)
                for name, y in measurements.items():
                    if name not in start.external:
                        bus.publish(measurement(name), y)
                bus.publish(PLANT_STATE, state)

    take_part(bus, gains, work)


class SimulatedPlant:
    """x(k) from the initial error, and what every sensor delivers of it."""

    def __init__(
        self,
        problem: Problem,
        *,
        seed: int,
        worst_case: Array | None = None,
        dynamics: Dynamics | None = None,
    ) -> None:
        self._problem = problem
        self._dynamics = dynamics if dynamics is not None else self._linear
        self._losses = Losses(problem, seed=seed)
        self._disturbance = DisturbanceSource(problem, seed=seed, worst_case=worst_case)
        self._x = problem.initial_error
        self.step = 0  # the next one

    def skip_to(self, step: int) -> None:
        """Let the steps before `step` pass, of which no mode came: the plant goes on, seen or not."""
        while self.step < step:
            self.advance(self.step)

    def advance(self, step: int) -> tuple[PlantState, dict[str, Measurement]]:
        """The messages of step `step`; the steps must be asked for one after the other, or RunBroken is raised."""
        if step != self.step:
            raise RunBroken(f"the mode of step {step} came where that of step {self.step} was due")
        try:
            with np.errstate(over="ignore", invalid="ignore"):
                state, measurements = self._advance(step)
        except ValidationError:  # a message refuses NaN and infinity
            state = None
        if state is None or beyond_ceiling(state.x, state.z, state.w, *(sent.y for sent in measurements.values())):
            raise RunBroken(f"the state of the plant is beyond {CEILING:g} at step {step}; its A lets it grow")
        return state, measurements

    def _advance(self, step: int) -> tuple[PlantState, dict[str, Measurement]]:
        plant, x = self._problem.plant, self._x
        w, theta = self._disturbance.at(step), self._losses.at(step)
        state = PlantState(
            step=step,
            x=x.tolist(),
            z=product(plant.M, x).tolist(),
            w=w.tolist(),
            arrived=[int(arrived) for arrived in theta],
        )
        measurements = {
            node.name: Measurement(step=step, y=_measured(node, theta_i, x, w).tolist())
            for node, theta_i in zip(self._problem.nodes, theta, strict=True)
        }
        self._x = self._dynamics(x, w)
        self.step += 1
        return state, measurements

    def _linear(self, x: Array, w: Array) -> Array:
        """Eq. (1), A x + B w."""
        return product(self._problem.plant.A, x) + product(self._problem.plant.B, w)


def _measured(node: Node, theta_i: float, x: Array, w: Array) -> Array:
    """Eq. (2): theta_i C_i x + D_i w, (ny_i,); empty where a node that sees its losses loses this one."""
    if node.seen and not theta_i:
        return np.empty(0)
    return theta_i * product(node.C, x) + product(node.D, w)
