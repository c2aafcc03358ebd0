"""What a comparison of two recordings found: a value, its JSON, and its text for people."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from agent.contract.errors import EXIT_GOOD, EXIT_NO
from agent.contract.keys import MODE, PLANT_STATE

DRAWS = {  # what the seed decides, and the fields that show it
    "modes": (MODE, "mode"),
    "losses": (PLANT_STATE, "arrived"),
    "disturbance": (PLANT_STATE, "w"),
    "deliveries": ("/estimate", "heard"),
}


@dataclass
class Gap:
    """One field of one topic: how many messages were compared and differ, and by how much at most.

    Relative to the larger of both numbers; `ulp` counts the float64 numbers from one to the other, 1 for neighbours.
    Words, whole numbers and vectors of different lengths only differ or do not.
    """

    compared: int = 0
    differ: int = 0
    absolute: float = 0.0
    relative: float = 0.0
    ulp: int = 0


class Difference(NamedTuple):
    """A place where two recordings differ."""

    step: int
    topic: str
    field: str  # with its place in a vector, "x_hat[1]"; "" where one recording lacks the message
    a: Any
    b: Any
    ulp: int | None  # None for what is no float64

    def text(self) -> str:
        if not self.field:
            lacking = "first" if self.a is None else "second"
            return f"step {self.step}, {self.topic}: not in the {lacking}"
        apart = "" if self.ulp is None else f", {self.ulp} ulp apart"
        return f"step {self.step}, {self.topic}, {self.field}: {_shown(self.a)} and {_shown(self.b)}{apart}"


@dataclass
class Comparison:
    """The answer. `only` and `double` count messages by topic, `only` those that the other recording lacks."""

    paths: tuple[str, str]
    facts: dict[str, tuple[Any, Any]]  # of both recordings, under their names
    messages: int = 0  # compared
    gaps: dict[tuple[str, str], Gap] = field(default_factory=dict)  # by topic and field
    first: Difference | None = None  # by step, then in the order in which the messages of a step come about
    only: tuple[Counter[str], Counter[str]] = field(default_factory=lambda: (Counter(), Counter()))
    double: tuple[Counter[str], Counter[str]] = field(default_factory=lambda: (Counter(), Counter()))
    unreadable: list[str] = field(default_factory=list)
    damage: tuple[str, str] = ("", "")
    rewritten: int = 0  # messages with the same values in other bytes
    unsaid: set[str] = field(default_factory=set)  # fields that one of two messages leaves out, as the format allows

    @property
    def identical(self) -> bool:
        """The same problem, gains, seed and end, the same messages once each, and every value of them bit for bit."""
        same_facts = all(a == b for a, b in self.facts.values())
        faults = self.first or any(self.only) or any(self.double) or self.unreadable or any(self.damage)
        return same_facts and not faults

    @property
    def exit_code(self) -> int:
        return EXIT_GOOD if self.identical else EXIT_NO

    def draws(self) -> dict[str, bool | None]:
        """Of each kind of draw, whether all that was compared is equal; None where nothing was."""
        found: dict[str, bool | None] = {}
        for name, (topic, of_message) in DRAWS.items():
            gaps = [gap for (at, other), gap in self.gaps.items() if at.endswith(topic) and other == of_message]
            found[name] = not any(gap.differ for gap in gaps) if gaps else None
        return found

    def document(self) -> dict[str, Any]:
        """For --json."""
        return {
            "recordings": list(self.paths),
            "identical": self.identical,
            "same": {name: a == b for name, (a, b) in self.facts.items()},
            "facts": {name: list(both) for name, both in self.facts.items()},
            "same_draws": self.draws(),
            "compared": self.messages,
            "only": [dict(side) for side in self.only],
            "double": [dict(side) for side in self.double],
            "unreadable": self.unreadable,
            "damage": list(self.damage),
            "rewritten": self.rewritten,
            "unsaid": sorted(self.unsaid),
            "first_difference": None if self.first is None else self.first._asdict(),
            "fields": [{"topic": topic, "field": name, **vars(gap)} for (topic, name), gap in self.gaps.items()],
        }

    def text(self) -> str:
        answer = "the same run, bit for bit" if self.identical else "they differ"
        named = {True: "the same", False: "not the same", None: "none"}
        lines = [f"{self.paths[0]} and {self.paths[1]}: {answer}"]
        lines += [f"{name:12}{_both(a, b)}" for name, (a, b) in self.facts.items()]
        lines += [f"{name:12}{named[same]}" for name, same in self.draws().items()]
        lines.append(f"messages    {self.messages} compared{self._not_compared()}")
        if self.rewritten:
            lines.append(f"            {self.rewritten} of them have the same values in other bytes")
        lines += [f"            {name} is in one of the two alone, and is not compared" for name in sorted(self.unsaid)]
        for path, damage in zip(self.paths, self.damage, strict=True):
            lines += [f"damage      {path}: {damage}"] if damage else []
        lines += [f"unreadable  {fault}" for fault in self.unreadable[:5]]
        lines += [f"first difference: {self.first.text()}"] if self.first is not None else []
        return "\n".join([*lines, *self._table()])

    def _not_compared(self) -> str:
        words = ""
        for place, only, double in zip(("first", "second"), self.only, self.double, strict=True):
            words += f", {only.total()} in the {place} alone" if only else ""
            words += f", {double.total()} more than once in the {place}" if double else ""
        return words

    def _table(self) -> list[str]:
        differing = {at: gap for at, gap in self.gaps.items() if gap.differ}
        if not differing:
            return []
        width = max(len(topic) for topic, _ in differing) + 2
        lines = [f"{'topic':{width}}{'field':12}{'differ':>16}{'absolute':>12}{'relative':>12}  ulp"]
        for (topic, name), gap in differing.items():
            sizes = f"{gap.absolute:12.2e}{gap.relative:12.2e}  {gap.ulp}" if gap.ulp else ""
            lines.append(f"{topic:{width}}{name:12}{f'{gap.differ} of {gap.compared}':>16}{sizes}")
        return lines


def _both(a: Any, b: Any) -> str:
    return f"the same, {a}" if a == b else f"{a} and {b}"


def _shown(value: Any) -> str:
    return f'"{value}"' if isinstance(value, str) else repr(value)
