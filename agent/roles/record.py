"""What the recorder has: receipts for all that came, and on disk the messages with the evidence of their senders."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from agent.contract.closing import Closing
from agent.contract.errors import InputError, RecordingFailed
from agent.contract.gains import Gains
from agent.contract.keys import EVIDENCE, decode, model_of, sender_of
from agent.contract.messages import Account, Event, Evidence, Stamp, digest_of
from agent.contract.recording import Logged
from agent.contract.recording.evidence.chains import Chains
from agent.contract.recording.ranges import in_ranges
from agent.contract.recording.resumption import Cut
from agent.contract.recording.writer import RecordingWriter, Split
from agent.receipts import Receipts


class Held(NamedTuple):
    """What the file holds for sure: every message of the first `steps`, and so many messages in all."""

    steps: int = 0
    messages: int = 0


class Record(Closing):
    """A recording that is being written.

    Where that fails, `failure` says why; from then on there are receipts for what comes, but nothing is written.
    """

    def __init__(
        self,
        path: Path,
        *,
        run: dict[str, str],
        gains: Gains,
        force: bool,
        split: Split,
        paced: bool = False,
        cut: Cut | None = None,
    ) -> None:
        """`cut` is what a recorder before this one has left, of the same run."""
        self.receipts = Receipts(gains.problem, paced=paced)
        self.failure = ""
        self.held = Held()
        self._path, self._chains = path, Chains()
        self._before = Held()  # what the parts before this one hold
        self._blocks = 0  # of evidence
        self._writer: RecordingWriter | None = None
        with self._failing():
            if cut is None:
                self._writer = RecordingWriter(path, run=run, gains=gains, force=force, split=split)
            else:
                self._take_up(cut, run, gains, split)

    def _take_up(self, cut: Cut, run: dict[str, str], gains: Gains, split: Split) -> None:
        """Read what there is, end the part that was cut, and begin the next."""
        for logged in cut.before():
            self._again(logged)
        for _ in self._chains.rest():
            pass  # the evidence of those parts stands in them
        cut.set_aside()
        self._writer = RecordingWriter(self._path, run=run, gains=gains, split=split, first=cut.part)
        for logged in cut.messages():
            self._again(logged)
        self._next_part()
        cut.remove()

    def _again(self, logged: Logged) -> None:
        """Take in a message that an earlier recorder has recorded; what its sender says of it, it has said there."""
        model = model_of(logged.topic)
        if model in (None, Evidence):
            self._blocks += model is Evidence and self._writer is None
            return
        message = decode(logged.topic, logged.payload)
        sender = message.who if isinstance(message, Event | Account) else sender_of(logged.topic)
        sender = sender if sender.startswith("node-") else sender_of(logged.topic)
        digest = digest_of(logged.topic, logged.payload)
        stamp = Stamp(logged.number, logged.publish_time, sender, digest)
        self.take(logged.topic, logged.payload, stamp, message.step, at=logged.log_time)

    def flush(self) -> None:
        """Have the file hold all that came: who is told that it was received keeps it no longer."""
        if self._writer is not None:
            with self._failing():
                self._writer.flush()

    def take(self, topic: str, payload: bytes, stamp: Stamp | None, step: int, *, at: int | None = None) -> bool:
        """Take in a message that came `at`, or now; False where it was there already.

        Raises RunBroken for what cannot be recorded.
        """
        if not self.receipts.take(topic, step, stamp):
            return False
        if self._writer is None:
            if stamp is not None and not self.failure:  # it stands in a part that is whole
                self._chains.add(stamp, step)
            return True
        now = time.time_ns() if at is None else at
        number, published = (stamp.number, stamp.time) if stamp is not None else (0, now)
        try:
            self._writer.add(Logged(topic, payload, number, now, published))
            self._note_what_is_held()
            if stamp is not None and (evidence := self._chains.add(stamp, step)) is not None:
                self._put(evidence)
        except RecordingFailed as error:
            self._give_up(error)
        return True

    def keep_up(self) -> None:
        """Flush, and begin the next part, when it is time."""
        if self._writer is None:
            return
        with self._failing():
            self._writer.flush_when_due()
            self._note_what_is_held()
            if self._writer.part_is_full:
                self._next_part()

    def _next_part(self) -> None:
        assert self._writer is not None
        for evidence in self._chains.rest():
            self._put(evidence)
        self._writer.next_part(self._end())
        self.held = self._before = self._all

    def finish(self, *, status: str, reason: str) -> None:
        """End the recording."""
        if self._writer is None:
            return
        with self._failing():
            for evidence in self._chains.rest(last=True):
                self._put(evidence)
            self._writer.finish({"status": status, "reason": reason, **self._end()})
            self.held = self._all

    def _put(self, evidence: Evidence) -> None:
        assert self._writer is not None
        now = time.time_ns()
        self._writer.add(Logged(EVIDENCE, evidence.encode(), self._blocks, now, now))
        self._blocks += 1
        self._note_what_is_held()

    @property
    def _all(self) -> Held:
        return Held(self.receipts.complete, self.receipts.messages)

    def _note_what_is_held(self) -> None:
        if self._writer is not None and self._writer.is_flushed:
            self.held = self._all

    def _end(self) -> dict[str, str]:
        """The `end` metadata: what has come since the beginning of the run."""
        receipts = self.receipts
        end = {"steps": str(receipts.complete)}
        for who in sorted(receipts.reached):
            end[f"received.{who}"] = str(receipts.received.get(who, 0))
            end[f"reached.{who}"] = str(receipts.reached[who])
            end[f"missing.{who}"] = str(receipts.missing(who))  # before the last that is there
        end |= {f"void.{who}": in_ranges(numbers) for who, numbers in sorted(receipts.void.items()) if numbers}
        return end | {f"head.{who}": head for who, head in self._chains.heads().items()}

    @contextmanager
    def _failing(self) -> Iterator[None]:
        """A failure of the disk ends the recording, not the recorder."""
        try:
            yield
        except (RecordingFailed, InputError) as error:
            self._give_up(error)

    def _give_up(self, error: RecordingFailed | InputError) -> None:
        self.failure = self.failure or str(error)
        self._note_what_is_held()
        if isinstance(error, RecordingFailed) and error.gone:
            self.held = self._before if self._path.parent.is_dir() else Held()
        self.close()

    def close(self) -> None:
        """Let go of the file."""
        writer, self._writer = self._writer, None
        if writer is not None:
            with self._failing():
                writer.close()
