"""The paper's table beside what comes out here: both examples of Zhu et al. 2020, section 4.

Everything is computed when it is asked for, but for the two values that the paper prints.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any, NamedTuple

from agent.contract.gains import Gains
from agent.contract.problem import Problem
from designer.gain.exact import exact_gain
from designer.gain.floor import floor
from designer.ladder import as_table, rounded_down, rounded_up
from designer.model.error_model import StackedGains, error_model
from designer.model.units import NaturalUnits
from designer.problems import find
from designer.search.starts import consensus_gains, least_variance_gains

PRINTED = {"zhu2020-ideal": 0.23, "zhu2020-lossy": 0.36}  # gamma of examples 1 and 2
EXAMPLES = tuple(PRINTED)
_SCS_ITERATIONS = 4000


class Computed:
    """What the rows are made of, each computed once, when the first row asks for it."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem

    @cached_property
    def theorem2(self) -> Gains:
        return self._designed("theorem2")

    @cached_property
    def decomposed(self) -> Gains:
        return self._designed("decomposed")

    @cached_property
    def exact(self) -> Gains:
        return self._designed("exact")

    @cached_property
    def scs(self) -> float | None:
        from designer.lmi import theorem2

        return theorem2.gamma_by_scs(self.problem, iterations=_SCS_ITERATIONS)

    @cached_property
    def least(self) -> float | None:
        from designer.undercut import undercut

        return undercut(self.problem).gamma

    @cached_property
    def consensus(self) -> float | None:
        return self._exact_of(consensus_gains)

    @cached_property
    def least_variance(self) -> float | None:
        return self._exact_of(least_variance_gains)

    def _exact_of(self, gains: Callable[[Problem], StackedGains]) -> float | None:
        natural = NaturalUnits(self.problem)
        bounds = exact_gain(error_model(natural.problem, *gains(natural.problem))).bounds
        return None if bounds is None else natural.output * bounds[1]

    def _designed(self, method: str) -> Gains:
        from designer.synthesis import design

        return design(self.problem, method=method)


class Row(NamedTuple):
    """One line of the table; its value is None where there is none."""

    key: str
    text: str
    value: Callable[[Computed], float | None]


def _exact_of_theorem2(computed: Computed) -> float | None:
    exact = computed.theorem2.certificate.exact
    return None if exact is None else exact[1]


ROWS = (
    Row("printed", "gamma, printed in the paper", lambda computed: PRINTED.get(computed.problem.name)),
    Row("clarabel", "LMI (36)(37) as printed, by Clarabel", lambda computed: computed.theorem2.certificate.lmi_gamma),
    Row("scs", f"the same by SCS, {_SCS_ITERATIONS} iterations at most", lambda computed: computed.scs),
    Row("decomposed", "the same optimum node by node", lambda computed: computed.decomposed.certificate.lmi_gamma),
    Row("least", "proved: no point of (42) is below", lambda computed: computed.least),
    Row(
        "certified",
        "Theorem 2's gains: certified by Theorem 1",
        lambda computed: computed.theorem2.certificate.by_theorem1,
    ),
    Row("theorem2_exact", "Theorem 2's gains: their exact gain", _exact_of_theorem2),
    Row("consensus", "Kalman-consensus gains: their exact gain", lambda computed: computed.consensus),
    Row("least_variance", "gains of least variance: their exact gain", lambda computed: computed.least_variance),
    Row("exact", "designed for the exact gain: certified", lambda computed: computed.exact.certificate.gamma),
    Row("floor", "floor: no linear filter is below it", lambda computed: floor(computed.problem)),
)

_FOUND = ("theorem2_exact", "consensus", "least_variance", "exact")  # the rows of what gains really have


class Reproduced(NamedTuple):
    """values[example][row key], and what they were computed from."""

    values: dict[str, dict[str, float | None]]
    computed: dict[str, Computed]

    def document(self) -> dict[str, Any]:
        """For --json."""
        return {"examples": self.values, "remarks": self.remarks()}

    def text(self) -> str:
        """The table, a column for each example, and what it says of the printed values."""
        names = list(self.values)
        keys = self.values[names[0]]
        width = max(len(row.text) for row in ROWS)
        lines = [" " * width + "".join(f"  {name:>14}" for name in names)]
        for row in ROWS:
            if row.key in keys:
                cells = (self.cell(self.values[name][row.key], row.key) for name in names)
                lines.append(f"{row.text:{width}}" + "".join(f"  {cell:>14}" for cell in cells))
        return "\n".join([*lines, "", *self.remarks()])

    def table(self, kind: str) -> str:
        """The table as `designer.ladder.as_table` writes it, without remarks."""
        rows = []
        for row in ROWS:
            values = [self.values[name].get(row.key) for name in self.values]
            if row.key in next(iter(self.values.values())):
                rows.append((row.text, values, [self.cell(value, row.key) for value in values]))
        return as_table(["", *self.values], rows, kind)

    @staticmethod
    def cell(value: float | None, key: str) -> str:
        """One entry of the table."""
        if value is None:
            return {"consensus": "not stable", "least_variance": "not stable", "scs": "no answer"}.get(key, "-")
        if key in ("certified", "exact"):
            return rounded_up(value)
        return f"{value:g}" if key == "printed" else rounded_down(value) if key == "least" else f"{value:.6f}"

    def remarks(self) -> list[str]:
        """What the computed values say of the printed ones, for each example that has both."""
        said = []
        for number, name in enumerate(EXAMPLES, 1):
            values = self.values.get(name, {})
            printed, optimum, scs = values.get("printed"), values.get("clarabel"), values.get("scs")
            if printed is None or optimum is None:
                continue
            least, off = values.get("least"), 100.0 * abs(printed / optimum - 1.0)
            agree = ""
            if scs is not None:
                agree = f", on which two solvers agree within {100.0 * abs(scs / optimum - 1.0):.2f} %"
            if printed < optimum:
                cannot = "As far as solvers tell, it cannot come from (42) with the printed data"
                if least is not None and least > printed:
                    cannot = (
                        f"That it cannot come from (42) with the printed data is proved: no point of (42) has less "
                        f"than {rounded_down(least)}"
                    )
                said.append(
                    f"Example {number}: the printed {printed:g} is {off:.1f} % below the optimum of the convex problem "
                    f"(42){agree}. {cannot}; a misprint is likely, which one we do not know."
                )
                found = [value for key in _FOUND if (value := values.get(key)) is not None]
                if found and min(found) > printed:
                    said.append(f"No gains that we found reach it either: the least of these has {min(found):.4f}.")
            else:
                said.append(
                    f"Example {number}: the printed {printed:g} is {off:.1f} % above the optimum of (42){agree}. A "
                    "solver that was stopped early, or kept a margin, is one way to get it."
                )
        return said


def reproduce(
    examples: Sequence[str] = EXAMPLES,
    *,
    rows: Sequence[str] | None = None,
    report: Callable[[str], None] = lambda said: None,
) -> Reproduced:
    """Compute the rows (None: all) for the examples, built-in problems; `report` gets each value as it is there."""
    values: dict[str, dict[str, float | None]] = {}
    computed = {name: Computed(find(name)) for name in examples}
    for name in examples:
        values[name] = {}
        for row in ROWS:
            if rows is None or row.key in rows:
                value = values[name][row.key] = row.value(computed[name])
                report(f"{name}: {row.text}: {Reproduced.cell(value, row.key)}")
    return Reproduced(values, computed)
