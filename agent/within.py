"""A role in a thread of this process, with a function in place of what it computes: for a library, not for a device."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import suppress
from typing import NamedTuple

from agent.contract.errors import PeakmeshError, RunBroken
from agent.contract.gains import Gains
from agent.contract.keys import PLANT, node_who
from agent.contract.sizes import largest
from agent.filter import Step
from agent.network.addresses import NONE
from agent.network.bus import Bus
from agent.network.configuration import Network
from agent.roles import node, plant
from agent.roles.plant import Dynamics

LEAST_LEASE = 10.0  # s, as for the roles that are processes
PATIENCE = 60.0  # seconds for a thread to end; one that computes for ever nobody can end


class Where(NamedTuple):
    """A run, the address of its coordinator, and how many seconds to wait there."""

    run: str
    address: str
    wait: float
    deadline: float


class Within:
    """Takes part as a client of the coordinator, until the run has ended or it is closed."""

    def __init__(self, who: str, role: Callable[[Bus], None], gains: Gains, where: Where) -> None:
        """`who` takes part by `role`."""
        self._who, self._role, self._run = who, role, where.run
        lease = max(LEAST_LEASE, 2.0 * where.deadline)
        self._network = Network(NONE, (where.address,), where.wait, lease=lease, largest=largest(gains.problem))
        self._bus: Bus | None = None
        self._is_closed = False
        self._lock = threading.Lock()  # of the two above
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._play, name=who, daemon=True)
        self._thread.start()

    @classmethod
    def node(cls, name: str, step: Step, gains: Gains, where: Where) -> Within:
        """Node `name`, with another filter."""
        return cls(node_who(name), lambda bus: node.run(bus, gains, node=name, step=step), gains, where)

    @classmethod
    def plant(cls, dynamics: Dynamics, gains: Gains, where: Where) -> Within:
        """The plant, with other dynamics."""
        return cls(PLANT, lambda bus: plant.run(bus, gains, dynamics=dynamics), gains, where)

    def failure(self) -> str | None:
        """What the function has raised; None where it has not. That the run was stopped is no failure."""
        return None if self._error is None else f"{type(self._error).__name__}: {self._error}"

    def close(self) -> None:
        """End it, if it has not ended."""
        with self._lock:
            self._is_closed = True
            if self._bus is not None:
                self._bus.fail(RunBroken("it was closed"))
        self._thread.join(PATIENCE)

    def _play(self) -> None:
        with suppress(PeakmeshError), Bus(self._network, run=self._run, who=self._who) as bus:
            with self._lock:
                self._bus = bus
                if self._is_closed:
                    return
            try:
                self._role(bus)
            except PeakmeshError:
                raise
            except Exception as error:  # noted while we are still there: then the run ends
                self._error = error
