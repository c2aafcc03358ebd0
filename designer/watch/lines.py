"""What is seen of a run, for a log, and for a terminal without rich."""

from __future__ import annotations

from collections.abc import Iterator

from designer.watch.scene import Seen


def lines(seen: Seen, *, after: int = -1) -> Iterator[str]:
    """Events with a number beyond `after`, and where the run is: for who reads it in a file."""
    for told in seen.events:
        if told.number > after:
            yield f"  step {told.step}  {told.kind}: {told.text}"
    there = [node for node in seen.nodes if node.there]
    largest = max((node.error for node in seen.nodes if node.error is not None), default=None)
    words = [
        where(seen),
        f"{number(seen.steps_per_second, '.1f')} steps/s",
        f"{len(there)} of {len(seen.nodes)} nodes",
        substituted(seen),
        f"error at most {number(largest, '.3g')}",
        ledger(seen),
    ]
    yield "; ".join(filter(None, words))


def where(seen: Seen) -> str:
    of = "" if seen.steps is None else f" of {seen.steps}"
    return f"step {word(seen.step)}{of}, mode {word(seen.mode)}"


def ledger(seen: Seen) -> str:
    if seen.ledger is None:
        return "ledger not known yet"
    if "step" not in seen.ledger:
        return f"ledger {seen.ledger['text']}"
    since = f", seen from step {seen.ledger['since']} on" if seen.ledger["since"] else ""
    return f"ledger at step {seen.ledger['step']}{since}: {seen.ledger['text']}"


def substituted(seen: Seen) -> str:
    if seen.period is not None and not seen.period:
        return ""  # nothing is, in lock-step
    why = ", ".join(f"{count} {kind}" for kind, count in seen.reasons.items())
    missed = f"substituted {seen.pairs_substituted} pairs, {seen.measurements_substituted} measurements"
    return f"{missed}; events name {why}" if why else missed


def word(value: object) -> str:
    return "?" if value is None else str(value)


def number(value: float | None, form: str) -> str:
    return "?" if value is None else f"{value:{form}}"
