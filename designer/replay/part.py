"""What of a log is judged, where that is not all of it."""

from __future__ import annotations

import sys
from typing import Any, NamedTuple

from agent.contract.recording.evidence.examiner import Findings


class Part(NamedTuple):
    """Steps `first` to `last`, and one node alone where `node` is given."""

    first: int = 0
    last: int = sys.maxsize
    node: str | None = None

    def has(self, topic: str, step: int | None = None) -> bool:
        """Whether a topic belongs to it, and a step where one is given."""
        ours = self.node is None or topic.startswith(f"node/{self.node}/")
        return ours and (step is None or self.first <= step <= self.last)

    def of(self, findings: Findings) -> Findings:
        """What it has of the evidence's findings; those about many messages are in all parts."""
        if self == Part():
            return findings
        wrong = tuple(each for each in findings.wrong if not each.topic or self.has(each.topic, each.step))
        return findings._replace(total=len(wrong), wrong=wrong)

    def text(self) -> str:
        steps = f"steps {self.first} to {self.last}" if self.last < sys.maxsize else f"steps from {self.first} on"
        return steps if self.node is None else f'{steps}, node "{self.node}" alone'

    def document(self) -> dict[str, Any]:
        """For --json; None where nothing is left out."""
        last = self.last if self.last < sys.maxsize else None
        return {"from": self.first or None, "to": last, "node": self.node}
