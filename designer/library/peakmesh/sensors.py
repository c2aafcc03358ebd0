"""Sensors that are functions, each in a thread of this process.

A function is spoken for by what docs/sensor.py does, which needs zenoh and the protocol alone: a sensor is no role.
"""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Sequence
from queue import SimpleQueue
from typing import Any

import zenoh

from agent.contract.keys import COORDINATOR, MODE, RECORDER, alive, key, measurement, node_who, sensor_who

PATIENCE = 60.0  # seconds for a function to return, which nobody can end

Measure = Callable[[int], Sequence[float]]  # y(k) of step k


class Sensor:
    """Measures one node of a run whose coordinator listens at `address`."""

    def __init__(self, measure: Measure, *, run: str, node: str, address: str) -> None:
        self._measure, self._run, self._node, self._address = measure, run, node, address
        self._tokens: SimpleQueue[str | None] = SimpleQueue()  # who is there; None: it is to end
        self._modes: SimpleQueue[bytes | None] = SimpleQueue()  # None: the run is over
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._serve, name=sensor_who(node), daemon=True)
        self._thread.start()

    def failure(self) -> str | None:
        """Why it measures no more; None where it does, or has ended well."""
        return None if self._error is None else f"{type(self._error).__name__}: {self._error}"

    def close(self) -> None:
        """End it, if it has not ended."""
        self._tokens.put(None)
        self._modes.put(None)
        self._thread.join(PATIENCE)

    def _serve(self) -> None:
        config = zenoh.Config()
        config.insert_json5("connect/endpoints", json.dumps([self._address]))
        config.insert_json5("listen/endpoints", "[]")
        config.insert_json5("scouting/multicast/enabled", "false")
        try:
            with zenoh.open(config) as session:
                if self._appear(session):
                    self._measure_all(session)
        except Exception as error:  # whatever it is, the test is told
            self._error = error

    def _appear(self, session: zenoh.Session) -> bool:
        """Subscribe, wait for who must hear us, and show that we are there; False where it is to end before."""
        self._declared: list[Any] = []  # zenoh drops what nobody holds
        liveliness, run = session.liveliness(), self._run

        def see(sample: zenoh.Sample) -> None:
            who = str(sample.key_expr).rpartition("/")[2]
            if sample.kind == zenoh.SampleKind.PUT:
                self._tokens.put(who)
            elif who == COORDINATOR:
                self._modes.put(None)

        def hear(sample: zenoh.Sample) -> None:
            self._modes.put(sample.payload.to_bytes())

        self._declared.append(session.declare_subscriber(key(run, MODE), hear))
        self._declared.append(liveliness.declare_subscriber(key(run, alive("*")), see, history=True))
        waiting = {node_who(self._node), RECORDER, COORDINATOR}
        while waiting:
            who = self._tokens.get()
            if who is None:
                return False
            waiting.discard(who)
        self._declared.append(liveliness.declare_token(key(run, alive(sensor_who(self._node)))))
        return True

    def _measure_all(self, session: zenoh.Session) -> None:
        topic = key(self._run, measurement(self._node))
        while (mode := self._modes.get()) is not None:
            step = json.loads(mode)["step"]
            try:
                y = [float(entry) for entry in self._measure(step)]
            except Exception as error:  # noted while we still are there: then the run ends
                self._error = error
                return
            session.put(topic, json.dumps({"step": step, "y": y}), congestion_control=zenoh.CongestionControl.BLOCK)
