"""What is seen of a run, for a terminal; with rich, which an install for a board does not have."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal, NamedTuple

from rich.console import Console, ConsoleOptions, Group, RenderableType
from rich.table import Table
from rich.text import Text

from designer.watch.lines import ledger, number, substituted, where, word
from designer.watch.scene import NodeSeen, Seen

SHOWN = 8  # events that a terminal shows
AROUND = 10  # lines of a terminal for what is neither a node nor an event
NAMED = 6  # nodes that were heard are named up to so many
BEHIND = 2  # steps by which a node may be behind the clock
COLOURS = {"valid": "green", "valid plus": "yellow", "void": "bold red", "none": "yellow"}
ALARMS = {"late", "silent", "gone", "began", "fault", "stop", "stood", "unrecorded"}  # kinds of events


def table(seen: Seen) -> RenderableType:
    """All of it, as wide and high as the terminal is."""
    return Group(_head(seen), Text(), _Nodes(seen), Text(), *_events(seen))


def _head(seen: Seen) -> Text:
    kind = "" if seen.period is None else "lock-step" if not seen.period else f"paced, {1e3 * seen.period:g} ms"
    facts = [f"run {seen.run}", kind, "" if seen.seed is None else f"seed {seen.seed}"]
    rates = [
        where(seen),
        f"{number(seen.steps_per_second, '.1f')} steps/s",
        f"{number(seen.messages_per_second, '.0f')} messages/s",
        f"watched since step {word(seen.watched_since)}",
    ]
    text = Text()
    text.append("   ".join(filter(None, facts)), style="bold").append("\n" + "   ".join(rates))
    text.append(f"\n{ledger(seen)}", style=COLOURS[seen.ledger["status"] if seen.ledger else "none"])
    below = substituted(seen), f"gone: {', '.join(seen.gone)}" if seen.gone else ""
    return text.append("\n" + "; ".join(filter(None, below)))


class _Column(NamedTuple):
    name: str
    cell: Callable[[NodeSeen, Seen], Text]
    justify: Literal["left", "right"] = "right"
    from_width: int = 0  # of the terminal


@dataclass
class _Nodes:
    """A line for each node; where there are too many, those in trouble first."""

    seen: Seen

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[RenderableType]:
        drawn = Table(box=None, pad_edge=False, header_style="dim", padding=(0, 2, 0, 0))
        columns = [column for column in COLUMNS if column.from_width <= options.max_width]
        for column in columns:
            drawn.add_column(column.name, justify=column.justify, no_wrap=column.name != "heard")
        most = max(1, console.height - AROUND - SHOWN) if console.is_terminal else len(self.seen.nodes)
        nodes = self.seen.nodes
        if len(nodes) > most:
            nodes = sorted(nodes, key=lambda node: not _is_in_trouble(node, self.seen))[:most]
        for node in nodes:
            drawn.add_row(*(column.cell(node, self.seen) for column in columns))
        yield drawn
        if len(nodes) < len(self.seen.nodes):
            yield Text(f"and {len(self.seen.nodes) - len(nodes)} more", style="dim")


def _is_in_trouble(node: NodeSeen, seen: Seen) -> bool:
    return not node.there or _is_behind(node, seen) or bool(node.not_heard) or node.measured is False


def _is_behind(node: NodeSeen, seen: Seen) -> bool:
    return bool(seen.period) and node.step is not None and seen.step is not None and node.step < seen.step - BEHIND


def _step(node: NodeSeen, seen: Seen) -> Text:
    if not node.there:
        return Text("gone" if node.step is None else f"gone at {node.step}", style="red")
    return Text(word(node.step), style="yellow" if _is_behind(node, seen) else "")


def _heard(node: NodeSeen, seen: Seen) -> Text:
    few = len(node.heard) <= NAMED
    heard = Text((" ".join(node.heard) if few else f"{len(node.heard)} nodes") if node.step is not None else "")
    return heard.append(f" not {' '.join(node.not_heard)}" if node.not_heard else "", style="red")


def _measured(node: NodeSeen, seen: Seen) -> Text:
    return Text({True: "yes", False: "no", None: ""}[node.measured], style="" if node.measured else "red")


def _missed(node: NodeSeen, seen: Seen) -> Text:
    missed = node.pairs_substituted, node.measurements_substituted
    return Text("{} + {}".format(*missed), style="yellow" if any(missed) else "dim")


def _milliseconds(*seconds: float | None) -> Text:
    return Text(" / ".join(f"{1e3 * one:.1f}" for one in seconds if one is not None))


COLUMNS = (
    _Column("node", lambda node, seen: Text(node.name, style="bold" if node.there else "bold red"), "left"),
    _Column("step", _step),
    _Column("delay, ms\nnow / most", lambda node, seen: _milliseconds(node.delay, node.longest_delay)),
    _Column(
        "tick to step, ms\nmedian / 99% / most",
        lambda node, seen: _milliseconds(node.to_step_median, node.to_step_p99, node.to_step_max),
        from_width=120,
    ),
    _Column("heard", _heard, "left"),
    _Column("measured", _measured, "left"),
    _Column("innovation", lambda node, seen: Text(number(node.innovation, ".3g"))),
    _Column("error", lambda node, seen: Text(number(node.error, ".3g"))),
    _Column("error\nmost", lambda node, seen: Text(number(node.largest_error, ".3g")), from_width=90),
    _Column("substituted\npairs + y", _missed),
)


def _events(seen: Seen) -> Iterator[RenderableType]:
    for told in seen.events[-SHOWN:]:
        line = Text(no_wrap=True, overflow="ellipsis")
        line.append(f"{told.step:>9}  ", style="dim")
        line.append(f"{told.kind:<8}", style="yellow" if told.kind in ALARMS else "cyan")
        yield line.append(f"  {told.text}")
    if seen.ended is not None:
        yield Text(f"the run has ended: {seen.ended}", style="bold")
