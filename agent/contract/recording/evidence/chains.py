"""The recorder's side of the evidence: what each sender says of its messages, gathered and chained."""

from __future__ import annotations

from collections.abc import Iterator

from agent.contract.messages import Evidence, Stamp
from agent.contract.recording.evidence import BLOCK, FIRST_HEAD, NO_DIGEST, SHORT, next_head


class Chains:
    """The digests of all senders, each in the order of its numbers."""

    def __init__(self) -> None:
        self._chains: dict[str, _Chain] = {}

    def add(self, stamp: Stamp, step: int) -> Evidence | None:
        """Enter a message that was not there before; returns the evidence that is complete with it."""
        chain = self._chains.get(stamp.sender)
        if chain is None:
            chain = self._chains[stamp.sender] = _Chain(stamp.sender)
        return chain.add(stamp.number, stamp.digest, step)

    def rest(self, *, last: bool = False) -> Iterator[Evidence]:
        """Evidence of what is not in any yet; of what came after a gap too, where no more messages will come."""
        for chain in self._chains.values():
            yield from chain.rest(last=last)

    def heads(self) -> dict[str, str]:
        """The head of every sender that gives digests, in hexadecimal."""
        return {who: chain.head.hex() for who, chain in self._chains.items() if chain.head != FIRST_HEAD}


class _Chain:
    """One sender's digests since its last evidence, and the head over all."""

    def __init__(self, who: str) -> None:
        self.head = FIRST_HEAD
        self._who, self._first, self._step = who, 0, 0
        self._digests: list[bytes] = []
        self._early: dict[int, bytes] = {}  # of numbers that came before their turn

    def add(self, number: int, digest: bytes, step: int) -> Evidence | None:
        if step > self._step:
            self._step = step
        if number != self._first + len(self._digests):
            self._early[number] = digest
            return None
        self._enter(digest)
        while self._early and (digest_next := self._early.pop(self._first + len(self._digests), None)) is not None:
            self._enter(digest_next)
        return self._block() if len(self._digests) >= BLOCK else None

    def rest(self, *, last: bool) -> Iterator[Evidence]:
        if (block := self._block()) is not None:
            yield block
        if not last:
            return
        for number, digest in sorted(self._early.items()):
            if number != self._first + len(self._digests) or len(self._digests) >= BLOCK:
                if (block := self._block()) is not None:
                    yield block
                self._first = number
            self._enter(digest)
        if (block := self._block()) is not None:
            yield block

    def _enter(self, digest: bytes) -> None:
        self._digests.append(digest)
        if digest:
            self.head = next_head(self.head, digest)

    def _block(self) -> Evidence | None:
        """What has gathered; None where nothing did, or no digest is among it."""
        first, digests = self._first, self._digests
        self._first, self._digests = first + len(digests), []
        if not any(digests):
            return None
        texts = "".join([digest[:SHORT].hex() or NO_DIGEST for digest in digests])
        return Evidence(step=self._step, who=self._who, first=first, digests=texts, head=self.head.hex())
