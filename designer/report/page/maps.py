"""The charts of the page that have a row for each node: pictures of one pixel for each cell."""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from html import escape

import numpy as np
from numpy.typing import NDArray

from agent.contract.arrays import Array
from designer.report.chart import LOOKS, Chart, Map, Raster
from designer.report.colours import css_ramp, ramp, rgb
from designer.report.page.frame import legend, legend_item, plot
from designer.report.page.png import png
from designer.report.scales import Columns, brief

LEVELS = 255  # of a map's colours
SHARE = (120, 128, 136)  # red, green and blue of a share, on white and on black
SHADES = 15  # of a raster's marks, where a column is many steps


def rows_of(rows: Map | Raster, shown: Columns) -> tuple[str, str]:
    """The legend with the picture, and the numbers for the pointer."""
    picture, data, items = (_map if isinstance(rows, Map) else _raster)(rows, shown)  # type: ignore[arg-type]
    n = len(rows.rows)
    height = n * (18 if n <= 12 else 12 if n <= 40 else 6)
    every = max(1, -(-11 * n // height))
    places = [(1.0 - (i + 0.5) / n, escape(name)) for i, name in enumerate(rows.rows) if i % every == 0]
    names = f'"rows":{json.dumps([f"node {name}" for name in rows.rows])}'
    return legend(items) + plot("node", picture, places, shown, height), f"{names},{data}"


def shares_of(chart: Chart, shown: Columns) -> tuple[str, str]:
    """The categories of a run so long that a column is many steps: the darker, the more of these each has."""
    names, shares = chart.categories[::-1], chart.shares(shown)[::-1]
    grey = [(*SHARE, 255 * level // SHADES) for level in range(SHADES + 1)]
    said = "; ".join(f"{name}: {_known_mean(share):.0%}" for name, share in zip(names, shares, strict=True))
    picture = _picture((np.nan_to_num(shares) * SHADES).round().astype(np.uint8), grey, "cells", said)
    places = [(1.0 - (i + 0.5) / len(names), escape(name)) for i, name in enumerate(names)]
    levels = _base64(1 + np.round(np.nan_to_num(shares) * (LEVELS - 1)).astype(np.uint8))
    items = ["<li><span>share of the steps of a column</span> <b></b></li>"]
    data = f'"rows":{json.dumps(list(names))},"cells":"{levels}","scale":[0,1,0]'
    return legend(items) + plot(chart.unit, picture, places, shown, max(60, 18 * len(names))), data


def _known_mean(share: Array) -> float:
    known = share[np.isfinite(share)]
    return float(known.mean()) if known.size else 0.0


def _map(rows: Map, shown: Columns) -> tuple[str, str, list[str]]:
    values, scale = shown.extremes(rows.values)[1], rows.scale(shown)
    levels = np.clip(scale.of(values), 0.0, 1.0)
    unknown = np.isnan(values)
    cells = np.where(unknown, 0, 1 + np.nan_to_num(levels) * (LEVELS - 1)).round().astype(np.uint8).T
    worst = int(np.argmax(np.nan_to_num(values).max(axis=0)))
    said = f"{rows.name}; the largest, {brief(np.nanmax(values, initial=0.0), 3)}, at node {rows.rows[worst]}."
    picture = _picture(cells, [(0, 0, 0, 0), *ramp(LEVELS)], "cells sizes", said)
    ends = (scale.low, scale.high) if scale.log else (0.0, scale.high)
    bar = f'<i class="ramp" style="background:{css_ramp()}"></i>'
    least = "≤ " if scale.log else ""
    items = [
        f"<li><span>{escape(rows.name)}</span> <span>{least}{brief(ends[0], 2)}</span>{bar}<span>{brief(ends[1], 2)}"
        f"{', logarithmic' if scale.log else ''}</span> <b></b></li>"
    ]
    return picture, f'"cells":"{_base64(cells)}","scale":[{ends[0]:.6g},{ends[1]:.6g},{int(scale.log)}]', items


def _raster(rows: Raster, shown: Columns) -> tuple[str, str, list[str]]:
    """A strip for each layer of each node, and an empty one between nodes. Of many steps the share is shown."""
    strips = len(rows.layers) + 1
    cells = np.zeros((len(rows.rows) * strips, shown.number), dtype=np.uint8)
    codes = np.zeros((len(rows.rows), shown.number), dtype=np.uint8)  # for the pointer: a bit for each layer
    colours, items, said = [(0, 0, 0, 0)], [], []
    for place, (name, look, values) in enumerate(rows.layers):
        share = shown.means(values).T
        shade = np.ceil(np.nan_to_num(share) * SHADES).astype(np.uint8)
        cells[place::strips] = np.where(shade > 0, len(colours) - 1 + shade, 0)
        codes |= ((shade > 0).astype(np.uint8) << (2 * place)) | (np.isnan(share).astype(np.uint8) << (2 * place + 1))
        colours += [(*rgb(LOOKS[look].dark), 255 * level // SHADES) for level in range(1, SHADES + 1)]
        items.append(legend_item(name, look, "block", value=True))
        total, known = int(np.nansum(values[shown.first : shown.stop])), np.isfinite(values[shown.first : shown.stop])
        said.append(f"{name}: {total} of {int(known.sum())}")
    picture = _picture(cells, colours, "cells", "; ".join(said) + ".")
    return picture, f'"codes":"{_base64(codes)}"', items


def _picture(cells: NDArray[np.uint8], colours: Sequence[tuple[int, int, int, int]], kind: str, said: str) -> str:
    data = base64.b64encode(png(cells, colours)).decode()
    return f'<img class="{kind}" alt="{escape(said)}" src="data:image/png;base64,{data}">'


def _base64(cells: NDArray[np.uint8]) -> str:
    return base64.b64encode(cells.tobytes()).decode()
