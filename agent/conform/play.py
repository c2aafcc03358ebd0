"""A run as everybody makes it, computed in one process by what the roles compute with. Pure."""

from __future__ import annotations

from itertools import islice

import numpy as np

from agent.contract.gains import Gains
from agent.contract.messages import Estimate, Measurement, Mode
from agent.contract.schedule import Deliveries, modes
from agent.estimates import told
from agent.filter import Pair, innovation, step
from agent.roles.plant import SimulatedPlant


class Play:
    """Modes, measurements and estimates of every step, and who is lost to whom: a function of gains and seed."""

    def __init__(self, gains: Gains, *, steps: int, seed: int) -> None:
        self.gains, self.steps, self.seed = gains, steps, seed
        problem = gains.problem
        chain = enumerate(islice(modes(problem, seed=seed), steps))
        self.modes = [Mode(step=k, mode=problem.mode_names[s], index=s) for k, s in chain]
        self.measurements: dict[str, list[Measurement]] = {name: [] for name in problem.node_names}
        self.estimates: dict[str, list[Estimate]] = {name: [] for name in problem.node_names}
        self._deliveries = Deliveries(problem, seed=seed)
        self._perform()

    def lost(self, node: str, k: int) -> set[str]:
        """Whose messages of step k the model loses to a node."""
        names = self.gains.problem.node_names
        delivered = self._deliveries.at(k)[names.index(node)]
        return {name for name, is_delivered in zip(names, delivered, strict=True) if not is_delivered}

    def _perform(self) -> None:
        problem = self.gains.problem
        plant = SimulatedPlant(problem, seed=self.seed, worst_case=self.gains.worst_case)
        owns = {name: self.gains.for_node(name) for name in problem.node_names}
        x_hat = {name: np.zeros(problem.nx) for name in owns}
        mode, heard = "", {name: list[str]() for name in owns}
        for k in range(self.steps):
            _, measured = plant.advance(k)
            pairs = {
                name: Pair(x_hat[name], innovation(own, np.array(measured[name].y), x_hat[name]))
                for name, own in owns.items()
            }
            for name, own in owns.items():
                self.measurements[name].append(measured[name])
                self.estimates[name].append(told(own, k, pairs[name], mode=mode, heard=heard[name]))
            mode = self.modes[k].mode
            for name, own in owns.items():
                lost = self.lost(name, k)
                heard[name] = [link.sender for link in own.links[mode] if link.sender not in lost]
                x_hat[name] = step(own, mode, {sender: pairs[sender] for sender in heard[name]})
