"""A curve over the values of a key: what `sweep` found, for a paper."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from designer.report.chart import LOOKS
from designer.report.figures import HEIGHT, STYLE

# look, marker and its size: where curves coincide, all are seen, the first on top
_DRAWN = (("node-0", "o", 2.2), ("mean", "s", 3.4), ("plant", "D", 4.6), ("tolerance", "^", 5.8))


def curve(key: str, values: Sequence[float], found: Mapping[str, Sequence[float | None]], width: float) -> Figure:
    """Every series of `found` over `values`; where it has None there is a gap, where the first has, a cross below."""
    with matplotlib.rc_context(STYLE):
        drawing = Figure(figsize=(width, HEIGHT), layout="constrained")
        axes = drawing.subplots()
        for (name, series), (look, marker, size) in zip(found.items(), _DRAWN, strict=False):
            heights = np.array([np.nan if value is None else value for value in series])
            if not np.isnan(heights).all():
                colour = LOOKS[look].light
                (line,) = axes.plot(values, heights, f"{marker}-", label=name, color=colour, zorder=9.0 - size)
                line.set(linewidth=size / 2.0, markersize=size, markeredgewidth=0.0)
        nothing = [value for value, first in zip(values, next(iter(found.values())), strict=True) if first is None]
        if nothing:
            bottom = axes.get_xaxis_transform()
            axes.plot(nothing, [0.02] * len(nothing), "x", transform=bottom, color="#595959", label="no gains")
        axes.set_ylim(bottom=0.0)
        axes.grid(axis="y")
        axes.set_axisbelow(True)
        axes.set_xlabel(key)
        axes.set_ylabel("γ")
        drawing.legend(loc="outside upper left", ncols=2 if width < 5.0 else 4, columnspacing=1.2)
        return drawing
