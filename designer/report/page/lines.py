"""The charts of the page that have lines, dots and bands, as inline SVG."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from html import escape
from itertools import groupby

import numpy as np

from agent.contract.arrays import Array
from designer.report.chart import Band, Chart, Level, Line, extremes
from designer.report.page.frame import HEIGHT, legend, legend_item, path, plot
from designer.report.scales import Columns, Scale, brief, brief_all

PLOT = 210  # pixels
CATEGORIES = 12  # that are named
TICK_DIGITS = 8
DOTTED = 150  # columns up to which dots have their full size


def power(value: float) -> str:
    """A tick's text on a logarithmic axis."""
    return f"10<sup>{brief(round(np.log10(value)))}</sup>"


def marks(chart: Chart, shown: Columns) -> tuple[str, str]:
    """The legend with the picture, and the numbers for the pointer."""
    scale, layers, items, series = chart.scale(shown), [], [], []
    for mark in chart.marks:
        if isinstance(mark, Level):
            inside = scale.low <= mark.value <= scale.high
            where = "" if inside else ", above this picture"
            items.append(legend_item(f"{mark.name}: {brief(mark.value, 3)}{where}", mark.look, "line"))
            layers += [path("line", mark.look, _across(scale, mark.value, shown))] if inside else []
            continue
        low, high = extremes(mark, shown)
        layers += (drawn := list(_layers(mark, shown, _heights(scale, low), _heights(scale, high))))
        kind = "band" if isinstance(mark, Band) else "dots" if 'class="dots' in drawn[0] else "line"
        items.append(legend_item(mark.name, mark.look, kind, value=True))
        series.append(_series(low, high if isinstance(mark, Band) or shown.stretch > 1 else None))
    ticks = _ticks(chart, scale)
    grid = "".join(_across(scale, tick, shown) for tick, _ in ticks)
    svg = (
        f'<svg viewBox="0 0 {shown.number} {HEIGHT}" preserveAspectRatio="none" role="img" '
        f'aria-label="{escape(_in_words(chart, shown))}"><path class="grid" d="{grid}"/>{"".join(layers)}</svg>'
    )
    places = [(float(scale.of(np.array(tick))), text) for tick, text in ticks]
    height = min(PLOT, 40 + 30 * len(chart.categories)) if chart.categories else PLOT
    words = f',"words":{json.dumps(list(chart.categories))}' if chart.categories else ""
    return legend(items) + plot(chart.unit, svg, places, shown, height), f'"series":[{",".join(series)}]{words}'


def _ticks(chart: Chart, scale: Scale) -> list[tuple[float, str]]:
    """Where there is something to read, and what."""
    if chart.categories:
        names = [(float(place), escape(name)) for place, name in enumerate(chart.categories)]
        return names[:: max(1, len(names) // CATEGORIES)]
    return [(tick, power(tick) if chart.log else brief(tick, TICK_DIGITS)) for tick in scale.ticks()]


def _across(scale: Scale, value: float, shown: Columns) -> str:
    """A line over all columns."""
    return f"M0 {_heights(scale, np.array([value]))[0]}h{shown.number}"


def _heights(scale: Scale, values: Array) -> list[int | None]:
    """From the top, whole units; None where there is no value; what is below a logarithmic axis lies on its edge."""
    places = (1.0 - scale.of(values)) * HEIGHT
    places = np.where(np.isnan(values), np.nan, np.clip(np.nan_to_num(places, nan=HEIGHT, posinf=HEIGHT), 0, HEIGHT))
    return [None if np.isnan(place) else round(place) for place in places.tolist()]


def _layers(mark: Line | Band, shown: Columns, low: Sequence[int | None], high: Sequence[int | None]) -> Iterator[str]:
    """What is drawn of a mark, the lowest first."""
    few = shown.number <= DOTTED
    if isinstance(mark, Line) and (mark.drawn == "dots" or (mark.drawn == "dots or steps" and few)):
        size = "" if few else " small" if shown.number <= 4 * DOTTED else " fine"
        yield path(f"dots{size}", mark.look, _dots(high))
    elif isinstance(mark, Band) or shown.stretch > 1:
        yield path("band" if isinstance(mark, Band) else "band solid", mark.look, _area(low, high))
    else:
        yield path("line", mark.look, _steps(low))
        if mark.drawn == "dotted steps" and shown.number <= DOTTED // 2:
            yield path("dots", mark.look, _dots(low))


def _steps(heights: Sequence[int | None]) -> str:
    """A level for every step, joined upright."""
    d, column, known = [], 0, False
    for height, same in groupby(heights):
        width = len(list(same))
        if height is not None:
            d.append(f"V{height}h{width}" if known else f"M{column} {height}h{width}")
        known, column = height is not None, column + width
    return "".join(d)


def _dots(heights: Sequence[int | None]) -> str:
    """Strokes of no length: their round caps are the dots."""
    return "".join(f"M{column}.5 {height}h0" for column, height in enumerate(heights) if height is not None)


def _area(low: Sequence[int | None], high: Sequence[int | None]) -> str:
    """What lies between two rows of steps."""
    d, column = [], 0
    for missing, group in groupby(zip(low, high, strict=True), key=lambda pair: pair[0] is None or pair[1] is None):
        pairs = list(group)
        if not missing:
            upper = "".join(f"V{top}h1" for _, top in pairs)
            d.append(
                f"M{column} {pairs[0][0]}{upper}" + "".join(f"V{bottom}h-1" for bottom, _ in reversed(pairs)) + "z"
            )
        column += len(pairs)
    return "".join(d)


def _series(low: Array, high: Array | None) -> str:
    numbers = f'"low":[{",".join(brief_all(low))}]'
    return "{" + numbers + (f',"high":[{",".join(brief_all(high))}]' if high is not None else "") + "}"


def _in_words(chart: Chart, shown: Columns) -> str:
    """What is to be seen, for whoever cannot see it."""
    said = [f"{chart.unit}, steps {shown.first} to {shown.stop - 1}"]
    for mark in chart.marks:
        if isinstance(mark, Level):
            said.append(f"{mark.name} {brief(mark.value, 3)}")
            continue
        low, high = (mark.low, mark.high) if isinstance(mark, Band) else (mark.values, mark.values)
        low, high = low[shown.first : shown.stop], high[shown.first : shown.stop]
        if not np.isfinite(low).any():
            said.append(f"{mark.name} not known")
        elif chart.categories:
            counts = [(name, int((low == place).sum())) for place, name in enumerate(chart.categories)]
            said += [f'"{name}" at {count} steps' for name, count in counts]
        else:
            at = shown.first + int(np.nanargmax(np.abs(high)))
            said.append(
                f"{mark.name} from {brief(np.nanmin(low), 3)} to {brief(np.nanmax(high), 3)}, largest at step {at}"
            )
    return "; ".join(said) + "."
