"""The recorder: writes every message to MCAP, says what it holds, and closes the recording before anybody leaves."""

from __future__ import annotations

import platform
import time
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

from agent.contract.errors import Interrupted, RunBroken
from agent.contract.gains import Gains
from agent.contract.keys import COORDINATOR, EVENT, MODE, PLANT, PLANT_STATE, decode, estimate, measurement, node_who
from agent.contract.messages import Acknowledged, Control
from agent.contract.recording import Logged
from agent.contract.recording.writer import RecordingWriter, refuse_recording
from agent.network.bus import Bus
from agent.network.session import Channel
from agent.network.words import RunClosed, Sample
from agent.receipts import Receipts
from agent.roles.joining import join

SHORTEST_PAUSE = 0.002  # s, while messages come; they wait in their channels meanwhile
LONGEST_PAUSE = 0.02  # s, while none do
IDLE_SECONDS = 0.5  # silence after which it says what it lacks


def run(bus: Bus, gains: Gains, *, path: Path, force: bool) -> None:
    """Take part as the recorder until the run has ended; raises RunBroken where it did not end well."""
    refuse_recording(path, force=force)
    names = gains.problem.node_names
    topics = [MODE, PLANT_STATE, EVENT, *map(measurement, names), *map(estimate, names)]
    channels = [bus.channel(topic) for topic in topics]
    start = join(bus, gains)
    with RecordingWriter(path, run=_facts(bus.run, gains, start), gains=gains, force=force) as writer:
        recorder = Recorder(bus, channels, gains, writer, window=start.window)
        try:
            recorder.record()
        except RunClosed as closed:
            stopped = closed.control.order == "stop"
            recorder.close(status="stopped" if stopped else "finished", reason=closed.control.reason)
            if stopped:
                raise RunBroken(closed.control.reason) from None
        except (RunBroken, Interrupted) as error:
            recorder.close(status="broken", reason=str(error))
            raise


class Recorder:
    """The open recording, and the receipts for what is in it."""

    def __init__(
        self, bus: Bus, channels: list[Channel], gains: Gains, writer: RecordingWriter, *, window: int
    ) -> None:
        self._bus, self._channels, self._writer = bus, channels, writer
        self._publishers = [COORDINATOR, PLANT, *map(node_who, gains.problem.node_names)]
        self._receipts = Receipts(gains.problem)
        self._quantum = max(1, window // 4)  # steps between acknowledgements
        self._acknowledged = 0
        self._closing = False
        self._quiet_since = time.monotonic()

    def record(self) -> None:
        """Until Bus.receive raises: the run is closed, the coordinator lost, or a signal came."""
        pause = SHORTEST_PAUSE
        while True:
            word = self._bus.receive(timeout=pause)
            if isinstance(word, Sample):  # a replay that we asked for
                self._write(word)
            pause = SHORTEST_PAUSE if self._write_waiting() else min(2.0 * pause, LONGEST_PAUSE)
            self._writer.flush_when_due()
            if time.monotonic() - self._quiet_since >= IDLE_SECONDS:
                self._complain()

    def _write_waiting(self) -> bool:
        """Write what has come, acknowledging on the way; False where there was nothing."""
        before = self._receipts.messages
        for channel in self._channels:
            for sample in channel.waiting():
                self._write(sample)
        new_steps, new_messages = self._receipts.complete - self._acknowledged, self._receipts.messages - before
        if new_steps >= self._quantum or (new_steps > 0 and new_messages == 0):
            self._acknowledge()
        return new_messages > 0

    def close(self, *, status: str, reason: str) -> None:
        """Ask everybody for what is missing, end the file, and let everybody go."""
        self._closing = True
        self._write_waiting()
        self._ask_everybody()
        for sample in self._bus.replayed(self._publishers):
            self._write(sample)
        self._write_waiting()  # what came meanwhile
        receipts = self._receipts
        end = {"status": status, "reason": reason, "steps": str(receipts.complete)}
        for who in sorted(receipts.reached):
            end[f"received.{who}"] = str(receipts.received.get(who, 0))
            end[f"reached.{who}"] = str(receipts.reached[who])
            end[f"missing.{who}"] = str(receipts.missing(who))  # before the last that is there
        self._writer.finish(end)
        self._acknowledge(closed=True)
        self._bus.wait_until_gone(self._publishers)

    def _write(self, sample: Sample) -> None:
        try:
            step = decode(sample.topic, sample.payload).step
        except RunBroken:
            if self._closing:  # no foreign message shall keep the file from being closed
                return
            raise
        if not self._receipts.take(sample.topic, step, sample.stamp):
            return
        now = time.time_ns()
        number, published = sample.stamp[:2] if sample.stamp is not None else (0, now)
        self._writer.add(Logged(sample.topic, sample.payload, number, now, published))
        self._quiet_since = time.monotonic()

    def _complain(self) -> None:
        """Nothing has come for a while: ask everybody whether something was lost on the way, and say what lacks."""
        self._ask_everybody()
        self._acknowledge(lacking=self._receipts.lacking())
        self._quiet_since = time.monotonic()

    def _ask_everybody(self) -> None:
        """For the messages that we do not hold; they come as samples."""
        for who in self._publishers:
            self._bus.request_replay(who, first=self._receipts.received.get(who, 0))

    def _acknowledge(self, *, lacking: list[str] | None = None, closed: bool = False) -> None:
        receipts = self._receipts
        self._acknowledged = receipts.complete
        self._bus.acknowledge(
            Acknowledged(
                steps=receipts.complete,
                messages=receipts.messages,
                missing=sum(map(receipts.missing, receipts.reached)),
                received=receipts.received,
                reached=receipts.reached,
                lacking=lacking or [],
                closed=closed,
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
        "started": datetime.now(UTC).isoformat(),
        "python": platform.python_version(),
        **{package: version(package) for package in packages},
    }
