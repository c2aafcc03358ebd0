"""The section of the page on how a paced run kept time."""

from __future__ import annotations

from collections.abc import Iterator
from html import escape

from designer.replay.pacing import Pacing
from designer.report.account import Account

HEADS = (
    ("node", "col", 1), ("measurement to estimate, ms", "colgroup", 3), ("tick to step, ms", "colgroup", 3),
)  # fmt: skip


def clock(account: Account) -> str:
    """What was substituted and why, and the delays that the nodes have told; nothing in lock-step."""
    pacing = account.verdict.pacing
    if pacing is None:
        return ""
    said = "".join(f"<li>{escape(line)}</li>" for line in pacing.text())
    return f'<section id="clock"><h2>Against the clock</h2><ul class="faults">{said}</ul>{_delays(pacing)}</section>'


def _delays(pacing: Pacing) -> str:
    if not pacing.delays:
        return ""
    groups = "".join(f'<th scope="{scope}" colspan="{span}">{name}</th>' for name, scope, span in HEADS)
    each = "<th></th>" + 2 * "".join(f'<th scope="col">{name}</th>' for name in ("median", "99 %", "most"))
    rows = "".join(_rows(pacing))
    head = f"<thead><tr>{groups}</tr><tr>{each}</tr></thead>"
    return f'<div class="wide"><table class="numbers">{head}<tbody>{rows}</tbody></table></div>'


def _rows(pacing: Pacing) -> Iterator[str]:
    for delays in pacing.delays:
        cells = "".join(f"<td>{1e3 * seconds:.2f}</td>" for seconds in (*delays.to_estimate, *delays.to_step))
        yield f'<tr><th scope="row">{escape(delays.node)}</th>{cells}</tr>'
