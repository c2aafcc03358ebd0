"""Whether the messages of a recording are those that were sent, judged by the evidence in it (see `evidence`).

Tools that rewrite logs sort them, leave topics out, split and join files, and number the messages anew. None of that
may be called a fault: a message is known by its content first and by its number second, what there is no evidence
for is said to be unchecked, and what is absent is only counted.
"""

from __future__ import annotations

from collections.abc import Container, Iterable, Iterator, Mapping
from typing import NamedTuple

from pydantic import ValidationError

from agent.contract.errors import counted
from agent.contract.keys import EVIDENCE, in_words, sender_of
from agent.contract.messages import Evidence, digest_of
from agent.contract.recording import Logged
from agent.contract.recording.evidence.sender import Absent, Block, Finding, Seen, Sender

MOST = 100_000  # messages that are kept, about 40 MB; where more wait for their evidence, those of some senders go
OFTEN = 4096  # after so many messages that is looked at
_SEEN = tuple.__new__  # half the time of Seen(...)
FEW = 3  # senders are named, of more the number is


class Findings(NamedTuple):
    """What the evidence says: `checked` messages are what was sent, `total` are not.

    `wrong` names the first of these, of every sender. `absent` accuses nobody: a file may be a part of a recording.
    `unchecked` says in sentences what there is no evidence for, or what cannot be told from it.
    """

    checked: int
    total: int
    wrong: tuple[Finding, ...]
    absent: tuple[Absent, ...]
    unchecked: tuple[str, ...]


def examine(messages: Iterable[tuple[Logged, int]], *, external: Container[str], end: Mapping[str, str]) -> Findings:
    """The findings about all messages of one run, each given with its step; see Examiner."""
    examiner = Examiner(external=external)
    for logged, step in messages:
        examiner.take(logged, step)
    return examiner.finish(end)


class Examiner:
    """Takes the messages of one run, in any order and from any number of files, and holds them against the evidence.

    In the order of writing it keeps only what has no evidence yet; in others more, and of very long ones not all can
    be checked. `external` names the nodes whose measurements come from a sensor.
    """

    def __init__(self, *, external: Container[str] = ()) -> None:
        self._external = external
        self._senders: dict[str, Sender] = {}
        self._of_topic: dict[tuple[str, str], Sender] = {}
        self._taken = self._unreadable = 0

    def take(self, logged: Logged, step: int, who: str = "") -> None:
        """Take in a message of step `step`, or evidence; -1 where a message does not say its step.

        `who` sent it, where the topic does not tell.
        """
        topic = logged.topic
        if topic == EVIDENCE:
            self._learn(logged.payload)
            return
        sender = self._of_topic.get((topic, who))
        if sender is None:
            sender = self._sender(who or sender_of(topic, external=self._external))
            self._of_topic[topic, who] = sender
            sender.topics.add(topic)
        sender.take(_SEEN(Seen, (logged.number, topic, step, digest_of(topic, logged.payload))))
        self._taken += 1
        if self._taken % OFTEN == 0:
            self._unburden()

    def _unburden(self) -> None:
        """Keep no more than `MOST` messages: the sender with the most gives up, mostly one without any evidence."""
        senders = sorted(self._senders.values(), key=lambda sender: sender.held)
        held = sum(sender.held for sender in senders)
        while held > MOST:
            most = senders.pop()
            held -= most.held
            most.give_up()

    def _learn(self, payload: bytes) -> None:
        try:
            evidence = Evidence.decode(payload)
        except ValidationError:
            self._unreadable += 1
            return
        self._sender(evidence.who).learn(evidence.first, Block.of(evidence))

    def finish(self, end: Mapping[str, str]) -> Findings:
        """The findings, after the last message; `end` is the metadata of that name, empty where it is missing."""
        senders = [sender for _, sender in sorted(self._senders.items())]
        for sender in senders:
            sender.settle()
        is_renumbered = any(sender.is_renumbered for sender in senders)
        for sender in senders:  # a tool that numbers anew does so with everybody's messages
            sender.is_renumbered = is_renumbered
            sender.judge(end.get(f"head.{sender.who}", "") if end.get("status") != "continues" else "")
        return Findings(
            checked=sum(sender.checked for sender in senders),
            total=sum(sender.total for sender in senders),
            wrong=tuple(finding for sender in senders for finding in sender.wrong),
            absent=tuple(sender.absences() for sender in senders if sender.absent),
            unchecked=tuple(self._unchecked(senders)),
        )

    @property
    def whole(self) -> dict[str, int]:
        """After `finish`: senders of whom every message that was recorded is there as it was sent, and how many."""
        return {who: sender.checked for who, sender in self._senders.items() if sender.is_whole}

    def _unchecked(self, senders: list[Sender]) -> Iterator[str]:
        if not any(sender.has_evidence for sender in senders):
            yield "no message is checked against its sender: the recording has no evidence"
            return
        for reason, some in (
            ("there is no evidence", [s for s in senders if not s.has_two_runs and not s.has_given_up]),
            ("the evidence is of two different runs", [s for s in senders if s.has_two_runs]),
            ("there is no evidence, or it stands too far away,", [s for s in senders if s.has_given_up]),
        ):
            if messages := sum(sender.unchecked for sender in some):
                of = _named([sender for sender in some if sender.unchecked])
                yield f"{reason} for {counted(messages, 'message')} of {of}"
        if any(sender.is_renumbered for sender in senders):
            yield "the senders' numbers were rewritten; messages are known by content alone"
        if self._unreadable:
            yield f"{counted(self._unreadable, 'message')} of evidence cannot be read"

    def _sender(self, who: str) -> Sender:
        if who not in self._senders:
            self._senders[who] = Sender(who)
        return self._senders[who]


def _named(senders: list[Sender]) -> str:
    names = [in_words(sender.who) for sender in senders]
    return ", ".join(names) if len(names) <= FEW else f"{len(names)} senders"
