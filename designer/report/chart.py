"""What a picture of a report is, apart from how it is drawn: on a page, on paper, or as a table.

Everything here has a value for each step, and is discrete: it is drawn as steps and dots, never joined by a line that
says something of the time between.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from agent.contract.arrays import Array
from designer.report.scales import Columns, Scale, linear, logarithmic

WITHIN = 1.3  # a level this far above all else is drawn, a higher one is named alone
DECADES = 4  # that lengths on a logarithmic axis have at most
PALE = 20.0  # a map whose median is this far below its largest value has a logarithmic scale


class Look(NamedTuple):
    """How a mark is drawn: its colour on white and on black, its width in points, and its dashes."""

    light: str
    dark: str
    width: float = 1.5
    dashes: tuple[float, ...] = ()


# Colours from Okabe and Ito 2008, told apart by readers of every colour vision; lighter ones on black. Black and white
# are kept for the plant and for all nodes together. The broadest line lies lowest: where lines coincide all are seen.
LOOKS = {
    "plant": Look("#111111", "#ffffff", 1.3),
    "node-0": Look("#0072b2", "#4aa8e0", 3.2),
    "node-1": Look("#d55e00", "#ff8b3d", 2.7),
    "node-2": Look("#009e73", "#2fd0a3", 2.2),
    "node-3": Look("#cc79a7", "#e9a6cb", 1.8),
    "node-4": Look("#e69f00", "#f7bd45", 1.6, (5.0, 1.5)),
    "node-5": Look("#56b4e9", "#9bd8ff", 1.4, (2.0, 1.2)),
    "range": Look("#b9cbd6", "#37505f"),
    "median": Look("#0072b2", "#4aa8e0", 1.6),
    "worst-0": Look("#d55e00", "#ff8b3d", 2.2),
    "worst-1": Look("#009e73", "#2fd0a3", 1.6),
    "worst-2": Look("#cc79a7", "#e9a6cb", 1.0),
    "path": Look("#0072b2", "#4aa8e0", 1.6),
    "mean": Look("#d55e00", "#ff8b3d", 1.4, (5.0, 2.0)),
    "chance": Look("#cc79a7", "#e9a6cb", 1.4, (1.5, 2.0)),
    "tolerance": Look("#d55e00", "#ff8b3d", 1.4, (5.0, 2.0)),
    "proof-1": Look("#0072b2", "#4aa8e0", 4.5),
    "proof-2": Look("#009e73", "#2fd0a3", 3.5),
    "proof-3": Look("#cc79a7", "#e9a6cb", 3.0),
    "lost": Look("#d55e00", "#e8772a"),
    "without": Look("#3f7fb5", "#4f93cc"),
}


@dataclass(frozen=True, eq=False)
class Line:
    """One number for each step; drawn as steps, as dots, or as steps with dots on them."""

    name: str
    values: Array  # (steps,)
    look: str
    drawn: Literal["steps", "dots", "dotted steps", "dots or steps"] = "steps"  # the last: steps where dots would touch


@dataclass(frozen=True, eq=False)
class Band:
    """From one number to another, for each step."""

    name: str
    low: Array  # (steps,)
    high: Array
    look: str


@dataclass(frozen=True, eq=False)
class Level:
    """One number for all steps."""

    name: str
    value: float
    look: str


@dataclass(frozen=True, eq=False)
class Map:
    """A size for each row and step, shown as a colour."""

    name: str
    rows: tuple[str, ...]
    values: Array  # (steps, rows)

    def scale(self, shown: Columns) -> Scale:
        """Linear from 0; logarithmic where most of it would be too pale to be seen."""
        values = shown.extremes(self.values)[1]
        known = values[np.isfinite(values) & (values > 0.0)]
        high = float(known.max(initial=0.0)) or 1.0
        if not known.size or float(np.median(known)) > high / PALE:
            return Scale(0.0, high)
        return Scale(max(float(known.min()), high * 10.0**-DECADES), high, log=True)


@dataclass(frozen=True, eq=False)
class Raster:
    """What happened to each row at each step: layers of 1 where it did, 0 where it did not, NaN where not known."""

    rows: tuple[str, ...]
    layers: tuple[tuple[str, str, Array], ...]  # name, look, (steps, rows)


Mark = Line | Band | Level


@dataclass(frozen=True, eq=False)
class Chart:
    """One picture over all steps. Either `marks` over the `unit`, or `rows`."""

    key: str
    title: str
    about: str  # what is to be seen, for whoever has never seen one
    unit: str
    marks: tuple[Mark, ...] = ()
    rows: Map | Raster | None = None
    log: bool = False
    from_zero: bool = False
    categories: tuple[str, ...] = ()  # the numbers 0, 1, ... stand for these
    remark: str = ""  # what could not be drawn

    def shares(self, shown: Columns) -> Array:
        """How much of every column each category has, (categories, columns); NaN where nothing is known."""
        (line,) = (mark for mark in self.marks if isinstance(mark, Line))
        is_there = line.values[:, None] == np.arange(len(self.categories))
        return shown.means(np.where(np.isnan(line.values)[:, None], np.nan, is_there)).T

    def scale(self, shown: Columns) -> Scale:
        """Of the marks, in these columns."""
        if self.categories:
            return Scale(-0.5, len(self.categories) - 0.5)
        values = [part for mark in self.marks if not isinstance(mark, Level) for part in extremes(mark, shown)]
        levels = [np.array([mark.value]) for mark in self.marks if isinstance(mark, Level)]
        if self.log:
            return logarithmic([*values, *levels], decades=DECADES if self.from_zero else np.inf)
        near = WITHIN * linear(values, from_zero=self.from_zero).high
        return linear([*values, *(level for level in levels if level[0] <= near)], from_zero=self.from_zero)


def extremes(mark: Line | Band, shown: Columns) -> tuple[Array, Array]:
    """The smallest and the largest value of every column."""
    if isinstance(mark, Line):
        return shown.extremes(mark.values)
    return shown.extremes(mark.low)[0], shown.extremes(mark.high)[1]
