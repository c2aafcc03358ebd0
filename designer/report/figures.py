"""The pictures of a report for a paper: at the width of one column or of two, as PDF, SVG or PNG."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.colors import ListedColormap, LogNorm, Normalize, to_rgba
from matplotlib.figure import Figure
from matplotlib.patches import Circle, PathPatch, Polygon
from matplotlib.path import Path as Curve

from agent.contract.files import refuse_overwrite, write_whole
from agent.contract.problem import Problem
from designer.ladder import rung_text
from designer.report import graphs
from designer.report.chart import LOOKS, Band, Chart, Level, Line, Map, Mark, Raster, extremes
from designer.report.colours import ramp
from designer.report.scales import Columns, Scale, columns, step_ticks

WIDTHS = {"one-column": 3.5, "two-columns": 7.16}  # inches: what IEEE journals take, and others near enough
DPI = 600
MOST_COLUMNS = 2000
HEIGHT = 2.0  # inches, of a picture of lines
FINE = 30  # columns an inch above which lines are thinner
DOTTED = 80  # columns up to which there are dots
INK, SOFT, GRID = "#1a1a1a", "#595959", "#e3e3e3"
STYLE = {
    "font.family": "DejaVu Sans",
    "font.size": 7.5,
    "mathtext.fontset": "dejavusans",
    "axes.edgecolor": SOFT,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.labelcolor": INK,
    "axes.formatter.useoffset": False,
    "xtick.color": SOFT,
    "ytick.color": SOFT,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "grid.color": GRID,
    "grid.linewidth": 0.5,
    "legend.frameon": False,
    "legend.fontsize": 7.0,
    "svg.hashsalt": "peakmesh",
    "pdf.fonttype": 42,  # TrueType, as journals ask for
}
_MATHEMATICS = {"ẑ": r"$\hat{z}$", "z̃": r"$\tilde{z}$", "γ_path": r"$\gamma_{\mathrm{path}}$", "step k": "step $k$"}

Draw = Callable[[float], Figure]  # a picture of this width, in inches


def figure(chart: Chart, shown: Columns, width: float) -> Figure:
    """One chart; its title and its explanation are for the caption, which is the author's."""
    with matplotlib.rc_context(STYLE):
        drawing = Figure(figsize=(width, _height(chart, width)), layout="constrained")
        axes = drawing.subplots()
        if chart.categories and shown.stretch > 1:
            extent = _extent(shown, len(chart.categories))
            axes.imshow(chart.shares(shown), cmap="Greys", vmin=0.0, vmax=1.0, interpolation="none", **extent)
            _name_rows(axes, chart.categories, chart.unit)
            axes.invert_yaxis()
        elif chart.rows is None:
            _marks(axes, chart, shown)
        elif isinstance(chart.rows, Map):
            _map(drawing, axes, chart.rows, shown)
        else:
            _raster(axes, chart.rows, shown)
        axes.set_xlim(shown.first - 0.5, shown.stop - 0.5)
        axes.set_xticks(step_ticks(shown.first, shown.stop - 1, 10 if width > 5.0 else 5))
        axes.set_xlabel(_mathematics("step k"))
        handles, labels = axes.get_legend_handles_labels()
        if len(labels) > 1 or isinstance(chart.rows, Raster):
            many = 4 if width > 5.0 else 2
            drawing.legend(
                handles,
                labels,
                loc="outside upper left",
                ncols=min(many, len(labels)),
                columnspacing=1.2,
                markerscale=2.0,
            )
        return drawing


def _height(chart: Chart, width: float) -> float:
    if chart.categories:
        return 0.7 + 0.14 * min(len(chart.categories), 10)
    if chart.rows is not None:
        return 0.9 + min(5.0, max(0.5, 0.14 * len(chart.rows.rows)))
    rows = -(-len(chart.marks) // (4 if width > 5.0 else 2))
    return HEIGHT + 0.15 * rows


def _marks(axes: Any, chart: Chart, shown: Columns) -> None:
    scale = chart.scale(shown)
    axes.set_yscale("log" if scale.log else "linear")
    axes.set_ylim(scale.low, scale.high)
    axes.grid(axis="y")
    axes.set_axisbelow(True)
    for mark in chart.marks:
        _mark(axes, mark, shown, scale)
    axes.set_ylabel(_mathematics(chart.unit))
    if chart.categories:
        every = max(1, len(chart.categories) // 10)
        axes.set_yticks(range(len(chart.categories))[::every], chart.categories[::every])


def _mark(axes: Any, mark: Mark, shown: Columns, scale: Scale) -> None:
    """A mark as steps, as dots, as an area, or as a line over all steps."""
    look, few = LOOKS[mark.look], shown.number <= DOTTED
    broad = 0.55 if shown.number <= FINE * axes.figure.get_figwidth() else 0.3
    style = {"color": look.light, "linewidth": broad * look.width, "label": _mathematics(mark.name)}
    if isinstance(mark, Level):
        if scale.low <= mark.value <= scale.high:
            axes.axhline(mark.value, linestyle=_dashes(mark.look), **style)
        return
    edges = shown.first - 0.5 + np.minimum(np.arange(shown.number + 1) * shown.stretch, shown.stop - shown.first)
    low, high = extremes(mark, shown)
    if scale.log:  # what is below the axis lies on its edge
        low, high = np.maximum(low, scale.low), np.maximum(high, scale.low)
    if isinstance(mark, Line) and (mark.drawn == "dots" or (mark.drawn == "dots or steps" and few)):
        axes.plot((edges[:-1] + edges[1:]) / 2.0, high, **_dots(few), **style)
    elif isinstance(mark, Band) or shown.stretch > 1:
        alpha = 1.0 if isinstance(mark, Band) else 0.55
        axes.stairs(high, edges, baseline=low, fill=True, alpha=alpha, **style | {"linewidth": 0.3})
    else:
        axes.stairs(low, edges, baseline=None, linestyle=_dashes(mark.look), **style)
        if mark.drawn == "dotted steps" and few:
            axes.plot((edges[:-1] + edges[1:]) / 2.0, low, **_dots(few), color=look.light)


def _dots(few: bool) -> dict[str, Any]:
    size = 2.4 if few else 0.9
    return {"marker": "o", "linestyle": "none", "markersize": size, "markeredgewidth": 0.0, "clip_on": False}


def _dashes(look: str) -> Any:
    return (0, LOOKS[look].dashes) if LOOKS[look].dashes else "-"


def _map(drawing: Any, axes: Any, rows: Map, shown: Columns) -> None:
    values, scale = shown.extremes(rows.values)[1], rows.scale(shown)
    norm = (LogNorm if scale.log else Normalize)(scale.low, scale.high, clip=True)
    colours = ListedColormap([[part / 255.0 for part in colour] for colour in ramp(256)])
    image = axes.imshow(values.T, norm=norm, cmap=colours, interpolation="none", **_extent(shown, len(rows.rows)))
    drawing.colorbar(image, ax=axes, location="top", aspect=60, pad=0.02).set_label(_mathematics(rows.name))
    _name_rows(axes, rows.rows)


def _raster(axes: Any, rows: Raster, shown: Columns) -> None:
    strips = len(rows.layers) + 1
    cells = np.zeros((len(rows.rows) * strips, shown.number, 4))
    for place, (name, look, values) in enumerate(rows.layers):
        cells[place::strips] = to_rgba(LOOKS[look].light)
        cells[place::strips, :, 3] = np.nan_to_num(shown.means(values).T)
        axes.plot([], [], "s", color=LOOKS[look].light, label=name)
    axes.imshow(cells, interpolation="none", **_extent(shown, len(rows.rows)))
    _name_rows(axes, rows.rows)


def _extent(shown: Columns, rows: int) -> dict[str, Any]:
    right = shown.first + shown.number * shown.stretch - 0.5
    return {"aspect": "auto", "extent": (shown.first - 0.5, right, rows - 0.5, -0.5)}


def _name_rows(axes: Any, names: tuple[str, ...], unit: str = "node") -> None:
    every = max(1, -(-len(names) // 36))
    axes.set_yticks(range(len(names))[::every], names[::every])
    axes.set_ylabel(unit)


def topologies(problem: Problem, width: float) -> Figure:
    """Who hears whom in every mode: figure 1 of the paper."""
    across = min(len(problem.topologies), 6 if width > 5.0 else 4)
    down, side = -(-len(problem.topologies) // across), width / across
    with matplotlib.rc_context(STYLE):
        drawing = Figure(figsize=(width, down * (side + 0.2)), layout="constrained")
        for s, axes in enumerate(drawing.subplots(down, across, squeeze=False).flat):
            axes.set_axis_off()
            if s < len(problem.topologies):
                _graph(axes, problem, s)
        return drawing


def _graph(axes: Any, problem: Problem, s: int) -> None:
    reach, named = graphs.radius(problem.n) + 26.0, problem.n <= graphs.NAMED
    axes.set(xlim=(-reach, reach), ylim=(reach, -reach), aspect="equal")
    axes.set_title(problem.mode_names[s], fontsize=7.5, pad=1.0)
    for link in graphs.links(problem, s):
        curve = Curve([link.start, link.middle, link.end], [Curve.MOVETO, Curve.CURVE3, Curve.CURVE3])
        dashes = (0, (3.0, 2.0)) if link.lossy else "-"
        axes.add_patch(PathPatch(curve, fill=False, color=SOFT, linewidth=0.6 if named else 0.2, linestyle=dashes))
        if named:
            axes.add_patch(Polygon(graphs.head(link), color=SOFT, linewidth=0.0))
    for (x, y), name in zip(graphs.points(problem.n), problem.node_names, strict=True):
        radius = graphs.node_radius(problem)
        axes.add_patch(Circle((x, y), radius, facecolor="white", edgecolor=INK, linewidth=0.7))
        if named:
            away = 1.0 if radius > 10.0 else 1.0 + 15.0 / (abs(complex(x, y)) or 1.0)
            axes.text(
                x * away,
                y * away,
                name,
                ha="center",
                va="center",
                fontsize=6.0 if axes.figure.get_figwidth() > 5.0 else 4.5,
            )


def ladder(rungs: Iterable[tuple[str, float]], width: float) -> Figure:
    """The rungs as bars, each with its value."""
    names, values = zip(*rungs, strict=True)
    with matplotlib.rc_context(STYLE):
        drawing = Figure(figsize=(width, 0.5 + 0.3 * len(names)), layout="constrained")
        axes = drawing.subplots()
        places = range(len(names))
        bars = axes.barh(places, values, color=LOOKS["path"].light, height=0.4)
        axes.bar_label(bars, [rung_text(name, value) for name, value in zip(names, values, strict=True)], padding=3)
        for place, name in zip(places, names, strict=True):
            axes.text(0.004 * max(values), place - 0.26, _mathematics(name), va="bottom", fontsize=7.0)
        axes.set_yticks([])
        axes.set_ylim(len(names) - 0.6, -0.8)
        axes.margins(x=0.2)
        axes.set_xlabel("largest error / root of the energy (dimensionless)")
        return drawing


def drawings(charts: Mapping[str, Chart], *, stop: int) -> dict[str, Draw]:
    """A picture for every chart, by its name, of the steps before `stop`."""
    shown = columns(0, stop, MOST_COLUMNS)

    def drawn(chart: Chart) -> Draw:
        return lambda width: figure(chart, shown, width)

    return {name: drawn(chart) for name, chart in charts.items()}


def paths(names: Iterable[str], folder: Path, *, kind: str, force: bool) -> dict[tuple[str, str], Path]:
    """Where each picture goes at each width; makes the folder, and refuses where one of the files is in the way."""
    folder.mkdir(parents=True, exist_ok=True)
    found = {(name, width): folder / f"{name}-{width}.{kind}" for name in names for width in WIDTHS}
    for path in found.values():
        refuse_overwrite(path, force=force)
    return found


def write(pictures: Mapping[str, Draw], folder: Path, *, kind: str, force: bool = False) -> list[Path]:
    """Every picture at every width; nothing is written where one of the files is in the way."""
    found = paths(pictures, folder, kind=kind, force=force)
    for (name, width), path in found.items():
        write_whole(path, rendered(pictures[name](WIDTHS[width]), kind), force=force)
    return list(found.values())


def rendered(drawing: Figure, kind: str) -> bytes:
    """The same bytes for the same figure: no date, no random ids."""
    data, undated = io.BytesIO(), {"svg": {"Date": None}, "pdf": {"CreationDate": None}, "png": {}}
    with matplotlib.rc_context(STYLE):
        drawing.savefig(data, format=kind, dpi=DPI, metadata=undated[kind])
    return data.getvalue()


def _mathematics(text: str) -> str:
    for plain, set_text in _MATHEMATICS.items():
        text = text.replace(plain, set_text)
    return text
