"""Reads a run back, whatever tool wrote the file last: as far as it is sound, and never anything that was not written.

A file is walked twice: first over its frames, for metadata, attachments and damage (survey.py), then over its messages.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from functools import cached_property
from pathlib import Path

from agent.contract.closing import Closing
from agent.contract.errors import InputError, counted
from agent.contract.gains import Gains
from agent.contract.recording import Logged, contents, records
from agent.contract.recording.contents import Run
from agent.contract.recording.naming import Naming
from agent.contract.recording.records import Broken, Channel, RawMessage, Schema
from agent.contract.recording.source import Source
from agent.contract.recording.survey import Survey, survey

END_OF_TIME = 2**63  # ns; where times are later than this, bytes were changed
NAMED = 3  # so many damages are told, the others counted

Progress = Callable[[int, int], None]  # bytes read, of all


class RecordingReader(Closing):
    """Reads a recording, whole or cut, in one file or in several that hold parts of one run.

    `run` and `gains` are there at once; `end` is None where the run's last word is missing. What is wrong with the
    file is in `damage`, "" where nothing is, and what is odd but harmless in `notes`; both are complete after
    `messages()` has been read to its end, and so are `foreign` and `others`. `is_alone`: the files hold no other run.

    The argument `run` chooses among several runs by name or start, `gains` gives the gains file where it was left out.
    Without `needs_gains` a recording that lost its gains is read too, and `gains` is refused when it is asked for.
    """

    def __init__(
        self,
        path: Path | Source,
        *more: Path,
        run: str | None = None,
        gains: Path | None = None,
        needs_gains: bool = True,
        follows: bool = True,
    ) -> None:
        """A Source that is given is closed with the reader. Raises InputError for what is no recording.

        `follows`: the parts that come after, where they stand beside it, are read with it.
        """
        self._sources = [path] if isinstance(path, Source) else []
        self.path = path.path if isinstance(path, Source) else path
        self.paths = (self.path, *more)
        self.foreign: Counter[str] = Counter()  # messages of topics that are not of a run
        self.others = 0  # messages of the other runs in it
        self.is_unchecked = False  # no checksum covers some messages
        self._lost: list[str] = []  # what turned out to be damaged while messages were read
        several = f"{self.path} and {len(more)} more"
        self.label = label = " and ".join(map(str, self.paths)) if len(more) < 2 else several
        try:
            for one in self.paths[len(self._sources) :]:
                self._sources.append(Source(one))
            self._surveys = [survey(source) for source in self._sources]
            self._followed: list[Path] = []
            runs = contents.runs_in(self._surveys)
            self._chosen = contents.chosen(runs, run, label=label)
            while follows and self._follow():
                runs = contents.runs_in(self._surveys)
                self._chosen = contents.chosen(runs, run, label=label)
            self.is_alone = len(runs) == 1
            self.window = contents.window(self._chosen, runs, label=label)
            self._gains: Gains | None = None
            self._given = gains
            if needs_gains or gains is not None:
                _ = self.gains
        except BaseException:
            self.close()
            raise
        self.run, self.end = self._chosen.facts, self._chosen.end
        self.size = sum(source.size for source in self._sources)

    def _follow(self) -> bool:
        """Take in the next part of a run that continues, where it stands beside this file; False where none does."""
        end = self._chosen.end
        name = end.get("next", "") if end is not None and end["status"] == contents.CONTINUES else ""
        if not name or Path(name).name != name:
            return False
        here = self.path.parent
        there = [path for path in (here / name, here / f"{name}.part") if path.exists()]
        if not there or there[0] in (*self.paths, *self._followed):
            return False
        source = Source(there[0])
        self._sources.append(source)
        try:
            part = survey(source)
            if any(other.identity == self._chosen.identity for other in contents.runs_in([part])):
                self._surveys.append(part)
                self._followed.append(there[0])
                return True
        except InputError:  # it was killed before it had a head: the run ends here
            pass
        self._sources.pop().close()
        return False

    @property
    def gains(self) -> Gains:
        """Raises InputError where they were left out of the file."""
        if self._gains is None:
            self._gains = contents.find_gains(self._chosen, self._surveys, self._given, label=self.label)
        return self._gains

    @cached_property
    def _unfit(self) -> list[tuple[str, bool]]:
        return list(contents.unfit(self._chosen, self._surveys, self._gains))

    @property
    def damages(self) -> list[str]:
        """What is wrong with the files, a sentence each; each begins with the file's name where there are several."""
        found = [f"before it was recovered: {word}" for word in (self.run.get("recovered.damage"),) if word]
        for one in self._surveys:
            found += [self._of(one, sentence) for sentence in one.damage]
        found += self._lost
        found += [sentence for sentence, vouched in self._unfit if not vouched]
        if self.is_doubtful and "recovered.checksum" not in self.run:
            found.append("it was changed after it was written: it does not fit its checksum")
        return found

    @property
    def damage(self) -> str:
        """`damages` as one text; of many the first, and how many more."""
        found = self.damages
        more = [f"{len(found) - NAMED} more damages"] if len(found) > NAMED else []
        return "; ".join([*found[:NAMED], *more])

    @property
    def is_doubtful(self) -> bool:
        """A checksum over everything fails, and nothing that was found explains it: any number may be a wrong one."""
        if self.run.get("recovered.checksum") == "failed":
            return True
        explained = self._lost or any(not vouched for _, vouched in self._unfit)
        return any(one.is_contradicted and not one.damage for one in self._surveys) and not explained

    @property
    def notes(self) -> list[str]:
        """What is odd, and harms nothing."""
        found = [self._of(one, sentence) for one in self._surveys for sentence in one.notes]
        if self._followed:
            found.append(f"it goes on in {', '.join(path.name for path in self._followed)}, which was read with it")
        if self.is_unchecked:
            found.append("no checksum covers the messages: what was changed later cannot be told from what was sent")
        return found

    @property
    def strangers(self) -> list[str]:
        """Metadata and attachments of others, by name."""
        return list(dict.fromkeys(contents.strangers(self._chosen, self._surveys)))

    @property
    def faults(self) -> list[str]:
        """What was altered beside the messages."""
        told = self.run.get("recovered.faults")
        return [*(sentence for sentence, vouched in self._unfit if vouched), *([told] if told else [])]

    @property
    def attached(self) -> list[str]:
        """The names of all attachments."""
        return list(dict.fromkeys(found.name for one in self._surveys for found in one.attachments))

    def attachment(self, name: str) -> bytes | None:
        """The bytes of the first sound attachment of this name, None where there is none."""
        found = (contents.attachment(one, name) for one in self._surveys)
        return next((data for data in found if data is not None), None)

    def messages(self, report: Progress | None = None) -> Iterator[Logged]:
        """Every message of the run in the order of the files, as far as they are sound."""
        done = 0
        self._lost.clear()
        self.foreign.clear()
        self.is_unchecked = self.run.get("recovered.checksum") == "none"
        self.others = 0
        for one in self._surveys:
            yield from _Pass(self, one, done, report).messages()
            done += one.source.size

    def lose(self, one: Survey, sentence: str) -> None:
        """Enter something that turned out to be lost while messages were read."""
        self._lost.append(self._of(one, sentence))

    def _of(self, one: Survey, sentence: str) -> str:
        return f"{one.source.path}: {sentence}" if len(self._surveys) > 1 else sentence

    def close(self) -> None:
        for source in self._sources:
            source.close()


def runs_of(path: Path) -> list[Run]:
    """The runs that a file holds, by a look at its metadata. Raises InputError where it holds none."""
    source = Source(path)
    try:
        return contents.runs_in([survey(source)])
    finally:
        source.close()


class _Pass:
    """One pass over the messages of one file."""

    def __init__(self, reader: RecordingReader, one: Survey, done: int, report: Progress | None) -> None:
        self._reader, self._survey, self._source = reader, one, one.source
        self._done, self._report = done, report
        self._naming = Naming(one)
        self._channels: dict[int, Channel] = {}
        self._topics: dict[int, str] = {}  # of a channel of the run
        self._chunks = self._orphans = self._timeless = 0

    def messages(self) -> Iterator[Logged]:
        first, before = self._reader.window
        topics, of_tuple = self._topics, tuple.__new__  # half the time of Logged(...)
        for channel, sequence, log_time, publish_time, data in self._raw():
            topic = topics.get(channel) or self._unlearned(channel)
            if topic is None:
                continue
            if log_time >= END_OF_TIME or publish_time >= END_OF_TIME:
                self._timeless += 1
            elif first <= log_time < before:
                yield of_tuple(Logged, (topic, data, sequence, log_time, publish_time))
            else:
                self._reader.others += 1
        if self._timeless:
            self._reader.lose(self._survey, f"{counted(self._timeless, 'message')} have times that no clock gives")
        if self._orphans:
            self._reader.lose(self._survey, f"{counted(self._orphans, 'message')} are of channels not described in it")

    def _raw(self) -> Iterator[RawMessage]:
        """Every message of the sound stretches, in the order of the file."""
        for frame in self._survey.frames():
            if frame.opcode == records.MESSAGE and self._survey.has_loose:
                self._reader.is_unchecked |= not self._survey.is_covered
                yield records.message_of(self._survey.body(frame))
            elif frame.opcode == records.CHUNK:
                yield from self._chunk(self._survey.body(frame))
            elif frame.opcode == records.CHANNEL:
                self._learn(records.channel_of(self._survey.body(frame)))
            elif frame.opcode == 0:
                self._channels.clear()
                self._topics.clear()
            if self._report is not None:
                self._report(self._done + frame.start, self._reader.size)

    def _chunk(self, body: bytes) -> Iterator[RawMessage]:
        self._chunks += 1
        try:
            chunk = records.chunk_of(body)
            self._reader.is_unchecked |= not chunk.crc and not self._survey.is_covered
            for record in records.records_in(records.unpacked(chunk)):
                if isinstance(record, Channel):
                    self._learn(record)
                elif isinstance(record, Schema):
                    self._naming.learn(record)
                else:
                    yield record
        except Broken as error:
            of = f"chunk {self._chunks} of {self._survey.chunks}"
            self._reader.lose(self._survey, f"{of} {error}; its messages are lost")

    def _learn(self, channel: Channel) -> None:
        self._channels[channel.id] = channel
        topic = self._naming.topic(channel)
        if topic is None:
            self._topics.pop(channel.id, None)
        else:
            self._topics[channel.id] = topic

    def _unlearned(self, number: int) -> str | None:
        """The topic of a channel that the file's index alone describes; None after counting a message of another."""
        if number not in self._channels:
            described = self._naming.described(number)
            if described is None:
                self._orphans += 1
                return None
            self._learn(described)
            if number in self._topics:
                return self._topics[number]
        self._reader.foreign[self._channels[number].topic] += 1
        return None
