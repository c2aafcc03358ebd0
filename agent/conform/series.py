"""What is tried, by name, and how it went."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

from agent.conform.judge import Difference
from agent.conform.lockstep import deserted, interrupted, later, namesake, stopped
from agent.conform.paced import FATES, joined_late, paced
from agent.conform.trial import Setting

STEPS = len(FATES)
SEED = 1
Try = Callable[[Setting], str]
# every network is tried whole; these in one of them
MORE: dict[str, tuple[str, Try]] = {
    "later": ("messages of a later version, with a field more", later),
    "twice": ("the run begins with another of its name", namesake),
    "stop": ("the coordinator stops the run", stopped),
    "signal": ("the program is asked to end", interrupted),
    "lost": ("everybody else is lost", deserted),
    "paced": ("against the clock, with faults", paced),
    "again": ("against the clock, begun in the middle", joined_late),
}


@dataclass(frozen=True)
class Result:
    """Of one trial: `says` is a sentence, of the first difference where it was not passed, the rest its parts."""

    trial: str
    what: str
    passed: bool
    says: str
    step: int | None = None
    field: str = ""
    value: Any = None
    wanted: Any = None

    def document(self) -> dict[str, Any]:
        """For --json: what there is of it."""
        return {name: value for name, value in asdict(self).items() if value not in (None, "")}

    def text(self) -> str:
        return f"{'pass' if self.passed else 'FAIL'}  {self.trial:<8} {self.what}: {self.says}"


def tried(trial: str, what: str, attempt: Try, setting: Setting) -> Result:
    """Raises InputError where the program cannot be started."""
    try:
        return Result(trial, what, True, attempt(setting))
    except Difference as found:
        return Result(trial, what, False, found.says, found.step, found.field, found.value, found.wanted)
