"""A topology on the page: its graph as inline SVG, with who hears whom in words beside it."""

from __future__ import annotations

import math
from html import escape

from agent.contract.problem import Problem
from designer.report.graphs import NAMED, Link, Point, head, links, node_radius, points, radius


def topology_html(problem: Problem, s: int, share: float) -> str:
    """One mode: its graph, its name, and how much of the run it had."""
    name = problem.mode_names[s]
    return (
        f'<figure class="topology" data-mode="{s}">{_svg(problem, s)}'
        f"<figcaption><b>topology {escape(name)}</b><br>{share:.0%} of the steps</figcaption></figure>"
    )


def _svg(problem: Problem, s: int) -> str:
    named, all_links = problem.n <= NAMED, list(links(problem, s))
    outside = named and node_radius(problem) < 10.0
    width = 2 * (radius(problem.n) + (max(map(len, problem.node_names)) * 7.5 + 24 if outside else 24))
    height = 2 * (radius(problem.n) + 24)
    parts = [
        f'<path class="link{" lossy" if lossy else ""}{"" if named else " faint"}" d="{d}"/>'
        for lossy in (False, True)
        if (d := "".join(_curve(link) for link in all_links if link.lossy == lossy))
    ]
    if named:
        heads = "".join(f"M{_xy(a)}L{_xy(b)}L{_xy(c)}z" for a, b, c in map(head, all_links))
        parts.append(f'<path class="head" d="{heads}"/>')
    for (x, y), node in zip(points(problem.n), problem.node_names, strict=True):
        parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{node_radius(problem):g}"/>')
        if named:
            parts.append(_name(x, y, node, outside=outside))
    said = escape(in_words(problem, s))
    view = f"{-width / 2:.0f} {-height / 2:.0f} {width:.0f} {height:.0f}"
    return f'<svg viewBox="{view}" style="width:{width:.0f}px" role="img" aria-label="{said}">{"".join(parts)}</svg>'


def _name(x: float, y: float, node: str, *, outside: bool) -> str:
    if not outside:
        return f'<text x="{x:.1f}" y="{y:.1f}" dy=".35em" text-anchor="middle">{escape(node)}</text>'
    anchor = "middle" if abs(x) < 8.0 else "start" if x > 0 else "end"
    away = 1.0 + 13.0 / (math.hypot(x, y) or 1.0)
    place = f'x="{x * away:.1f}" y="{y * away:.1f}"'
    return f'<text {place} dy=".35em" text-anchor="{anchor}">{escape(node)}</text>'


def _curve(link: Link) -> str:
    return f"M{_xy(link.start)}Q{_xy(link.middle)} {_xy(link.end)}"


def _xy(point: Point) -> str:
    return f"{point[0]:.1f} {point[1]:.1f}"


def in_words(problem: Problem, s: int) -> str:
    """Who hears whom; of many nodes how many links there are."""
    names, mode = problem.node_names, problem.mode_names[s]
    if problem.n > NAMED:
        return f'topology "{mode}": {sum(1 for _ in links(problem, s))} links among {problem.n} nodes.'
    said = []
    for i, name in enumerate(names):
        others = [names[j] for j in problem.neighbours(s, i) if j != i]
        said.append(f"{name} hears {', '.join(others)}" if others else f"{name} hears nobody")
    return f'topology "{mode}": {"; ".join(said)}.'
