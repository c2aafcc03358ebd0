"""What of a run is the user's: nodes, sensors, the plant, each a function in a thread of this process, or a command."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from agent.contract.gains import Gains, NodeGains
from agent.contract.keys import PLANT, in_words, node_who, sensor_who
from peakmesh import sensors as sensing

Array = NDArray[np.float64]
Filter = Callable[[str, dict[str, tuple[Array, Array]]], ArrayLike]  # x_hat(k + 1) of the mode, and of pairs by node
Dynamics = Callable[[Array, Array], ArrayLike]  # x(k + 1) of x(k) and w(k)
Command = str | Sequence[str]
ELSEWHERE: Command = ()  # somebody else starts it


class Actor(Protocol):
    """A function that takes part."""

    def failure(self) -> str | None:
        """Why it takes part no more; None where it does, or has ended well."""

    def close(self) -> None:
        """End it, if it has not ended."""


class Cast:
    """What of a run is the user's. Its functions take part from `start` on; `commands` are for who starts the rest."""

    def __init__(
        self,
        gains: Gains,
        *,
        nodes: Mapping[str, Filter | Command],
        sensors: Mapping[str, sensing.Measure | Command],
        plant: Dynamics | Command | None,
    ) -> None:
        for name in (*nodes, *sensors):
            gains.problem.node_index(name)
        self._gains, self._actors = gains, dict[str, Actor]()
        self._nodes = {name: source for name, source in nodes.items() if callable(source)}
        self._sensors = {name: source for name, source in sensors.items() if callable(source)}
        self._plant = plant if callable(plant) else None
        self.commands: dict[str, Any] = {
            "nodes": {name: ELSEWHERE if callable(source) else source for name, source in nodes.items()},
            "sensors": {name: ELSEWHERE if callable(source) else source for name, source in sensors.items()},
            "plant": ELSEWHERE if callable(plant) else plant,
        }

    def start(self, *, run: str, address: str, wait: float, deadline: float) -> None:
        """Have the functions take part in a run whose coordinator listens at `address`."""
        from agent.within import Where, Within

        gains, where = self._gains, Where(run, address, wait, deadline)
        for name, function in self._nodes.items():
            self._actors[node_who(name)] = Within.node(name, _step(function, gains.problem.nx), gains, where)
        if self._plant is not None:
            self._actors[PLANT] = Within.plant(_dynamics(self._plant, gains.problem.nx), gains, where)
        for name, measure in self._sensors.items():
            self._actors[sensor_who(name)] = sensing.Sensor(measure, run=run, node=name, address=address)

    def failures(self) -> str:
        """Which functions have failed, and why; "" where none has."""
        found = {who: actor.failure() for who, actor in self._actors.items()}
        return "; ".join(f"{in_words(who)} failed: {why}" for who, why in found.items() if why)

    def close(self) -> None:
        """End whatever has not ended."""
        for actor in self._actors.values():
            actor.close()
        self._actors.clear()


def _step(function: Filter, nx: int) -> Callable[[NodeGains, str, Mapping[str, Any]], Array]:
    def step(own: NodeGains, mode: str, heard: Mapping[str, Any]) -> Array:
        return _vector(function(mode, {name: (x.copy(), nu.copy()) for name, (x, nu) in heard.items()}), nx)

    return step


def _dynamics(function: Dynamics, nx: int) -> Callable[[Array, Array], Array]:
    return lambda x, w: _vector(function(x.copy(), w.copy()), nx)


def _vector(answer: ArrayLike, nx: int) -> Array:
    vector = np.array(answer, dtype=np.float64)
    if vector.shape != (nx,):
        raise ValueError(f"it returned an array of shape {vector.shape}; a state has shape ({nx},)")
    if not np.isfinite(vector).all():
        raise ValueError(f"it returned {vector.tolist()}; a state has finite numbers")
    return vector
