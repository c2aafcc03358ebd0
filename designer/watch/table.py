"""What is seen of a run, for a terminal, and for a log."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from designer.watch.scene import NodeSeen, Seen

SHOWN = 8  # events that a terminal shows
BEHIND = 2  # steps by which a node may be behind the clock
COLOURS = {"valid": "green", "valid plus": "yellow", "void": "bold red", "none": "yellow"}
COLUMNS: tuple[tuple[str, Literal["left", "right"]], ...] = (
    ("node", "left"),
    ("step", "right"),
    ("tick to estimate\nnow, most (ms)", "right"),  # as seen here
    ("tick to step, told\nmedian, 99 %, most (ms)", "right"),
    ("heard", "left"),
    ("measured", "left"),
    ("innovation", "right"),
    ("error\nnow", "right"),
    ("\nmost", "right"),
    ("substituted\npairs", "right"),
    ("\nmeasurements", "right"),
)
ALARMS = {"late", "silent", "gone", "began", "fault", "stop", "stood", "unrecorded"}  # kinds of events


def table(seen: Seen) -> RenderableType:
    """All of it, as wide as the terminal is."""
    return Group(_head(seen), Text(), _nodes(seen), Text(), *_below(seen))


def lines(seen: Seen, *, after: int = -1) -> Iterator[str]:
    """Events with a number beyond `after`, and where the run is: for who reads it in a file."""
    for told in seen.events:
        if told.number > after:
            yield f"  step {told.step}  {told.kind}: {told.text}"
    there = [node for node in seen.nodes if node.there]
    words = [
        _where(seen),
        f"mode {_word(seen.mode)}",
        f"{_number(seen.steps_per_second, '.1f')} steps/s",
        f"{len(there)} of {len(seen.nodes)} nodes",
        _substituted(seen),
        f"|error| at most {_number(_largest(seen), '.3g')}",
        _ledger(seen),
    ]
    yield "; ".join(words)


def _head(seen: Seen) -> Text:
    kind = "" if seen.period is None else "lock-step" if not seen.period else f"paced, {1e3 * seen.period:g} ms"
    facts = [f"run {seen.run}", kind, "" if seen.seed is None else f"seed {seen.seed}"]
    rates = [
        _where(seen),
        f"mode {_word(seen.mode)}",
        f"{_number(seen.steps_per_second, '.1f')} steps/s",
        f"{_number(seen.messages_per_second, '.0f')} messages/s",
        f"watched since step {_word(seen.watched_since)}",
    ]
    text = Text("   ".join(filter(None, facts)), style="bold")
    return text.append("\n" + "   ".join(rates), style="not bold")


def _where(seen: Seen) -> str:
    return f"step {_word(seen.step)}" + (f" of {seen.steps}" if seen.steps is not None else "")


def _nodes(seen: Seen) -> Table:
    drawn = Table(box=None, pad_edge=False, header_style="dim", padding=(0, 3, 0, 0))
    for name, justify in COLUMNS:
        drawn.add_column(name, justify=justify)
    for node in seen.nodes:
        drawn.add_row(*_row(node, seen))
    return drawn


def _row(node: NodeSeen, seen: Seen) -> Iterator[Text]:
    behind = bool(seen.period) and node.step is not None and seen.step is not None and node.step < seen.step - BEHIND
    yield Text(node.name, style="bold" if node.there else "bold red")
    if node.there:
        yield Text(_word(node.step), style="yellow" if behind else "")
    else:
        yield Text("gone" if node.step is None else f"gone at {node.step}", style="red")
    yield Text(_milliseconds(node.delay, node.longest_delay))
    yield Text(_milliseconds(node.to_step_median, node.to_step_p99, node.to_step_max))
    heard = Text(" ".join(node.heard) or ("" if node.step is None else "nobody"))
    yield heard.append(f" not {' '.join(node.not_heard)}" if node.not_heard else "", style="red")
    yield Text({True: "yes", False: "no", None: ""}[node.measured], style="" if node.measured else "red")
    for number in (node.innovation, node.error, node.largest_error):
        yield Text(_number(number, ".3g"))
    for missed in (node.pairs_substituted, node.measurements_substituted):
        yield Text(str(missed), style="yellow" if missed else "dim")


def _below(seen: Seen) -> Iterator[RenderableType]:
    status = seen.ledger["status"] if seen.ledger else "none"
    yield Text(_ledger(seen), style=COLOURS[status])
    yield Text(_substituted(seen) + (f"; gone: {', '.join(seen.gone)}" if seen.gone else ""))
    yield Text()
    for told in seen.events[-SHOWN:]:
        style = COLOURS["void"] if "void" in told.text and told.kind == "ledger" else ""
        line = Text.assemble((f"{told.step:>9}  ", "dim"))
        line.append(f"{told.kind:<8}", style="yellow" if told.kind in ALARMS else "cyan")
        yield line.append(f"  {told.text}", style=style)
    if seen.ended is not None:
        yield Text(f"the run has ended: {seen.ended}", style="bold")


def _ledger(seen: Seen) -> str:
    if seen.ledger is None:
        return "ledger not known yet"
    if "step" not in seen.ledger:
        return f"ledger {seen.ledger['text']}"
    return f"ledger {seen.ledger['text']}, at step {seen.ledger['step']}"


def _substituted(seen: Seen) -> str:
    if seen.period is not None and not seen.period:
        return "nothing is substituted in lock-step"
    why = ", ".join(f"{count} {kind}" for kind, count in seen.reasons.items())
    return (
        f"substituted {seen.pairs_substituted} pairs, {seen.measurements_substituted} measurements"
        f"{f' (said: {why})' if why else ''}"
    )


def _largest(seen: Seen) -> float | None:
    return max((node.error for node in seen.nodes if node.error is not None), default=None)


def _milliseconds(*seconds: float | None) -> str:
    return ", ".join(f"{1e3 * one:.1f}" for one in seconds if one is not None)


def _word(value: object) -> str:
    return "?" if value is None else str(value)


def _number(value: float | None, form: str) -> str:
    return "?" if value is None else f"{value:{form}}"
