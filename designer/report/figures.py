"""Pictures of a recording, in the arrangement of Zhu et al. 2020.

`outputs_figure` is their figures 3 and 4, z with every z_hat_i, over their figure 2, the modes; `errors_figure` is
their figures 5 and 6, the output error of every node, over the norm of all errors together, which gamma is about.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Sequence
from itertools import cycle, islice
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from agent.contract.arrays import Array
from agent.contract.files import refuse_overwrite, write_whole
from designer.ladder import rounded_up
from designer.replay.gamma import checked_gamma
from designer.replay.log import Log, load

# Okabe and Ito 2008, told apart by readers of every colour vision; black is kept for the plant
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
MARKERS = "os^Dv<>p"  # hollow, so that nodes whose curves coincide are all seen
MARKED = 40  # markers on a line at most; where there are more steps, every node has its own
DASHES: tuple[Any, ...] = ("-", (0, (5, 1.5)), (0, (1.5, 1.2)))  # tell apart the nodes that share a colour
BLACK, GREY, PALE = "#1a1a1a", "#707070", "#d9d9d9"
WIDTH = 7.0  # inches: a page's text
POINTS = 4000  # of a line; a longer one keeps the extremes of every stretch
STAIRS = 600  # steps up to which a staircase can be read
STRETCHES = 150
RASTER_ABOVE = 20  # lines: more would make an SVG of many megabytes
SETTLED = 0.01  # of the largest value: what stays below it to the end is not shown
STYLE = {
    "font.family": "DejaVu Sans",
    "font.size": 8.0,
    "axes.edgecolor": GREY,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.labelcolor": BLACK,
    "xtick.color": GREY,
    "ytick.color": GREY,
    "xtick.labelcolor": BLACK,
    "ytick.labelcolor": BLACK,
    "legend.frameon": False,
    "svg.hashsalt": "peakmesh",
    "axes.formatter.useoffset": False,
    "axes.autolimit_mode": "round_numbers",  # from tick to tick
    "axes.ymargin": 0.0,
}


def write(recording: Path, folder: Path, *, force: bool = False) -> list[Path]:
    """Both figures of a recording as SVG and PNG; only the outputs where no plant was recorded."""
    log = load(recording)
    figures = {"outputs": outputs_figure}
    if log.has_plant:
        figures["errors"] = errors_figure
    paths = {
        (name, kind): folder / f"{recording.name.removesuffix('.part').removesuffix('.mcap')}-{name}.{kind}"
        for name in figures
        for kind in ("svg", "png")
    }
    for path in paths.values():
        refuse_overwrite(path, force=force)
    for name, draw in figures.items():
        figure = draw(log)
        for kind in ("svg", "png"):
            write_whole(paths[name, kind], _rendered(figure, kind), force=force)
    return list(paths.values())


def outputs_figure(log: Log) -> Figure:
    """z and every z_hat_i, a panel for each output; the mode of every step below."""
    problem, label = log.gains.problem, _node_label(log.gains.problem.n, r"$\hat{z}$ of node ")
    with matplotlib.rc_context(STYLE):
        figure, panels, strip = _canvas(log, strip_height=0.35 + 0.1 * len(problem.topologies))
        for row, axes in enumerate(panels):
            if log.has_plant:
                _line(axes, log.z[:, row], colour=BLACK, width=2.2, label="$z$", over=1)
            for i, style in enumerate(_styles(problem.n, _shown_steps(log))):
                _line(axes, log.z_hat[:, i * problem.nz + row], label=label(problem.node_names[i]), **style)
            axes.set_ylabel(_indexed(r"$z$ and $\hat{z}_i$" if log.has_plant else r"$\hat{z}_i$", row, problem.nz))
        _legend(figure, panels[0])
        _draw_modes(strip, log)
    return figure


def errors_figure(log: Log) -> Figure:
    """z - z_hat_i of every node, a panel for each output; the norm over all of them below, beside gamma's bound."""
    problem, label = log.gains.problem, _node_label(log.gains.problem.n, "node ")
    with matplotlib.rc_context(STYLE):
        figure, panels, strip = _canvas(log, strip_height=1.1)
        for row, axes in enumerate(panels):
            axes.axhline(0.0, color=PALE, linewidth=0.8, zorder=0)
            for i, style in enumerate(_styles(problem.n, _shown_steps(log))):
                z_tilde = log.z[:, row] - log.z_hat[:, i * problem.nz + row]
                _line(axes, z_tilde, label=label(problem.node_names[i]), **style)
            axes.set_ylabel(_indexed(r"$z - \hat{z}_i$", row, problem.nz))
        _legend(figure, panels[0])
        _draw_norm(strip, log)
    return figure


def _canvas(log: Log, *, strip_height: float) -> tuple[Figure, list[Any], Any]:
    """A figure with a panel for each output and a lower strip, all over the same steps."""
    problem = log.gains.problem
    legend_rows = -(-(problem.n + 1) // _legend_columns(problem.n))
    heights = [2.3 if problem.nz == 1 else 1.6] * problem.nz + [strip_height]
    figure = Figure(figsize=(WIDTH, sum(heights) + 0.55 + 0.16 * legend_rows), layout="constrained")
    *panels, strip = figure.subplots(len(heights), 1, sharex=True, height_ratios=heights, squeeze=False)[:, 0]
    for axes in panels:
        axes.tick_params(labelbottom=False)
        axes.yaxis.set_major_locator(MaxNLocator(7, steps=(1, 2, 2.5, 5, 10), min_n_ticks=4))
    shown = _shown_steps(log)
    strip.set_xlim(0, max(1, shown - 1))
    strip.xaxis.set_major_locator(MaxNLocator(integer=True, steps=(1, 2, 5, 10)))
    strip.set_xlabel("step $k$")
    if shown < log.steps:
        curves = r"$|z|$ and every $|\hat{z}_i|$" if log.has_plant else r"every $|\hat{z}_i|$"
        rest = f"steps {shown} to {log.steps - 1}, where {curves} stay below {100 * SETTLED:g} % of the largest"
        panels[0].set_title(f"{rest}, are not shown", loc="right", color=GREY, fontsize=6.5)
    figure.supxlabel(_caption(log), x=0.99, ha="right", color=GREY, fontsize=6.5)
    figure.align_ylabels()
    return figure, panels, strip


def _caption(log: Log) -> str:
    gamma = checked_gamma(log.gains)
    unproved = "γ is not proved" if gamma.is_claimed else "γ is not claimed"
    proved = f"γ = {rounded_up(gamma.value)}" if gamma.failure is None else unproved
    return f"{log.gains.problem.name}, seed {log.seed}, {proved}"


def _shown_steps(log: Log) -> int:
    """Steps until everything has settled for good; all of them where it never does."""
    size = np.nan_to_num(np.abs(np.hstack([log.z, log.z_hat]))).max(axis=1, initial=0.0)
    moving = np.flatnonzero(size > SETTLED * size.max(initial=0.0))
    shown = int(moving[-1]) + 2 if len(moving) else log.steps
    return shown if shown < 0.8 * log.steps else log.steps


def _draw_modes(axes: Any, log: Log) -> None:
    """The staircase of figure 2; of a long run, how much of every stretch each mode has."""
    names = log.gains.problem.mode_names
    mode = log.mode[: _shown_steps(log)]
    if len(mode) <= STAIRS:
        known = (mode >= 0) & (mode < len(names))
        axes.step(np.arange(len(mode)), np.where(known, mode, np.nan), where="post", color=GREY, linewidth=0.9)
    else:
        here = mode[: len(mode) - len(mode) % STRETCHES].reshape(STRETCHES, -1)
        shares = [(here == s).mean(axis=1) for s in range(len(names))]
        extent = (0, here.size, -0.5, len(names) - 0.5)
        axes.imshow(shares, cmap="Greys", vmin=0.0, vmax=1.0, origin="lower", aspect="auto", extent=extent)
    axes.set_ylim(-0.5, len(names) - 0.5)
    axes.set_yticks(range(len(names)), names if len(names) <= 8 else [""] * len(names))
    axes.set_ylabel("mode" if len(mode) <= STAIRS else "mode (share)")


def _draw_norm(axes: Any, log: Log) -> None:
    """|z_tilde(k)| over all nodes, its peak, and gamma sqrt(sum over j < k of |w(j)|^2) where gamma is proved."""
    axes.yaxis.set_major_locator(MaxNLocator(4, steps=(1, 2, 5, 10), min_n_ticks=3))
    z_tilde, gamma = log.error_norms(), checked_gamma(log.gains)
    if gamma.failure is None:
        energies = (np.nan_to_num(log.w) ** 2).sum(axis=1)
        bound = gamma.value * np.sqrt(np.cumsum(energies) - energies)
        label = r"$\gamma\,(\Sigma_{j<k}|w(j)|^2)^{1/2}$, a bound in the mean"
        _line(axes, bound, colour=GREY, width=0.9, dashes=DASHES[1], label=label)
    _line(axes, z_tilde, colour=BLACK, width=1.0, label=r"$|\tilde{z}(k)|$, all nodes")
    if np.isfinite(z_tilde).any():
        k = int(np.nanargmax(z_tilde))
        axes.plot(k, z_tilde[k], "o", color=BLACK, markersize=3.5, label=f"peak {z_tilde[k]:.3g} at step {k}")
    axes.set_ylim(bottom=0.0)
    axes.set_ylabel(r"$|\tilde{z}|$")
    axes.legend(loc="lower left", bbox_to_anchor=(0.0, 0.98), borderaxespad=0.0, ncols=3, fontsize=7)


def _line(
    axes: Any,
    values: Array,
    *,
    colour: str,
    width: float = 1.1,
    dashes: Any = "-",
    label: str,
    over: int = 2,
    marks: Sequence[int] = (),
    **more: Any,
) -> None:
    """A line over all steps, with markers at the steps `marks` alone."""
    steps, values = thinned(values)
    if marks:
        more["markevery"] = np.unique(np.searchsorted(steps[:-1], marks)).tolist()
    axes.plot(steps, values, color=colour, linewidth=width, linestyle=dashes, label=label, zorder=over, **more)


def thinned(values: Array) -> tuple[Array, Array]:
    """Steps and values of a line; of a long one the smallest and the largest value of every stretch."""
    if len(values) <= POINTS:
        return np.arange(len(values), dtype=np.float64), values
    stretch = -(-2 * len(values) // POINTS)
    rows = np.full((-(-len(values) // stretch), stretch), np.nan)
    rows.flat[: len(values)] = values
    low = np.argmin(np.where(np.isnan(rows), np.inf, rows), axis=1)
    high = np.argmax(np.where(np.isnan(rows), -np.inf, rows), axis=1)
    kept = np.unique(np.arange(len(rows))[:, None] * stretch + np.column_stack([low, high]))
    return kept.astype(np.float64), values[kept]


def _styles(n: int, steps: int) -> Iterator[dict[str, Any]]:
    """How to draw each of n nodes over so many steps: those that coincide are told apart by markers and widths."""
    raster = {"rasterized": True} if n > RASTER_ABOVE else {}
    if n <= len(MARKERS):
        every = -(-steps // MARKED)
        broadest = 1.8 if every == 1 else 1.2
        for i, marker in enumerate(MARKERS[:n]):
            marked = {"marker": marker, "markersize": 4.2, "markerfacecolor": "none", "markeredgewidth": 0.8}
            marked["marks"] = range(i * every // n, steps, every)
            dashes, width = DASHES[i // len(COLOURS)], broadest - i * (broadest - 0.6) / max(1, n - 1)
            yield {"colour": COLOURS[i % len(COLOURS)], "dashes": dashes, "width": width, **marked}
    elif n <= len(COLOURS) * len(DASHES):
        for i in range(n):
            dashes = DASHES[i // len(COLOURS)]
            yield {"colour": COLOURS[i % len(COLOURS)], "dashes": dashes, **raster}
    else:
        scale = matplotlib.colormaps["viridis"](np.linspace(0.0, 0.92, n))
        for colour, dashes in zip(scale, islice(cycle(DASHES), n), strict=True):
            yield {"colour": matplotlib.colors.to_hex(colour), "dashes": dashes, "width": 0.6, **raster}


def _node_label(n: int, words: str) -> Callable[[str], str]:
    return words.__add__ if n <= RASTER_ABOVE else str


def _legend_columns(n: int) -> int:
    return 5 if n <= RASTER_ABOVE else 12


def _legend(figure: Any, axes: Any) -> None:
    handles, labels = axes.get_legend_handles_labels()
    n = len(labels)
    title = {} if n > RASTER_ABOVE else {"handlelength": 2.2}
    figure.legend(
        handles,
        labels,
        loc="outside upper left",
        ncols=min(n, _legend_columns(n)),
        columnspacing=1.2,
        fontsize=8 if n <= RASTER_ABOVE else 6,
        **title,
    )


def _indexed(letter: str, row: int, rows: int) -> str:
    """The label of one output; numbered only where there are several."""
    return letter if rows == 1 else f"{letter}, output {row + 1}"


def _rendered(figure: Any, kind: str) -> bytes:
    """The same bytes for the same figure: no date, no random ids."""
    data = io.BytesIO()
    with matplotlib.rc_context(STYLE):
        figure.savefig(data, format=kind, dpi=300, metadata={"Date": None} if kind == "svg" else None)
    return data.getvalue()
