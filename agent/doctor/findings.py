"""What a look has found, and all of it for people."""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum
from typing import NamedTuple


class State(StrEnum):
    """How bad it is."""

    GOOD = "good"
    ABSENT = "absent"  # not there, and not needed for a run
    WARNING = "warning"  # a run may go on all the same
    WRONG = "wrong"  # a run, or this part in it, will fail


class Finding(NamedTuple):
    """What was looked at, how it is, and where that is not good what would help."""

    what: str
    state: State
    said: str

    def document(self) -> dict[str, str]:
        """For --json."""
        return {"what": self.what, "state": self.state.value, "said": self.said}


def text(findings: Sequence[Finding]) -> str:
    """A line for each, and one of all."""
    wide = max(len(finding.what) for finding in findings)
    lines = [f"{finding.state.value:8} {finding.what:{wide}}  {finding.said}" for finding in findings]
    wrong = [finding.what for finding in findings if finding.state is State.WRONG]
    return "\n".join(
        [*lines, f"{', '.join(wrong)}: a run would fail" if wrong else "nothing stands in the way of a run"]
    )
