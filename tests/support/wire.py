"""What one node of a run hears and says, as it is on the wire: files that our own node is held to, and others.

A line for each message, word and token, in order, with tabs between: `<` for what the node hears and `>` for what it
says, the key, the payload, and the attachment in hexadecimal. Of a token there is the key alone.

python tests/support/wire.py writes those in tests/wire/ anew.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any, NamedTuple

from agent.conform.play import Play
from agent.contract.gains import Gains
from agent.contract.keys import (
    ACKNOWLEDGED,
    CONTROL,
    COORDINATOR,
    MODE,
    PLANT,
    RECORDER,
    alive,
    estimate,
    joining,
    key,
    measurement,
    node_who,
    ready,
    session,
    topic_of,
)
from agent.contract.messages import Acknowledged, Control, Joining, Message, Ready, Stamp, Word, tag_of
from agent.network.configuration import Network
from agent.network.links import linked
from agent.network.outbox import Outbox, Sent
from agent.network.words import ChannelClosed, Duty, Sample

FOLDER = Path(__file__).parents[1] / "wire"
GOLDEN = Path(__file__).parents[2] / "recordings" / "golden"
EXAMPLES = ("zhu2020-ideal", "zhu2020-lossy")
RUN, NODE, STEPS, SEED = "wire", "2", 16, 3
OURS, THEIRS = "00000000000000000002-node", "00000000000000000001-others"  # sessions
VERSION = "0.1.0"  # in the files; whichever it is in a run
LEASE = 20.0
TICK = 1_000_000  # ns by the senders' clocks, from one message to the next


class Line(NamedTuple):
    """Something that the node hears, or says."""

    is_said: bool
    topic: str
    payload: bytes = b""
    attachment: bytes = b""

    def text(self) -> str:
        return "\t".join(
            (">" if self.is_said else "<", key(RUN, self.topic), self.payload.decode(), self.attachment.hex())
        )


def file_of(example: str) -> Path:
    return FOLDER / f"{example}.wire"


def read(path: Path) -> list[Line]:
    lines = []
    for text in path.read_text().splitlines():
        sign, where, payload, attachment = text.split("\t")
        lines.append(Line(sign == ">", topic_of(where), payload.encode(), bytes.fromhex(attachment)))
    return lines


def made(gains: Gains) -> Iterator[Line]:
    """By what messages are made of, without a network: the whole run of node NODE."""
    others = [who for who in linked(gains.problem, node_who(NODE)) if who not in (COORDINATOR, RECORDER)]
    play, speaking = Play(gains, steps=STEPS, seed=SEED), _Speaking()
    who, hears = node_who(NODE), [gains.problem.node_names[j] for j in gains.problem.ever_heard(_place(gains))]
    for topic in (session(who, OURS), alive(who)):
        yield Line(True, topic)
    yield Line(False, session(COORDINATOR, THEIRS))
    lacks = sorted({RECORDER, *others} - {PLANT})
    said = Joining(who=who, version=VERSION, listen="none", machine="", lease=LEASE, lacks=[COORDINATOR, *lacks])
    yield speaking.word(joining(who), said, number=0)
    yield from (Line(False, session(other, THEIRS)) for other in [*sorted(others), RECORDER])
    yield speaking.word(ready(who), Ready(who=who, gains=gains.digest()), number=1)
    yield speaking.word(CONTROL, _control("start", cast={who: OURS}), number=0)
    for k in range(STEPS):
        yield speaking.message(COORDINATOR, MODE, play.modes[k])
        yield speaking.message(PLANT, measurement(NODE), play.measurements[NODE][k])
        yield speaking.message(who, estimate(NODE), play.estimates[NODE][k])
        for name in hears:
            if name != NODE:
                yield speaking.message(node_who(name), estimate(name), play.estimates[name][k])
    yield speaking.word(CONTROL, _control("close"), number=1)
    every = {"messages": 0, "missing": 0, "reached": {}, "lacking": []}
    last = Acknowledged(steps=STEPS, received={who: STEPS}, closed=True, **every)
    yield speaking.word(ACKNOWLEDGED, last, number=2)


def _place(gains: Gains) -> int:
    return gains.problem.node_index(NODE)


def _control(order: str, **more: Any) -> Control:
    facts: dict[str, Any] = {"steps": STEPS, "seed": SEED, "window": 32, "external": [], "reason": ""}
    return Control.model_validate({"order": order, "version": VERSION, **facts, **more})


class _Speaking:
    """Everybody's numbers and clocks."""

    def __init__(self) -> None:
        self._outboxes: dict[str, Outbox] = {}

    def word(self, topic: str, word: Word, *, number: int) -> Line:
        is_said = topic in (joining(node_who(NODE)), ready(node_who(NODE)))
        signed = word.model_copy(update={"session": OURS if is_said else THEIRS, "number": number})
        return Line(is_said, topic, signed.model_dump_json().encode())

    def message(self, who: str, topic: str, message: Message) -> Line:
        is_said = who == node_who(NODE)
        outbox = self._outboxes.setdefault(who, Outbox(who, session=tag_of(OURS if is_said else THEIRS)))
        sent = outbox.add(topic, message.encode())
        return Line(is_said, topic, sent.payload, sent.stamp._replace(time=sent.stamp.number * TICK).encode())


class _Channel:
    def __init__(self, topic: str) -> None:
        self.topic, self.waiting = topic, SimpleQueue[Sample | None]()

    def next(self) -> Sample:
        sample = self.waiting.get()
        if sample is None:
            raise ChannelClosed
        return sample

    def take(self) -> Sample | None:
        try:
            return self.waiting.get_nowait()
        except Empty:
            return None


class Scripted:
    """A session of our own node to which a file is the network: a line comes once it has said all that is before."""

    identity = OURS
    traced = False

    def __init__(self, lines: list[Line], hand_over: Callable[[Duty], None]) -> None:
        self.lines, self.said = lines, list[Line]()
        self._hand_over, self._next = hand_over, 0
        self._channels: dict[str, _Channel] = {}
        self._words: dict[str, Callable[[bytes], Any]] = {}
        self._see: Callable[[str, str, bool], None] = lambda who, session, present: None

    @classmethod
    def of(cls, lines: list[Line]) -> Callable[..., Any]:
        """What a Bus opens."""

        def opened(network: Network, *, run: str, who: str, hand_over: Callable[[Duty], None]) -> Scripted:
            return cls(lines, hand_over)

        return opened

    def channel(self, topic: str) -> _Channel:
        return self._channels.setdefault(topic, _Channel(topic))

    def listen(self, topic: str, decode: Callable[[bytes], Any], *, overflow: Callable[[], None]) -> None:
        self._words[topic] = decode

    def watch(self, see: Callable[[str, str, bool], None]) -> None:
        self._see = see

    def appear(self, who: str) -> None:
        self._see(who, OURS, True)
        self._say(Line(True, session(who, OURS)), Line(True, alive(who)))

    def say(self, topic: str, payload: bytes) -> None:
        self._say(Line(True, topic, payload))

    def publish(self, sent: Sent) -> None:
        stamp = sent.stamp._replace(time=sent.stamp.number * TICK)
        self._say(Line(True, sent.topic, sent.payload, stamp.encode()))

    def close(self) -> None:
        for channel in self._channels.values():
            channel.waiting.put(None)

    def __getattr__(self, name: str) -> Any:
        return lambda *arguments, **more: None

    def _say(self, *lines: Line) -> None:
        self.said += lines
        self._next += len(lines)
        while self._next < len(self.lines) and not (line := self.lines[self._next]).is_said:
            self._next += 1
            self._hear(line)

    def _hear(self, line: Line) -> None:
        if line.topic.startswith("session/"):
            _, who, identity = line.topic.split("/")
            self._see(who, identity, True)
        elif line.topic in self._words:
            decode = self._words[line.topic]
            self._hand_over(lambda: decode(line.payload))
        else:
            sample = Sample(line.topic, line.payload, Stamp.decode(line.attachment))
            self._channels[line.topic].waiting.put(sample)


def write() -> None:
    FOLDER.mkdir(exist_ok=True)
    for example in EXAMPLES:
        gains = Gains.load(GOLDEN / f"{example}.gains.json")
        file_of(example).write_text("".join(f"{line.text()}\n" for line in made(gains)))


if __name__ == "__main__":
    write()
