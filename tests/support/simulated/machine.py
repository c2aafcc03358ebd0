"""Virtual time, and processes of which exactly one thread runs at any moment: nothing is left to chance but the seed.

A thread is a greenlet. It runs until it waits; then the machine goes on with whatever is due next. A process that is
killed is never resumed, so that nothing of it happens any more: no `finally`, no flush.
"""

from __future__ import annotations

import heapq
import math
import random
from collections import deque
from collections.abc import Callable
from functools import partial
from itertools import count
from queue import Empty
from typing import Any

from greenlet import GreenletExit, getcurrent, greenlet

TICK = 1e-6  # seconds by which a look at the clock takes it forward
SPIN = 200_000  # looks at the clock without a wait between them; who does that waits for nothing
EPOCH = 1_800_000_000.0  # the machine's time of day when it starts


class Hung(Exception):
    """Somebody computes for ever."""


class Task:
    """A thread of a process."""

    def __init__(self, process: Process, name: str) -> None:
        self.process, self.name = process, name
        self.greenlet: Any = None
        self.waits: object | None = None  # for this; what would wake it for anything else comes too late


class Process:
    """One participant's process. Its clocks are its own: neither shows what the others' show."""

    def __init__(self, machine: Machine, who: str, number: int = 0) -> None:
        """`number` counts the processes of one participant."""
        self.machine, self.who = machine, who
        self.name = f"{who} #{number + 1}" if number else who
        self.is_over = False  # ended or killed
        self.was_killed = False
        self.frozen_until = 0.0
        self.error: BaseException | None = None  # that it ended with; None where all is well
        self.crashes: list[BaseException] = []  # of its other threads
        self.monotonic_skew = machine.random.uniform(0.0, 1e5)
        self.wall_skew = machine.random.uniform(-300.0, 300.0)
        self.on_signal: Callable[[int, None], None] | None = None
        self.on_end: list[Callable[[], None]] = []
        self.on_freeze: list[Callable[[float], None]] = []
        self.began = machine.now
        self.ended = math.inf

    def start(self, main: Callable[[], None]) -> None:
        """Run `main` in the first thread; when that is through, the process is over."""

        def first() -> None:
            try:
                main()
            except GreenletExit:
                raise
            except BaseException as error:
                self.error = error
            self._end()

        self.machine.start(self, first, "main")

    def _end(self) -> None:
        self.is_over, self.ended = True, self.machine.now
        words = "" if self.error is None else f": {type(self.error).__name__}: {self.error}"
        self.machine.note(self.name, f"ends{words}")
        for do in self.on_end:
            do()

    def kill(self) -> None:
        """As kill -9 does."""
        if not self.is_over:
            self.was_killed = True
            self.machine.note(self.name, "is killed")
            self._end()

    def freeze(self, seconds: float) -> None:
        """As SIGSTOP does, until SIGCONT so much later."""
        self.frozen_until = max(self.frozen_until, self.machine.now + seconds)
        self.machine.note(self.name, f"is frozen for {seconds:g} s")
        for do in self.on_freeze:
            do(seconds)

    def signal(self, number: int) -> None:
        """Ask it to end."""
        if not self.is_over and self.on_signal is not None:
            self.machine.note(self.name, f"gets signal {number}")
            self.on_signal(number, None)


class Machine:
    """The clock, and what is due. `reaction` says how long a thread takes to run that could."""

    def __init__(self, seed: int) -> None:
        self.random = random.Random(seed)
        self.reaction: Callable[[], float] = lambda: 1e-4
        self.now = 0.0
        self.current: Task | None = None
        self.trace: list[str] = []
        self.steps = 0  # events so far
        self._due: list[tuple[float, int, Callable[[], None]]] = []
        self._order = count()
        self._hub = getcurrent()
        self._looks = 0
        self._tasks: list[Task] = []
        self._ends = False

    def note(self, who: str, what: str) -> None:
        self.trace.append(f"{self.now:12.6f}  {who:16} {what}")

    def at(self, time: float, do: Callable[[], None]) -> None:
        """Have something done at a time."""
        heapq.heappush(self._due, (time, next(self._order), do))

    def run(self, until: float, is_over: Callable[[], bool]) -> None:
        """Go on until something holds, nothing is due any more, or time is over."""
        while self._due and not is_over():
            time, _, do = heapq.heappop(self._due)
            if time > until:
                return
            self.now = max(self.now, time)
            self.steps += 1
            do()

    def look(self) -> float:
        """The time, for the thread that runs: looking takes some."""
        self.now += TICK
        self._looks += 1
        if self._looks > SPIN:
            raise Hung(f"{self.process.name if self.process else '?'} looks at the clock again and again")
        return self.now

    @property
    def process(self) -> Process | None:
        """The one that runs."""
        return self.current.process if self.current is not None else None

    def start(self, process: Process, work: Callable[[], None], name: str) -> None:
        """Another thread of a process."""
        task = Task(process, name)
        task.greenlet = greenlet(partial(self._body, task, work), parent=self._hub)
        self._tasks.append(task)
        task.waits = start = object()
        self.at(self.now + self.reaction(), partial(self._resume, task, start, True))

    def _body(self, task: Task, work: Callable[[], None], woken: bool) -> None:
        try:
            work()
        except GreenletExit:
            pass
        except BaseException as error:
            task.process.crashes.append(error)
        self.current = None

    def wait(self, deadline: float = math.inf) -> bool:
        """Have the thread that runs wait until it is woken, True, or until the deadline."""
        task = self.current
        assert task is not None
        if self._ends:
            raise GreenletExit
        task.waits = reason = object()
        if deadline < math.inf:
            self.at(deadline, partial(self._resume, task, reason, False))
        self.current, self._looks = None, 0
        return bool(self._hub.switch())

    def sleep(self, seconds: float) -> None:
        self.wait(self.now + seconds)

    def pause(self) -> None:
        """The thread that runs may be made to wait here for others that could run, too."""
        if self.current is not None and (self._ends or self.random.random() < 0.3):
            self.wait(self.now + self.reaction())

    def wake(self, task: Task) -> None:
        """Have a thread that waits go on."""
        self.at(self.now + self.reaction(), partial(self._resume, task, task.waits, True))

    def _resume(self, task: Task, reason: object, woken: bool) -> None:
        process = task.process
        if task.waits is not reason or process.is_over:
            return
        if process.frozen_until > self.now:
            self.at(process.frozen_until, partial(self._resume, task, reason, woken))
            return
        task.waits, self.current = None, task
        task.greenlet.switch(woken)
        self.current = None

    def end(self) -> None:
        """Let go of every thread. What they still do on their way out is nobody's concern: all is looked at by now."""
        self._ends = True
        for task in self._tasks:
            task.process.is_over = True
            while task.greenlet:  # started, and not at its end
                self.current = task
                task.greenlet.throw(GreenletExit)
        self.current = None


class Queue:
    """queue.SimpleQueue of a simulated process."""

    def __init__(self, machine: Machine) -> None:
        self._machine = machine
        self._items: deque[Any] = deque()
        self._waiting: list[Task] = []

    def put(self, item: Any) -> None:
        self._items.append(item)
        if self._waiting:
            self._machine.wake(self._waiting.pop(0))

    def get(self, block: bool = True, timeout: float | None = None) -> Any:
        machine = self._machine
        deadline = math.inf if timeout is None else machine.now + timeout
        while not self._items:
            if not block or machine.now >= deadline:
                raise Empty
            task = machine.current
            assert task is not None
            self._waiting.append(task)
            try:
                machine.wait(deadline)
            finally:
                if task in self._waiting:
                    self._waiting.remove(task)
        return self._items.popleft()

    def get_nowait(self) -> Any:
        return self.get(block=False)

    def qsize(self) -> int:
        return len(self._items)

    def empty(self) -> bool:
        return not self._items
