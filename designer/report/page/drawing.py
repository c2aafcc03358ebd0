"""A chart as HTML: it takes the width that there is, and its colours from the style sheet."""

from __future__ import annotations

import json
from html import escape
from typing import NamedTuple

from designer.report.chart import Chart
from designer.report.page.lines import marks
from designer.report.page.maps import rows_of, shares_of
from designer.report.scales import Columns


class Drawn(NamedTuple):
    """A chart on the page, and the numbers behind it for the pointer, as JSON."""

    html: str
    data: str


def draw(chart: Chart, shown: Columns, *, ident: str) -> Drawn:
    """`ident` names the figure on the page."""
    if chart.rows is not None:
        body, data = rows_of(chart.rows, shown)
    elif chart.categories and shown.stretch > 1:
        body, data = shares_of(chart, shown)
    else:
        body, data = marks(chart, shown)
    remark = f'<p class="remark">{escape(chart.remark)}</p>' if chart.remark else ""
    html = (
        f'<figure id="{ident}" aria-labelledby="{ident}-title"><figcaption><h3 id="{ident}-title">'
        f"{escape(chart.title)}</h3><p>{escape(chart.about)}</p>{remark}</figcaption>{body}</figure>"
    )
    frame = f'"first":{shown.first},"stop":{shown.stop},"stretch":{shown.stretch}'
    return Drawn(html, f"{json.dumps(ident)}:{{{frame},{data}}}")
