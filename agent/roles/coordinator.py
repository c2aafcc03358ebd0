"""The coordinator: starts the run, gives out the modes, watches over everybody, ends the run.

Lock-step: mode k goes out once the recorder holds all of step k - window. Neither plant nor chain depends on
the nodes, so they may run ahead; the numbers never depend on the window. Waiting for the recorder, not for the
nodes, makes a slow recorder slow the run instead of losing from it.

Paced: mode k goes out when it is due, whoever is there, and nobody can hold the run up.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping
from typing import Any, Literal, NamedTuple

from agent.contract.errors import InputError, PeakmeshError, RecordingFailed, RunBroken, counted
from agent.contract.gains import Gains
from agent.contract.keys import (
    ACKNOWLEDGED,
    COORDINATOR,
    EVENT,
    MODE,
    PLANT,
    RECORDER,
    data_topics,
    in_words,
    participants,
    sensor_who,
)
from agent.contract.messages import (
    GONE,
    LOST,
    REFUSED,
    Acknowledged,
    BrokenOff,
    Control,
    Event,
    Mode,
    Ready,
    Refusals,
)
from agent.contract.schedule import modes
from agent.guard import UNTIMELY, Counts
from agent.network.acquaintance import stray_sensor
from agent.network.bus import Bus
from agent.network.words import Incoming, Orphaned, Peer, Refused
from agent.plan import Plan
from agent.refusals import Register
from agent.roles.timekeeper import Timekeeper

REPORT_SECONDS = 0.1
MOST_NAMED = 8
TAKE_UP_SECONDS = 0.5  # a coordinator that has come back waits so long for others than the first who answers


class Summary(NamedTuple):
    """How a run went."""

    steps: int
    rounds_per_second: float  # from step 0 to the recorder's acknowledgement of the last step
    messages: int  # recorded
    missing: int
    recorded_steps: int  # all, unless the recording broke off
    broken_off: str  # why, and since when there is no recording; "" where there is a whole one
    not_whole: str = ""  # who is not recorded to its last step, in a paced run; "" where everybody is
    pacing: dict[str, Any] | None = None  # of a paced run: what was substituted, and latencies in seconds
    refused: dict[str, Counts] | None = None  # messages that did not fit: by whom, on which topic, of which kind


# what the coordinator reports: {"joined": who}, {"started": time}, {"complete": steps}, {"broken_off": sentence},
# {"ending": why}, {"warning": sentence}
Word = dict[str, Any]


class Lost(RunBroken):
    """A participant that is gone."""

    def __init__(self, who: str, reason: str = "") -> None:
        why = f"; it said: {reason}" if reason else ""
        super().__init__(f"{in_words(who)} was lost: its process ended, or the network to it failed{why}")
        self.who = who


def run(bus: Bus, gains: Gains, plan: Plan, *, report: Callable[[Word], None]) -> Summary:
    """Run the whole of `plan`.

    Raises RunBroken where somebody was lost, a deadline has passed or the recorder has the run stop, Interrupted on a
    signal; in all cases the others have been told, and the recorder has closed the recording.
    """
    bus.guard.know(gains.problem)
    bus.advertise([MODE, EVENT])
    conductor, timekeeper = Conductor(bus, gains, plan, report), None
    if plan.pace is not None:
        bus.wait_for_nobody()
        timekeeper = Timekeeper(bus, gains, plan, heed=conductor.heed, stood=conductor.stood)
    try:
        conductor.start()
        report({"started": time.time()})
        started, before = time.monotonic(), conductor.complete
        if timekeeper is None:
            conductor.give_out_modes()
        else:
            conductor.keep_time(timekeeper)
        seconds = time.monotonic() - started
    except Refused:
        raise  # the run is another coordinator's: not ours to stop
    except PeakmeshError as error:
        last_word = conductor.stop(str(error))
        if isinstance(error, Lost) and last_word is not None and error.who in last_word.reached:
            reached = last_word.reached[error.who]
            raise RunBroken(f"{error}; the last that is recorded of it is of step {reached}") from None
        if isinstance(error, Lost):
            raise RunBroken(f"{error}; {conductor.complete} steps were complete") from None
        raise
    last_word = conductor.close()
    conductor.doubt(last_word)
    off = last_word.broken_off
    return Summary(
        steps=plan.steps,
        rounds_per_second=(plan.steps - before) / seconds,
        messages=last_word.messages,
        missing=last_word.missing,
        recorded_steps=plan.steps if off is None else off.steps,
        broken_off="" if off is None else str(off),
        not_whole="" if off is not None else conductor.who_is_not_whole(last_word),
        pacing=None if timekeeper is None else timekeeper.pacing(),
        refused=conductor.refused(),
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
        self._lost = 0  # messages that nobody keeps any more
        self._given = 0  # steps whose modes are out, in lock-step
        self._started = False
        self._identity = os.urandom(8).hex()
        self._register = Register()  # of what was refused
        self._again = False  # there was a coordinator before this one
        self._recorded = 0  # steps whose modes the recorder has, in a paced run that is taken up again
        if plan.needs_no_plant(gains.problem):
            self._everybody.remove(PLANT)

    def start(self) -> None:
        """The barrier, and the order to start; a paced run that has lost its coordinator is taken up where it is."""
        self._bus.enter()
        self._bus.guard.begin(steps=self._plan.steps, external=self._plan.external, paced=self._plan.pace is not None)
        try:
            cast = self._gather()
        except Orphaned as run:
            self._take_up(run.ready)
            return
        self._order("start", cast=cast)
        self._started = True
        self._announce("start", f"{self._plan.steps} steps, seed {self._plan.seed}")
        for fault in self._plan.faults:
            self._announce("fault", fault)

    def _take_up(self, first: Ready) -> None:
        """Go on with the chain at the step after the last mode that anybody has had."""
        answers = self._bus.gather_underway(first, seconds=TAKE_UP_SECONDS)
        self._refuse_other_gains(answers)
        self._bus.guard.prefer({who: answer.session for who, answer in answers.items()})
        self._identity = first.identity
        self.complete = max(answer.step for answer in answers.values())
        self._again = True
        self._order("start", cast=self._bus.guard.cast(self._everybody))
        greeting = self._bus.greeted(seconds=self._bus.network.wait, heed=self._welcome)
        self._recorded = min(self.complete, greeting.steps)
        self._started = True
        self._announce("resumed", f"the coordinator goes on at step {self.complete}", about=COORDINATOR)

    def _welcome(self, word: Incoming | None) -> None:
        """Whoever has come is told that the run is under way."""
        match word:
            case Peer(who=who, present=True) if self._takes_part(who):
                self._order("start", cast=self._bus.guard.cast([who]))

    def _gather(self) -> dict[str, str]:
        """Wait for everybody; the session of each."""
        everybody = [*self._everybody, *map(sensor_who, self._plan.external)]
        for who in self._bus.meet(everybody, warn=lambda sentence: self._report({"warning": sentence})):
            self._report({"joined": who})
        answers = self._bus.gather(self._everybody)
        self._refuse_other_gains(answers)
        return {who: ready.session for who, ready in answers.items()}

    def _refuse_other_gains(self, answers: Mapping[str, Ready]) -> None:
        own = self._gains.digest()
        for who, ready in answers.items():
            if ready.gains != own:
                raise InputError(
                    f"{in_words(who)} runs on other gains ({ready.gains[:12]}...) than the coordinator "
                    f"({own[:12]}...); give everybody the same gains file"
                )

    def give_out_modes(self) -> None:
        """One mode for every step, at most a window ahead of what is recorded."""
        names = self._gains.problem.mode_names
        chain = modes(self._gains.problem, seed=self._plan.seed)
        for step in range(self._plan.steps):
            while step >= self.complete + self._plan.window:
                self._wait_for_progress()
            index, self._given = next(chain), step + 1
            self._bus.publish(MODE, Mode(step=step, mode=names[index], index=index))
        while self.complete < self._plan.steps:
            self._wait_for_progress()

    def keep_time(self, timekeeper: Timekeeper) -> None:
        """One mode a period, whoever is there."""

        def tick(step: int) -> None:
            self.complete = step + 1
            self._tell_refused()
            self._report_progress()

        timekeeper.keep_time(tick, first=self.complete, recorded=self._recorded, again=self._again)

    def heed(self, word: Incoming) -> None:
        """What is heard in a paced run: who comes and goes, and what becomes of the recording."""
        match word:
            case Acknowledged() as acknowledged:
                self._heed(acknowledged.broken_off)
                self._tell_lost(acknowledged.lost)
            case Refusals():
                self._note(word)
            case Peer(who=who, present=present, succeeds=succeeds) if self._takes_part(who):
                if succeeds:
                    self._announce(GONE, in_words(who), about=who)
                self._announce("back" if present else GONE, in_words(who), about=who)
                self._welcome(word)
            case Peer(who=who, present=True):
                self._doubt(who)

    def _tell_lost(self, lost: int) -> None:
        """Say what will not be recorded, as far as the recorder knows."""
        if lost > self._lost:
            self._lost = lost
            gone = f"{counted(lost, 'message')} will not be recorded: nobody keeps them any more"
            self._announce(LOST, gone, about=RECORDER)

    def _doubt(self, who: str) -> None:
        """Somebody is there whom nobody expects."""
        if doubt := stray_sensor(who):
            self._report({"warning": doubt})

    def _note(self, word: Incoming | None) -> None:
        """What somebody has refused."""
        match word:
            case Refusals(who=who, counts=counts):
                self._register.enter(who, counts)

    def stood(self, seconds: float) -> None:
        """The clock of a paced run stood still."""
        self._announce("stood", f"the clock of the run stood still for {seconds:.3g} s before step {self.complete}")

    def close(self) -> Acknowledged:
        """All is done: the recorder closes the recording, then everybody leaves."""
        self._report({"ending": ""})
        self._tell_refused(hurry=True)
        self._announce("end", "all steps are done")
        last_word = self._end("close")
        if last_word is None:
            raise RunBroken("all steps are done, but the recorder did not close the recording")
        return last_word

    def who_is_not_whole(self, last_word: Acknowledged) -> str:
        """Of whom the last steps are not recorded, who stood still or was gone as the run ended; and what is lost."""
        reached = {who: last_word.reached.get(who, -1) for who in self._everybody if who != RECORDER}
        short = [
            f"of {in_words(who)} {f'after step {last}' if last >= 0 else 'at all'}"
            for who, last in reached.items()
            if last < self._plan.steps - 1
        ]
        more = f" and of {len(short) - MOST_NAMED} more" if len(short) > MOST_NAMED else ""
        whom = ", ".join(short[:MOST_NAMED]) + more
        found = [f"nothing is recorded {whom}; the last step is {self._plan.steps - 1}"] if short else []
        if last_word.lost:
            found.append(f"{counted(last_word.lost, 'message')} went with the process that held them, or were not kept")
        return "; ".join(found)

    def stop(self, reason: str) -> Acknowledged | None:
        """Tell everybody why the run ends here, and wait for the recorder where there is something to close."""
        self._report({"ending": reason})
        if self._started:
            self._tell_refused(hurry=True)
            self._announce("stop", reason)
        if self._started:
            return self._end("stop", reason)
        self._order("stop", reason)
        self._bus.wait_until_gone(self._everybody, greet=lambda: self._order("stop", reason))
        return None

    def _end(self, order: Literal["close", "stop"], reason: str = "") -> Acknowledged | None:
        """Order the end; the recorder's last word."""
        self._order(order, reason)

        def heed(word: Incoming | None) -> None:
            self._note(word)
            if word == Peer(RECORDER, True, succeeds=True):  # the others still keep what the one before has not got
                self._welcome(word)
                self._order(order, reason)

        return self._bus.wait_for_close(heed)

    def _order(
        self, order: Literal["start", "close", "stop"], reason: str = "", *, cast: Mapping[str, str] | None = None
    ) -> None:
        plan = self._plan
        self._bus.order(
            Control(
                order=order,
                steps=plan.steps,
                seed=plan.seed,
                window=plan.window,
                external=list(plan.external),
                reason=reason,
                step=self.complete if plan.pace is not None else 0,
                gains=self._gains.digest(),
                identity=self._identity,
                faults=list(plan.faults),
                cast=dict(cast or {}),
                **({} if plan.pace is None else plan.pace._asdict()),
            )
        )

    def _announce(self, kind: str, detail: str, *, who: str = COORDINATOR, about: str = "") -> None:
        step = max(0, self.complete - 1)
        self._bus.publish(EVENT, Event(step=step, kind=kind, who=who, detail=detail, about=about))

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
                case Acknowledged() as acknowledged if before <= acknowledged.steps <= self._given:
                    self.complete, self._lacking = acknowledged.steps, acknowledged.lacking
                    silent = False
                    self._heed(acknowledged.broken_off)
                case Acknowledged():  # what was not given out, nobody can have
                    self._bus.guard.refuse(ACKNOWLEDGED, UNTIMELY)
                case Refusals() as refusals:
                    self._note(refusals)
                case Peer(who=who, present=False) | Peer(who=who, succeeds=True) if self._takes_part(who):
                    raise Lost(who, self._bus.reason_of(who))
                case Peer(who=who, present=True) if not self._takes_part(who):
                    self._doubt(who)
            self._tell_refused()
        self._report_progress()

    def _report_progress(self) -> None:
        if time.monotonic() - self._reported >= REPORT_SECONDS:
            self._reported = time.monotonic()
            self._report({"complete": self.complete})

    def doubt(self, last_word: Acknowledged) -> None:
        """RunBroken where the recorder has closed another recording than that of all that was said, in lock-step."""
        if last_word.broken_off is not None or self._plan.pace is not None:
            return
        least = self._plan.steps * len(data_topics(self._gains.problem))
        own, of_own = self._bus.published, last_word.received.get(COORDINATOR, 0)
        if last_word.steps != self._plan.steps or last_word.messages < least or of_own != own:
            raise RunBroken(
                f"the recorder has closed a recording of {last_word.steps} steps and "
                f"{counted(last_word.messages, 'message')}, {of_own} of the coordinator's; there were "
                f"{self._plan.steps} steps and at least {least} messages, {own} of the coordinator's"
            )

    def refused(self) -> dict[str, Counts] | None:
        """What everybody has refused; None where that is nothing."""
        return self._register.document() or None

    def _tell_refused(self, *, hurry: bool = False) -> None:
        """Say what was refused, now and then."""
        if self._bus.guard.total:
            self._register.enter(COORDINATOR, self._bus.guard.refused())
        for refused in self._register.due(time.monotonic(), hurry=hurry):
            self._announce(REFUSED, refused.text, about=refused.topic)

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
