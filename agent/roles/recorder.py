"""The recorder: writes every message to MCAP, says what it holds, and closes the recording before anybody leaves.

Where the recording breaks off, because the disk is full or the file was taken away, the recorder says so at once and
stays: it goes on taking messages and acknowledging them, so that publishers need not keep what will never be
recorded, until the coordinator ends the run, now or when all steps are done.
"""

from __future__ import annotations

import platform
import time
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

from agent.contract.errors import InputError, Interrupted, RecordingFailed, RunBroken
from agent.contract.gains import Gains
from agent.contract.keys import ACCOUNT, EVENT, MODE, PLANT_STATE, RECORDER, estimate, measurement, sender_of
from agent.contract.messages import Acknowledged, BrokenOff, Control, Facts, Ready
from agent.contract.recording.parts import refuse_recording
from agent.contract.recording.resumption import Cut
from agent.contract.recording.writer import Split
from agent.faults import Ordeal, parse
from agent.guard import REPLAY, UNASKED, Unfit
from agent.network.bus import Bus
from agent.network.gate import MOST, Admitted, Gate, admit
from agent.network.session import CAPACITY
from agent.network.words import Peer, Replayed, RunClosed, Sample
from agent.plan import RecordingPlan
from agent.roles.joining import join
from agent.roles.record import Record
from agent.roles.suffering import suffer

SHORTEST_PAUSE = 0.002  # s, while messages come; they wait in their channels meanwhile
LONGEST_PAUSE = 0.02  # s, while none do
ACKNOWLEDGE_SECONDS = 0.25  # between acknowledgements, in a paced run
IDLE_SECONDS = 0.5  # silence after which it says what it lacks


def run(
    bus: Bus, gains: Gains, *, path: Path, force: bool, plan: RecordingPlan, report: Callable[[BrokenOff], None]
) -> None:
    """Take part as the recorder until the run has ended; raises RunBroken where it did not end well.

    Where the recording breaks off `report` is told at once, and so is everybody else.
    """
    cut = Cut.of(path)
    if cut is None or cut.run.get("run") != bus.run:
        try:
            refuse_recording(path, force=force)
        except InputError:
            bus.excuse()  # the others need not wait for us
            raise
    names = gains.problem.node_names
    topics = [MODE, PLANT_STATE, EVENT, ACCOUNT, *map(measurement, names), *map(estimate, names)]
    channels = {topic: bus.channel(topic) for topic in topics}
    start = join(bus, gains)
    bus.tell_viewers(Facts(start=start, gains=gains.canonical().decode()))
    split = Split(plan.split_size, plan.split_seconds)
    if cut is not None and cut.run.get("identity") != start.identity:
        refuse_recording(path, force=force)
        cut = None
    facts, paced = cut.run if cut is not None else _facts(bus.run, gains, start), start.period > 0.0
    with Record(path, run=facts, gains=gains, force=force, split=split, paced=paced, cut=cut) as record:
        faults = [parse(text, gains.problem, steps=start.steps) for text in start.faults]
        ordeal = Ordeal(faults, RECORDER, begin=start.step, again=bus.is_late) if paced else None
        recorder = Recorder(
            bus,
            channels,
            record,
            window=start.window,
            goes_on=plan.goes_on,
            report=report,
            ordeal=ordeal,
            is_late=bus.is_late,
        )
        try:
            recorder.record()
        except RunClosed as closed:
            stopped = closed.control.order == "stop"
            recorder.close(status="stopped" if stopped else "finished", reason=closed.control.reason)
            if stopped:
                raise RunBroken(closed.control.reason) from None
            if recorder.broken_off is not None:
                raise RecordingFailed(f"the run has ended, but {recorder.broken_off}") from None
        except (RunBroken, Interrupted) as error:
            if not (paced and isinstance(error, Interrupted)):  # a recorder after this one goes on with the file
                recorder.close(status="broken", reason=str(error))
            raise


class Recorder:
    """Takes what comes into the record, and tells everybody what it has."""

    def __init__(
        self,
        bus: Bus,
        channels: Mapping[str, Gate],
        record: Record,
        *,
        window: int,
        goes_on: bool,
        report: Callable[[BrokenOff], None],
        ordeal: Ordeal | None = None,
        is_late: bool = False,
    ) -> None:
        """`ordeal` is what a paced run has its recorder suffer; None in lock-step. `is_late`: it joined under way."""
        self._is_late = is_late
        self._ordeal, self._told = ordeal, 0.0
        self._bus, self._channels, self._record = bus, channels, record
        self._goes_on, self._report = goes_on, report
        self._publishers = sorted({sender_of(topic) for topic in channels})
        self._quantum = max(1, window // 4)  # steps between acknowledgements
        self._acknowledged = 0
        self._oldest: dict[str, int] = {}  # of each publisher, the first number that it has given again
        self._quiet_since = time.monotonic()
        self.broken_off: BrokenOff | None = None

    def record(self) -> None:
        """Until Bus.receive raises: the run is closed, the coordinator lost, or a signal came."""
        pause = SHORTEST_PAUSE
        if self._ordeal is not None:
            self._ask_everybody()  # where there was a recorder before this one, for what came meanwhile
        while True:
            self._record.keep_up()
            self._heed_failure()
            word = self._bus.receive(timeout=pause)
            match word:
                case Sample():  # a replay that we asked for
                    self._take_replayed(word)
                case Replayed(who=who):
                    self._give_up(who)
                case Ready(who=who, session=session, asks=True) if who in self._publishers:
                    if self._bus.guard.is_first(who, session):
                        self._greet(who)
                case Peer(who=who, present=True) if self._ordeal is not None and who in self._publishers:
                    self._ask(who)  # we were cut off, or it was not there to be asked with everybody
            pause = SHORTEST_PAUSE if self._take_waiting() else min(2.0 * pause, LONGEST_PAUSE)
            if time.monotonic() - self._quiet_since >= IDLE_SECONDS:
                self._complain()

    def close(self, *, status: str, reason: str) -> None:
        """Ask everybody for what is missing, end the file, and let everybody go."""
        self._take_waiting(most=2 * CAPACITY)
        if self._is_late:
            self._bus.wait_until_there(self._publishers)
        self._ask_everybody()
        for sample in self._bus.replayed(self._publishers):
            self._take_replayed(sample)
        self._take_waiting(most=2 * CAPACITY)  # what came meanwhile
        if self._ordeal is not None:
            for who in self._publishers:  # what nobody has given went with the process that held it
                self._record.receipts.close_gap(who)
        self._record.finish(status=status, reason=reason)
        self._heed_failure()
        self._acknowledge(closed=True)
        self._bus.wait_until_gone(self._publishers)

    def _take_waiting(self, most: int = MOST) -> bool:
        """Take what has come, `most` of each topic, acknowledging on the way; False where there was nothing."""
        receipts = self._record.receipts
        before = receipts.messages
        for gate in self._channels.values():
            for admitted in gate.waiting(most):
                self._take(admitted)
        new_steps, new_messages = receipts.complete - self._acknowledged, receipts.messages - before
        if self._ordeal is not None:
            self._acknowledge_at_times()
        elif new_steps >= self._quantum or (new_steps > 0 and new_messages == 0):
            self._acknowledge()
        return new_messages > 0

    def _acknowledge_at_times(self) -> None:
        """In a paced run: now and then, what is in the file; so nothing is lost if this process is."""
        if time.monotonic() - self._told >= ACKNOWLEDGE_SECONDS:
            self._told = time.monotonic()
            self._record.flush()
            self._acknowledge()

    def _take_replayed(self, sample: Sample) -> None:
        """Take an answer to what we have asked for; anybody can answer anything."""
        try:
            if sample.topic not in self._channels:
                raise Unfit(UNASKED)
            self._take(admit(self._bus.guard, sample, for_record=True))
            if sample.stamp is not None:
                sender, number = sample.stamp.sender, sample.stamp.number
                self._oldest[sender] = min(number, self._oldest.get(sender, number))
        except Unfit as unfit:
            self._bus.guard.refuse(REPLAY, unfit.kind)

    def _take(self, admitted: Admitted) -> None:
        step = admitted.message.step
        if self._record.take(admitted.topic, admitted.payload, admitted.stamp, step):
            self._quiet_since = time.monotonic()
        if self._ordeal is not None and admitted.topic == MODE:
            suffer(self._ordeal.due(step))

    def _give_up(self, who: str) -> None:
        """All that `who` keeps has come. What it had sent before that, and we have not, it could not keep for us."""
        if (oldest := self._oldest.pop(who, None)) is not None and self._ordeal is not None:
            self._record.receipts.close_gap(who, below=oldest)

    def _heed_failure(self) -> None:
        """Tell everybody, once, that nothing can be recorded any more."""
        record = self._record
        if record.failure and self.broken_off is None:
            self.broken_off = BrokenOff(reason=record.failure, steps=record.held.steps, stop=not self._goes_on)
            self._report(self.broken_off)
            self._acknowledge()

    def _greet(self, who: str) -> None:
        """Tell somebody who has come back where their numbers go on; what a process before them kept is lost.

        That one is gone, and so all that it has sent is here.
        """
        self._take_waiting(most=2 * CAPACITY)
        self._record.flush()
        self._record.receipts.close_gap(who)
        self._acknowledge(greets=who)

    def _complain(self) -> None:
        """Nothing has come for a while: ask everybody whether something was lost on the way, and say what lacks."""
        self._ask_everybody()
        self._record.flush()
        self._acknowledge(lacking=self._record.receipts.lacking())
        self._quiet_since = time.monotonic()

    def _ask_everybody(self) -> None:
        """For the messages that we do not hold; they come as samples."""
        for who in self._publishers:
            self._ask(who)

    def _ask(self, who: str) -> None:
        self._bus.request_replay(who, first=self._record.receipts.received.get(who, 0))

    def _acknowledge(self, *, lacking: list[str] | None = None, closed: bool = False, greets: str = "") -> None:
        receipts = self._record.receipts
        self._acknowledged = self._bus.step = receipts.complete
        self._bus.acknowledge(
            Acknowledged(
                steps=receipts.complete,
                messages=self._record.held.messages if self.broken_off is not None else receipts.messages,
                missing=sum(map(receipts.missing, receipts.reached)),
                received=receipts.received,
                reached=receipts.reached,
                lost=sum(receipts.lost.values()),
                lacking=lacking or [],
                closed=closed,
                broken_off=self.broken_off,
                greets=greets,
            )
        )


def _facts(run: str, gains: Gains, start: Control) -> dict[str, str]:
    """Metadata of the run."""
    packages = ("peakmesh", "numpy", "eclipse-zenoh", "pydantic", "mcap")
    return {
        "run": run,
        "problem": gains.problem.name,
        "problem_digest": gains.problem_digest,
        "gains": gains.digest(),
        "seed": str(start.seed),
        "steps": str(start.steps),
        "window": str(start.window),
        "external": ",".join(start.external),
        **_pace(start),
        "started": datetime.now(UTC).isoformat(),
        "python": platform.python_version(),
        **{package: version(package) for package in packages},
    }


def _pace(start: Control) -> dict[str, str]:
    """What a recording tells of the clock of a paced run."""
    if not start.period:
        return {}
    pace = {"period": start.period, "measure_by": start.measure_by, "hear_by": start.hear_by}
    return {"identity": start.identity, **{name: repr(value) for name, value in pace.items()}}
