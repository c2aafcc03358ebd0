"""One sender's messages in a recording, held against what it said of them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple, Self

from agent.contract.keys import in_words
from agent.contract.messages import Evidence
from agent.contract.recording.evidence import FIRST_HEAD, NO_DIGEST, SHORT, next_head

NAMED = 20  # so many findings of a sender are named


class Finding(NamedTuple):
    """A message that is not what was sent. `kind`: "altered", "inserted", "exchanged", or "chain" for a whole block.

    `number` is what the file says; topic and step are "" and -1 for a block, and the step also where it is not known.
    """

    kind: str
    who: str
    number: int
    topic: str
    step: int
    detail: str

    def __str__(self) -> str:
        place = f" ({self.topic}, step {self.step})" if self.topic else ""
        return f"{in_words(self.who)}, number {self.number}{place}: {self.detail}"


class Absent(NamedTuple):
    """Messages that were sent and recorded, and are not in the file: how many, and the numbers of the first."""

    who: str
    total: int
    first: tuple[int, ...]
    topic: str  # "" where the file has several topics of the sender, or none


class Seen(NamedTuple):
    """A message of the file."""

    number: int
    topic: str
    step: int
    digest: bytes


class Block(NamedTuple):
    """Evidence of some messages: the kept bytes of their digests, but for those at the places `without`."""

    shorts: bytes
    without: tuple[int, ...]
    head: bytes

    @classmethod
    def of(cls, evidence: Evidence) -> Self:
        width, digests = len(NO_DIGEST), evidence.digests
        places = range(len(digests) // width)
        without = tuple(place for place in places if digests.startswith(NO_DIGEST, width * place))
        return cls(bytes.fromhex(digests.replace("-", "0")), without, bytes.fromhex(evidence.head))

    @property
    def length(self) -> int:
        return len(self.shorts) // SHORT

    def rows(self) -> Iterator[tuple[int, bytes]]:
        """Place and kept bytes of every digest."""
        for place in range(self.length):
            if place not in self.without:
                yield place, self.shorts[SHORT * place : SHORT * (place + 1)]


class Sender:
    """What the file has of one sender, and what it should have."""

    def __init__(self, who: str) -> None:
        self.who = who
        self.topics: set[str] = set()
        self.taken = self.held = 0  # messages, and those of them that wait for evidence
        self.checked = self.total = 0
        self.wrong: list[Finding] = []
        self.absent: set[int] = set()  # numbers that evidence has and the file, so far, has not
        self.unchecked = 0  # messages that there is no evidence for, or that it cannot be held against
        self.is_renumbered = self.has_two_runs = self.has_given_up = False
        self.is_whole = False  # every message that was recorded is there, and is what was sent
        self._waiting: dict[bytes, list[Seen]] = {}  # by the bytes of their digest that evidence will have
        self._blocks: dict[int, Block] = {}  # by their first number
        self._next, self._head = 0, FIRST_HEAD  # the number after the last block, and the head there
        self._moves = _Moves()
        self._left: list[tuple[Seen, bool]] = []  # what has no evidence in the end, and whether it is a copy

    @property
    def has_evidence(self) -> bool:
        return bool(self._blocks)

    def take(self, seen: Seen) -> None:
        """Have a message wait for its evidence."""
        self.taken += 1
        if not self.has_given_up:
            self.held += 1
            self._waiting.setdefault(seen.digest[:SHORT], []).append(seen)

    def give_up(self) -> None:
        """Judge neither what waits nor what is to come."""
        self.has_given_up, self.held = True, 0
        self._waiting.clear()

    def learn(self, first: int, block: Block) -> None:
        """Hold what waits against the evidence of the messages from number `first` on."""
        known = self._blocks.setdefault(first, block)
        self.has_two_runs |= known != block
        digests: list[bytes] = []
        for place, short in block.rows() if not self.has_given_up else ():
            seen = self._claim(short, first + place)
            if seen is not None:
                digests.append(seen.digest)
                self.checked += known is block or first + place in self.absent
                self.absent.discard(first + place)
            elif known is block:
                self.absent.add(first + place)
        if known is block:
            self._follow(first, block, digests)

    def _claim(self, short: bytes, number: int) -> Seen | None:
        """The message that such evidence is about; copies of it that wait are as good, and go too."""
        group = self._waiting.pop(short, None)
        if group is None:
            return None
        if len(group) == 1 and group[0].number == number:  # nearly always
            self.held -= 1
            return group[0]
        chosen = next((seen for seen in group if seen.number == number), group[0])
        others = [seen for seen in group if seen != chosen]
        if others:
            self._waiting[short] = others
        self.held -= len(group) - len(others)
        self._moves.add(chosen, number)
        return chosen

    def _follow(self, first: int, block: Block, digests: list[bytes]) -> None:
        """Hold a block's head against the whole digests, where all are there and the head before is known."""
        last = first + block.length - 1
        if first == self._next and len(digests) == block.length - len(block.without):
            head = self._head
            for digest in digests:
                head = next_head(head, digest)
            if head != block.head:
                detail = f"from here to number {last} at least one is altered: together they do not fit their chain"
                self._accuse(Finding("chain", self.who, first, "", -1, detail))
        self._next, self._head = last + 1, block.head

    def _accuse(self, finding: Finding) -> None:
        self.total += 1
        if len(self.wrong) < NAMED:
            self.wrong.append(finding)

    def settle(self) -> None:
        """When everything has been taken in: find the evidence of what came after it, and see whose numbers these are.

        To be followed by `judge`, once it is known whether a tool has numbered the messages of anybody anew.
        """
        if self.has_two_runs:
            self.checked, self.total, self.wrong = 0, 0, []
        if self.has_two_runs or self.has_given_up:
            self.unchecked = self.taken - self.checked
            self.absent.clear()
            return
        self._left = self._settle()
        self.is_renumbered = self._moves.rewritten(self.checked)

    def judge(self, end_head: str) -> None:
        """Judge what is left; `end_head` is the chain's last, "" if not known."""
        if self.has_two_runs or self.has_given_up:
            return
        sent = self._sent(end_head)
        for seen, copy in self._left:
            if copy and (self.is_renumbered or seen.number not in self.absent):
                continue  # the true one is there too
            kind = self._fault(seen, sent)
            if kind is None:
                self.unchecked += 1
            else:
                self._accuse(Finding(kind, self.who, seen.number, seen.topic, seen.step, _DETAILS[kind]))
        if not self.is_renumbered:
            self.total += self._moves.total - len(self._moves.named)
            for seen, number in self._moves.named:
                detail = f"exchanged: it was sent as number {number}"
                self._accuse(Finding("exchanged", self.who, seen.number, seen.topic, seen.step, detail))

        last = self._blocks[max(self._blocks)].head.hex() if self._blocks else ""
        self.is_whole = bool(end_head) and last == end_head and not (self.total or self.absent or self.unchecked)

    def absences(self) -> Absent:
        """What is absent, for Findings."""
        topic = next(iter(self.topics)) if len(self.topics) == 1 else ""
        return Absent(self.who, len(self.absent), tuple(sorted(self.absent)[:NAMED]), topic)

    def _settle(self) -> list[tuple[Seen, bool]]:
        """Settle what came after its evidence; what is left, and whether it is a copy of a message that is there."""
        homes: dict[bytes, list[int]] = {}
        for first, block in self._blocks.items() if self._waiting else ():
            for place, short in block.rows():
                if short in self._waiting:
                    homes.setdefault(short, []).append(first + place)
        left = []
        for seen in sorted(seen for group in self._waiting.values() for seen in group):
            numbers = homes.get(seen.digest[:SHORT], [])
            free = [number for number in numbers if number in self.absent]
            if free:
                number = seen.number if seen.number in free else free[0]
                self.absent.discard(number)
                self.checked += 1
                self._moves.add(seen, number)
            else:
                left.append((seen, bool(numbers)))
        return left

    def _fault(self, seen: Seen, sent: int | None) -> str | None:
        """What is wrong with a message that no digest fits; None where the evidence does not reach it."""
        if self.is_renumbered:
            return "altered" if sent is not None else None
        if seen.number in self.absent:
            self.absent.discard(seen.number)
            return "altered"
        first = max((first for first in self._blocks if first <= seen.number), default=None)
        if first is not None:
            block, place = self._blocks[first], seen.number - first
            if place < block.length and place not in block.without:
                return "inserted"
        return "inserted" if sent is not None and seen.number >= sent else None

    def _sent(self, end_head: str) -> int | None:
        """How many messages the sender sent; None where the evidence has a hole, or no end."""
        reached, head = 0, b""
        for first, block in sorted(self._blocks.items()):
            if first != reached:
                return None
            reached, head = first + block.length, block.head
        return reached if end_head and head.hex() == end_head else None


_DETAILS = {
    "altered": "altered: it is not what its sender says it sent",
    "inserted": "put in: its sender gave this number to another message, or to none",
}


class _Moves:
    """Messages that stand under another number than they were sent with."""

    def __init__(self) -> None:
        self.named: list[tuple[Seen, int]] = []  # the first of them, with the numbers they were sent with
        self.total = 0
        self._differences = 0, 0  # sums over all, of the numbers and of their squares

    def add(self, seen: Seen, number: int) -> None:
        """Note under which number the message was sent."""
        if seen.number == number:
            return
        self.total += 1
        first, second = self._differences
        self._differences = first + seen.number - number, second + seen.number**2 - number**2
        if len(self.named) < NAMED:
            self.named.append((seen, number))

    def rewritten(self, checked: int) -> bool:
        """Whether a tool numbered the messages anew: most have moved, or not onto each other's places."""
        return self.total > 0 and (2 * self.total > checked or self._differences != (0, 0))
