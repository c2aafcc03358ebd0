"""What every chart of the page has: its axes, its legend, and where its picture goes.

The SVG of a chart is stretched to its place, which is why every step is one unit wide, heights go from 0 to HEIGHT, and
strokes do not scale; what is written stands beside it as text. Colours come from the style sheet.
"""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

from designer.report.scales import Columns, step_ticks

HEIGHT = 1000  # of the SVG's own units


def legend_item(name: str, look: str, kind: str, *, value: bool = False) -> str:
    shape = {"line": "M1 6h26", "dots": "M14 6h0", "band": "M1 2h26v8h-26z", "block": "M8 1h12v10h-12z"}[kind]
    swatch = f'<svg viewBox="0 0 28 12" aria-hidden="true">{path(kind, look, shape)}</svg>'
    return f"<li>{swatch}<span>{escape(name)}</span>{' <b></b>' if value else ''}</li>"


def legend(items: Sequence[str]) -> str:
    return f'<ul class="legend">{"".join(items)}</ul>'


def plot(unit: str, picture: str, places: Sequence[tuple[float, str]], shown: Columns, height: int) -> str:
    """The picture with both axes; `places` are heights between 0 and 1, and what is written there."""
    ys = "".join(f'<span style="bottom:{100 * place:.2f}%">{text}</span>' for place, text in places)
    width, ticks = shown.number * shown.stretch, step_ticks(shown.first, shown.stop - 1)
    xs = "".join(
        f'<span{" class=odd" * (place % 2)} style="left:{100 * (tick - shown.first + 0.5) / width:.3f}%">{tick}</span>'
        for place, tick in enumerate(ticks)
    )
    return (
        f'<p class="unit" aria-hidden="true">{escape(unit)}</p><div class="plot" style="--height:{height}px">'
        f'<div class="ys" aria-hidden="true">{ys}</div><div class="area">{picture}<i class="cursor" hidden></i></div>'
        f'<p class="steps" aria-hidden="true">step k</p><div class="xs" aria-hidden="true">{xs}</div></div>'
    )


def path(kind: str, look: str, d: str) -> str:
    return f'<path class="{kind} {look}" d="{d}"/>'
