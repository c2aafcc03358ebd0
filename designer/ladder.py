"""The ladder: floor <= exact gain <= certified gamma <= Theorem 1's, and Theorem 2's bound beside them if computed.

Every rung is a peak of the error per root of the energy of w. Theorem 2's bound lies above what its own gains really
have: that is how loose the bound is. What lies below both is what better gains are worth.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Sequence
from decimal import ROUND_CEILING, ROUND_FLOOR, Decimal, localcontext
from io import StringIO
from typing import Any, NamedTuple

from agent.contract.gains import Gains
from designer.lmi import beyond_paper

FLOOR, EXACT, CERTIFIED = "floor", "exact gain of these gains", "gamma, certified"
THEOREM1, LEAST = "what Theorem 1 certifies of these gains", "proved: no gains have less by"
FOUND_IN_BOX, PROVED_IN_BOX = "exact gain of the worst model found in the box", "proved for every model in the box"
NOMINAL, NOMINAL_IN_BOX = "exact gain of the nominal design", "the nominal design, proved for every model in the box"
_NOTHING = 1e-6  # a floor this small beside the gain says nothing


class Ladder(NamedTuple):
    """The rungs; None where one was not computed."""

    floor: float | None
    exact: tuple[float, float] | None  # the gain of these gains lies between
    gamma: float | None  # certified
    theorem2_exact: tuple[float, float] | None  # of Theorem 2's gains, where these are others
    theorem2: float | None  # its bound, as the solver gave it
    lmi: str = "Theorem 2"  # what the LMI is called: beyond the paper's model it is not Theorem 2's
    theorem1: float | None = None  # certified for these gains too, where gamma is less
    found_in_box: float | None = None  # what these gains have in the worst model of a box that was found
    proved_in_box: float | None = None  # gamma for every model of it
    theorem2_least: float | None = None  # proved: no gains have less by Theorem 2
    nominal_exact: float | None = None  # of gains that were designed without the box, where these are others
    nominal_in_box: float | None = None  # gamma of those for every model of the box
    theorem2_why_not: str | None = None  # why theorem2_least is not there, where it was looked for

    @property
    def against_theorem2(self) -> float | None:
        """gamma relative to the least that Theorem 2 can give: -0.295 is 29.5 % below it. Both are proved, or None."""
        return None if self.gamma is None or self.theorem2_least is None else self.gamma / self.theorem2_least - 1.0

    @property
    def above_floor(self) -> float | None:
        """The exact gain, or else gamma, relative to the floor; None where the floor says nothing."""
        value = self.gamma if self.exact is None else self.exact[1]
        if value is None or self.floor is None or self.floor <= _NOTHING * value:
            return None
        return value / self.floor - 1.0

    def document(self) -> dict[str, Any]:
        """The rungs and both distances, for --json."""
        return {**self._asdict(), "against_theorem2": self.against_theorem2, "above_floor": self.above_floor}

    def rungs(self) -> list[tuple[str, float]]:
        """What every rung is called, and its value, the lowest first; without those that were not computed."""
        rungs = [
            (FLOOR, self.floor),
            (NOMINAL, self.nominal_exact),
            (EXACT, self.exact[1] if self.exact is not None and self.knows_exact else None),
            (CERTIFIED, self.gamma),
            (f"exact gain of {self.lmi}'s gains", self.theorem2_exact and self.theorem2_exact[1]),
            (self.least_of_lmi, self.theorem2_least),
            (f"{self.lmi}'s bound, as a solver gave it", self.theorem2),
            (THEOREM1, self.theorem1),
            (FOUND_IN_BOX, self.found_in_box),
            (PROVED_IN_BOX, self.proved_in_box),
            (NOMINAL_IN_BOX, self.nominal_in_box),
        ]
        there = [(name, value) for name, value in rungs if value is not None]
        return sorted(there, key=lambda rung: (rung[0] != FLOOR, float(rung_text(*rung))))  # as they are read

    @property
    def knows_exact(self) -> bool:
        """Whether both ends of the exact gain are known: a lower end of 0 is one that was left out, or says nothing."""
        return self.exact is not None and (self.exact[0] > 0.0 or self.exact[1] == 0.0)

    @property
    def least_of_lmi(self) -> str:
        """What the rung is called that no gains are below by the LMI."""
        return f"{LEAST} {self.lmi}"

    def table(self, problem: str, kind: str) -> str:
        """The rungs as `as_table` writes them, under the name of the problem."""
        return as_table(
            ["", problem], [(name, [value], [rung_text(name, value)]) for name, value in self.rungs()], kind
        )

    def lines(self) -> list[str]:
        """A line for each rung, the lowest first."""
        remarks = []
        if self.against_theorem2 is not None and self.against_theorem2 < 0.0:
            remarks.append(f"{-100.0 * self.against_theorem2:.1f} % below all that {self.lmi} can give")
        if self.above_floor is not None:
            remarks.append(f"{100.0 * self.above_floor:.1f} % above the floor")
        remarked = {EXACT if self.gamma is None else CERTIFIED: f": {', '.join(remarks)}" if remarks else ""}
        texts = [(rung_text(name, value), name + remarked.get(name, "")) for name, value in self.rungs()]
        width = max((len(value) for value, _ in texts), default=0)
        lines = [f"{value:{width}}  {name}" for value, name in texts]
        if not self.knows_exact and self.gamma is not None:
            why = "not computed; analyse does" if self.exact is None else "not known, as no lower end of it was proved"
            lines.append(f"{'-':{width}}  {EXACT}: {why}")
        if self.theorem2_why_not is not None:
            lines.append(f"{'-':{width}}  what no gains are below by {self.lmi}: not proved; {self.theorem2_why_not}")
        return lines


def as_table(head: Sequence[str], rows: Sequence[tuple[str, Sequence[float | None], Sequence[str]]], kind: str) -> str:
    """Rows of a name, numbers, and the same as people read them: "csv" takes the numbers, "latex" what is read.

    LaTeX is a tabular with the rules of booktabs.
    """
    if kind == "csv":
        text = StringIO()
        csv.writer(text, lineterminator="\n").writerows([head, *([name, *numbers] for name, numbers, _ in rows)])
        return text.getvalue()
    lines = [" & ".join(map(_in_latex, [name, *shown])) + r" \\" for name, _, shown in rows]
    return "\n".join(
        [
            rf"\begin{{tabular}}{{l{'r' * (len(head) - 1)}}}",
            r"\toprule",
            " & ".join(map(_in_latex, head)) + r" \\",
            r"\midrule",
            *lines,
            r"\bottomrule",
            r"\end{tabular}",
            "",
        ]
    )


def _in_latex(text: str) -> str:
    return re.sub(r"([&%$#_{}])", r"\\\1", text)


def rung_text(name: str, value: float) -> str:
    """A rung's value: rounded up, but for the bounds from below, which are rounded down."""
    below = name == FLOOR or name.startswith(LEAST)
    return rounded_down(value) if below else rounded_up(value)


def ladder_of(gains: Gains) -> Ladder:
    """The ladder of what a design or a file claims."""
    proved = gains.certificate
    gamma = proved.gamma if proved.holds else None
    lmi = "the LMI" if beyond_paper(gains.problem) else "Theorem 2"
    theorem1 = proved.theorem1_gamma if proved.holds else None
    rungs = Ladder(proved.floor, proved.exact, gamma, proved.lmi_exact, proved.lmi_gamma, lmi, theorem1)
    box = proved.box if proved.holds else None
    rungs = rungs._replace(theorem2_least=proved.lmi_least, theorem2_why_not=proved.lmi_why_not)
    return rungs if box is None else rungs._replace(found_in_box=box.found, proved_in_box=box.gamma)


def rounded_up(bound: float) -> str:
    """Six decimals, of a small number four digits; never below the bound, because less than what is proved is not."""
    return _rounded(bound, ROUND_CEILING, digits=4)


def rounded_down(bound: float) -> str:
    """The same for a bound from below."""
    return _rounded(bound, ROUND_FLOOR, digits=4)


def interval(low: float, high: float) -> str:
    """ "low and high" of eight digits or more, rounded outwards."""
    return f"{_rounded(low, ROUND_FLOOR, digits=8)} and {_rounded(high, ROUND_CEILING, digits=8)}"


def _rounded(bound: float, rounding: str, *, digits: int) -> str:
    decimals = max(6, digits - 1 - math.floor(math.log10(bound))) if bound > 0.0 else 6
    with localcontext(prec=800, rounding=rounding):
        return f"{Decimal(str(bound)):.{decimals}f}"


def percent(part: float) -> str:
    """ "-29.5 %", "+3.1 %", "0.0 %"."""
    text = f"{100.0 * part:+.1f} %"
    return text[1:] if text[1:] == "0.0 %" else text
