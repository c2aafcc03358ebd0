"""The coordinator: starts the run, gives out the modes, watches over everybody, ends the run.

Lock-step: mode k goes out once the recorder holds all of step k - window. Neither plant nor chain depends on
the nodes, so they may run ahead; the numbers never depend on the window. Waiting for the recorder, not for the
nodes, makes a slow recorder slow the run instead of losing from it.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

from agent.contract.errors import InputError, PeakmeshError, RecordingFailed, RunBroken
from agent.contract.gains import Gains
from agent.contract.keys import COORDINATOR, EVENT, MODE, RECORDER, in_words, participants, sensor_who
from agent.contract.messages import Acknowledged, BrokenOff, Control, Event, Mode
from agent.contract.schedule import modes
from agent.network.bus import Bus
from agent.network.words import Peer
from agent.plan import Plan

REPORT_SECONDS = 0.1


class Summary(NamedTuple):
    """How a run went."""

    steps: int
    rounds_per_second: float  # from step 0 to the recorder's acknowledgement of the last step
    messages: int  # recorded
    missing: int
    recorded_steps: int  # all, unless the recording broke off
    broken_off: str  # why, and since when there is no recording; "" where there is a whole one


# what the coordinator reports: {"joined": who}, {"started": time}, {"complete": steps}, {"broken_off": sentence}
Word = dict[str, Any]


class Lost(RunBroken):
    """A participant that is gone."""

    def __init__(self, who: str) -> None:
        super().__init__(f"{in_words(who)} was lost: its process ended, or the network to it failed")
        self.who = who


def run(bus: Bus, gains: Gains, plan: Plan, *, report: Callable[[Word], None]) -> Summary:
    """Run the whole of `plan`.

    Raises RunBroken where somebody was lost, a deadline has passed or the recorder has the run stop, Interrupted on a
    signal; in all cases the others have been told, and the recorder has closed the recording.
    """
    bus.advertise([MODE, EVENT])
    conductor = Conductor(bus, gains, plan, report)
    try:
        conductor.start()
        report({"started": time.time()})
        started = time.monotonic()
        conductor.give_out_modes()
        seconds = time.monotonic() - started
    except PeakmeshError as error:
        last_word = conductor.stop(str(error))
        if isinstance(error, Lost) and last_word is not None and error.who in last_word.reached:
            reached = last_word.reached[error.who]
            raise RunBroken(f"{error}; the last that is recorded of it is of step {reached}") from None
        if isinstance(error, Lost):
            raise RunBroken(f"{error}; {conductor.complete} steps were complete") from None
        raise
    last_word = conductor.close()
    off = last_word.broken_off
    return Summary(
        steps=plan.steps,
        rounds_per_second=plan.steps / seconds,
        messages=last_word.messages,
        missing=last_word.missing,
        recorded_steps=plan.steps if off is None else off.steps,
        broken_off="" if off is None else str(off),
    )


class Conductor:
    """The run, from the coordinator's side."""

    def __init__(self, bus: Bus, gains: Gains, plan: Plan, report: Callable[[Word], None]) -> None:
        self._bus, self._gains, self._plan, self._report = bus, gains, plan, report
        self._reported = 0.0
        self._everybody = [who for who in participants(gains.problem) if who != bus.who]
        self.complete = 0  # steps that the recorder has
        self._broken_off: BrokenOff | None = None
        self._lacking: list[str] = []
        self._started = False

    def start(self) -> None:
        """The barrier, and the order to start."""
        self._bus.enter()
        for who in self._bus.meet([*self._everybody, *map(sensor_who, self._plan.external)]):
            self._report({"joined": who})
        own = self._gains.digest()
        for who, ready in self._bus.gather(self._everybody).items():
            if ready.gains != own:
                raise InputError(
                    f"{in_words(who)} runs on other gains ({ready.gains[:12]}...) than the coordinator "
                    f"({own[:12]}...); give everybody the same gains file"
                )
        self._order("start")
        self._started = True
        self._announce("start", f"{self._plan.steps} steps, seed {self._plan.seed}")

    def give_out_modes(self) -> None:
        """One mode for every step, at most a window ahead of what is recorded."""
        names = self._gains.problem.mode_names
        chain = modes(self._gains.problem, seed=self._plan.seed)
        for step in range(self._plan.steps):
            while step >= self.complete + self._plan.window:
                self._wait_for_progress()
            index = next(chain)
            self._bus.publish(MODE, Mode(step=step, mode=names[index], index=index))
        while self.complete < self._plan.steps:
            self._wait_for_progress()

    def close(self) -> Acknowledged:
        """All is done: the recorder closes the recording, then everybody leaves."""
        self._announce("end", "all steps are done")
        self._order("close")
        last_word = self._bus.wait_for_close()
        if last_word is None:
            raise RunBroken("all steps are done, but the recorder did not close the recording")
        return last_word

    def stop(self, reason: str) -> Acknowledged | None:
        """Tell everybody why the run ends here, and wait for the recorder where there is something to close."""
        if self._started:
            self._announce("stop", reason)
        self._order("stop", reason)
        if self._started:
            return self._bus.wait_for_close()
        self._bus.wait_until_gone(self._everybody)
        return None

    def _order(self, order: Literal["start", "close", "stop"], reason: str = "") -> None:
        plan = self._plan
        self._bus.order(
            Control(
                order=order,
                steps=plan.steps,
                seed=plan.seed,
                window=plan.window,
                external=list(plan.external),
                reason=reason,
            )
        )

    def _announce(self, kind: str, detail: str, *, who: str = COORDINATOR) -> None:
        self._bus.publish(EVENT, Event(step=max(0, self.complete - 1), kind=kind, who=who, detail=detail))

    def _wait_for_progress(self) -> None:
        """Until the recorder holds one more step, the deadline passes, or somebody is lost.

        The recorder alone knows what is late: where it has said nothing, it is given as long again to say so.
        """
        deadline = time.monotonic() + self._plan.deadline
        before, silent = self.complete, True
        while self.complete == before:
            left = deadline + (self._plan.deadline if silent else 0.0) - time.monotonic()
            if left <= 0.0:
                raise RunBroken(self._what_is_late(silent))
            match self._bus.receive(timeout=left):
                case Acknowledged() as acknowledged:
                    self.complete, self._lacking = acknowledged.steps, acknowledged.lacking
                    silent = False
                    self._heed(acknowledged.broken_off)
                case Peer(who=who, present=False) if self._takes_part(who):
                    raise Lost(who)
        if time.monotonic() - self._reported >= REPORT_SECONDS:
            self._reported = time.monotonic()
            self._report({"complete": self.complete})

    def _heed(self, broken_off: BrokenOff | None) -> None:
        """What the recorder says of its recording: stop where it asks for that, else tell everybody, once."""
        if broken_off is None or broken_off == self._broken_off:
            return
        self._broken_off = broken_off
        if broken_off.stop:
            raise RecordingFailed(str(broken_off))
        self._announce("unrecorded", str(broken_off), who=RECORDER)
        self._report({"broken_off": str(broken_off)})

    def _takes_part(self, who: str) -> bool:
        return who in self._everybody or who in map(sensor_who, self._plan.external)

    def _what_is_late(self, silent: bool) -> str:
        if silent:
            return f"the recorder has acknowledged nothing for {2.0 * self._plan.deadline:g} s, at step {self.complete}"
        topics = ", ".join(self._lacking)
        return f"step {self.complete} lacks {topics} after {self._plan.deadline:g} s"
