"""What the modules of the runtime see instead of this machine's clock, threads and queues.

Their own names are put in the place of the real ones, wherever a module of `agent` has any of these: so a module that
is new, or that is new to the clock, is under the virtual one too. What a stand-in does not have, raises AttributeError.
"""

from __future__ import annotations

import datetime
import os
import queue
import random
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from types import BuiltinFunctionType, SimpleNamespace
from typing import Any

from agent.faults import Fault
from agent.roles import suffering
from simulated.machine import EPOCH, Machine, Queue

_LEFT_ALONE = ("agent.commands", "agent.launch", "agent.signals", "agent.cli", "agent.__main__")  # of real processes


@contextmanager
def put_in_place(machine: Machine, *, seed: int) -> Iterator[None]:
    """Every module of the runtime that is loaded runs on `machine`, for as long as this block."""
    stand_ins = _stand_ins(machine, seed)
    before = _globals(len(sys.modules), frozenset(stand_ins))
    for module, name, value in before:
        setattr(module, name, stand_ins[id(value)])
    try:
        yield
    finally:
        for module, name, value in before:
            setattr(module, name, value)


@cache  # until another module is loaded
def _globals(loaded: int, wanted: frozenset[int]) -> list[tuple[Any, str, Any]]:
    """Module, name and value of everything that has a stand-in."""
    found = []
    for name, module in list(sys.modules.items()):
        if name.startswith("agent.") and not name.startswith(_LEFT_ALONE):
            for key, value in list(vars(module).items()):
                if isinstance(value, BuiltinFunctionType) and value.__module__ in ("time", "_thread"):
                    raise AssertionError(f"{name} has {key} of the real clock; write time.{key}")
                if id(value) in wanted:
                    found.append((module, key, value))
    return found


def _stand_ins(machine: Machine, seed: int) -> dict[int, Any]:
    """By the identity of what they stand for."""
    chance = random.Random(f"{seed} identities")
    real: dict[Any, Any] = {
        time: _Time(machine),
        threading: SimpleNamespace(Thread=lambda **about: _Thread(machine, **about), Lock=threading.Lock),
        threading.Thread: lambda **about: _Thread(machine, **about),
        queue.SimpleQueue: lambda: Queue(machine),
        os: _Os(chance),
        datetime.datetime: _Datetime(machine),
        suffering.suffer: lambda faults: _suffer(machine, faults),
    }
    return {id(thing): stand_in for thing, stand_in in real.items()}


class _Time:
    def __init__(self, machine: Machine) -> None:
        self._machine = machine

    def monotonic(self) -> float:
        process = self._machine.process
        return self._machine.look() + (process.monotonic_skew if process is not None else 0.0)

    def time(self) -> float:
        process = self._machine.process
        return EPOCH + self._machine.look() + (process.wall_skew if process is not None else 0.0)

    def time_ns(self) -> int:
        return round(1e9 * self.time())

    def process_time(self) -> float:
        return 1e-3 * self._machine.now


class _Thread:
    def __init__(
        self, machine: Machine, *, target: Callable[..., None], args: tuple[Any, ...] = (), name: str, daemon: bool
    ) -> None:
        assert daemon, "a thread that outlives the main one"
        self._machine, self._name = machine, name
        self._target, self._args = target, args
        self._runs = False

    def start(self) -> None:
        process = self._machine.process
        assert process is not None
        self._runs = True
        self._machine.start(process, self._work, self._name)

    def _work(self) -> None:
        self._target(*self._args)
        self._runs = False

    def join(self, timeout: float) -> None:
        """Looks now and then."""
        deadline = self._machine.now + timeout
        while self._runs and self._machine.now < deadline:
            self._machine.sleep(min(0.01, timeout))


class _Os:
    """The real one, but for chance, and for disks: what is synced stays out of reach of a simulated power cut."""

    def __init__(self, chance: random.Random) -> None:
        self._chance = chance

    def urandom(self, size: int) -> bytes:
        return self._chance.randbytes(size)

    def fsync(self, file: int) -> None:
        return

    def cpu_count(self) -> int:
        return 2

    def kill(self, pid: int, number: int) -> None:
        raise AssertionError("a simulated process sends a real signal")

    def __getattr__(self, name: str) -> Any:
        return getattr(os, name)


class _Datetime:
    def __init__(self, machine: Machine) -> None:
        self._machine = machine

    def now(self, zone: datetime.tzinfo) -> datetime.datetime:
        return datetime.datetime.fromtimestamp(EPOCH + self._machine.now, zone)


def _suffer(machine: Machine, faults: list[Fault]) -> None:
    process = machine.process
    assert process is not None
    for fault in faults:
        if fault.kind == "kill":
            process.kill()
        else:
            process.freeze(fault.seconds)
        machine.sleep(0.0)  # never comes back where it was killed
