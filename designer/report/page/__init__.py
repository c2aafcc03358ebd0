"""The report of a run: one HTML file that needs nothing else, neither network nor program."""

from __future__ import annotations

from html import escape
from importlib.resources import files

import numpy as np

from designer.report.account import Account
from designer.report.chart import LOOKS
from designer.report.graphs import NAMED
from designer.report.page.clock import clock
from designer.report.page.drawing import draw
from designer.report.page.sections import head, ladder, nodes, proofs, provenance
from designer.report.page.topology import topology_html
from designer.report.pictures import pictures
from designer.report.scales import Columns, columns

MOST_COLUMNS = 1200  # of a chart: longer runs show the extremes of every stretch of steps
PART, ALL = "part", "all"  # the views
CLOSE_UP = 150  # steps of a part
TOPOLOGIES = 24  # that are drawn
POLICY = "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; img-src data:"
HOW = "Move over a picture, or press Tab and the arrow keys, for the numbers of a step."

Views = dict[str, tuple[Columns, str]]  # the steps of each, and what they are


def page(account: Account) -> str:
    """The whole file."""
    title = escape(f"{account.log.gains.problem.name}, seed {account.log.seed}: report of a run")
    start, _ = _most_telling(account)
    figures, data = _figures(account)
    return "\n".join(
        [
            '<!doctype html><html lang="en"><head><meta charset="utf-8">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">',
            '<meta name="color-scheme" content="light dark">',
            f"<title>{title}</title><style>{_style()}</style></head><body>",
            '<a class="skip" href="#figures">To the pictures</a>',
            f"<header>{head(account)}</header><main>{proofs(account)}{clock(account)}{figures}"
            f"{ladder(account)}{nodes(account)}</main>",
            f'<footer>{provenance(account)}</footer><p id="said" aria-live="polite"></p>',
            f'<script type="application/json" id="data">{{"start":{start},"charts":{{{data}}}}}</script>',
            f"<script>{_asset('page.js')}</script></body></html>",
        ]
    )


def _asset(name: str) -> str:
    return files(__package__).joinpath(name).read_text(encoding="utf-8")


def _style() -> str:
    """The style sheet, with a rule for every look."""
    colours = {
        theme: "".join(f"--{look}:{getattr(style, theme)};" for look, style in LOOKS.items())
        for theme in ("light", "dark")
    }
    rules = "".join(
        f".{look}{{--look:var(--{look});--width:{style.width}px;--dashes:{' '.join(map(str, style.dashes)) or 'none'}}}"
        for look, style in LOOKS.items()
    )
    dark = f"@media screen and (prefers-color-scheme:dark){{:root{{{colours['dark']}}}}}"
    return f":root{{{colours['light']}}}{dark}{rules}{_asset('page.css')}"


def _most_telling(account: Account) -> tuple[int, str]:
    """The step that is shown first, and why."""
    verdict = account.verdict
    if verdict.first_divergence is not None:
        return verdict.first_divergence.step, "around the first divergence"
    return (verdict.peak.step, "around the largest error") if verdict.peak else (0, "from the beginning")


def _views(account: Account) -> Views:
    """All steps; before them, of a run that settles, those until then, and of another long one the most telling."""
    steps, (middle, what) = account.log.steps, _most_telling(account)
    views = {ALL: (columns(0, steps, MOST_COLUMNS), f"all, 0 to {steps - 1}")}
    if middle < account.settled < steps:
        part, what = range(account.settled), "until everything has settled"
    elif steps > 2 * CLOSE_UP:
        first = min(max(0, middle - CLOSE_UP // 2), steps - CLOSE_UP)
        part = range(first, first + CLOSE_UP)
    else:
        return views
    shown = columns(part.start, part.stop, MOST_COLUMNS)
    return {PART: (shown, f"{part.start} to {part.stop - 1}, {what}")} | views


def _figures(account: Account) -> tuple[str, str]:
    """The section with all charts, in every view, and the numbers for the pointer."""
    views, drawn, data = _views(account), [], []
    for chart in pictures(account):
        for view, (shown, _) in views.items():
            figure = draw(chart, shown, ident=chart.key if view == next(iter(views)) else f"{chart.key}-{view}")
            drawn.append(f'<div class="view {view}">{figure.html}</div>' if len(views) > 1 else figure.html)
            data.append(figure.data)
        if chart.key == "modes":
            drawn.append(_topologies(account))
    longest = max(shown.stretch for shown, _ in views.values())
    stretch = f" Of so long a run, each column has the extremes of {longest} steps." if longest > 1 else ""
    return (
        f'<section id="figures"><h2>The run, step by step</h2>{_choice(views)}<p class="how">{HOW}{stretch}</p>'
        f"{''.join(drawn)}</section>"
    ), ",".join(data)


def _choice(views: Views) -> str:
    if len(views) == 1:
        return ""
    radios = "".join(
        f'<label><input type="radio" name="view" id="view-{view}"{" checked" * (view == PART)}> {text}</label>'
        for view, (_, text) in views.items()
    )
    return f'<fieldset class="choice"><legend>Steps shown</legend>{radios}</fieldset>'


def _topologies(account: Account) -> str:
    """The graph of every mode, or of the most frequent ones."""
    problem, shares = account.log.gains.problem, account.mode_shares
    shown = sorted(np.argsort(-shares, kind="stable")[:TOPOLOGIES].tolist())
    graphs = "".join(topology_html(problem, s, float(shares[s])) for s in shown)
    said = [f"{'An arrow goes from' if problem.n <= NAMED else 'A line joins'} a node to one that hears it."]
    said += ["Dashed: the link loses messages."] if problem.links else []
    said += [f"The {TOPOLOGIES} most frequent of {len(shares)}."] if len(shares) > TOPOLOGIES else []
    return (
        '<figure id="topologies" aria-labelledby="topologies-title"><figcaption>'
        f'<h3 id="topologies-title">Who hears whom</h3><p>{" ".join(said)}</p></figcaption>'
        f'<div class="topologies">{graphs}</div></figure>'
    )
