"""Several recordings at once: parts of one run are one, different runs make a table."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from agent.contract.errors import EXIT_BROKEN, EXIT_GOOD, EXIT_INPUT, EXIT_NO, InputError
from agent.contract.recording.contents import chosen
from agent.contract.recording.reader import runs_of
from designer.replay import replay
from designer.replay.verdict import Verdict

_GRAVITY = (EXIT_GOOD, EXIT_BROKEN, EXIT_INPUT, EXIT_NO)  # of exit codes, the gravest last


class Table(NamedTuple):
    """A verdict for each run, or the sentence that says why there is none."""

    rows: tuple[tuple[str, Verdict | str], ...]

    @property
    def exit_code(self) -> int:
        """The gravest of all."""
        codes = [found.exit_code if isinstance(found, Verdict) else EXIT_INPUT for _, found in self.rows]
        return max(codes, key=_GRAVITY.index)

    def document(self) -> dict[str, Any]:
        return {
            "recordings": [
                found.document() if isinstance(found, Verdict) else {"recording": label, "error": found}
                for label, found in self.rows
            ]
        }

    def text(self) -> str:
        lines = [["recording", "outcome", "run", "seed", "steps", "messages", "largest gap", "of tolerance"]]
        for label, found in self.rows:
            if isinstance(found, str):
                lines.append([label, f"refused: {found}", *[""] * 6])
                continue
            share = f"{100.0 * found.worst_gap / found.tolerance:.2g} %" if found.compared else "-"
            steps = f"{found.steps}/{found.planned}"
            gap = f"{found.worst_gap:.1e}" if found.compared else "-"
            lines.append([label, found.outcome, found.run, str(found.seed), steps, str(found.messages), gap, share])
        judged = [line for line in lines if line[2]]
        widths = [
            max(len(line[0]) for line in lines),
            *(max(map(len, column)) for column in [*zip(*judged, strict=True)][1:]),
        ]
        return "\n".join(
            "  ".join(f"{cell:{width}}" for cell, width in zip(line, widths, strict=True)).rstrip() for line in lines
        )


def together(paths: Sequence[Path], *, run: str | None) -> list[list[Path]]:
    """The files in groups, each the parts of one run. A single file, and one that holds no run, is alone."""
    if len(paths) == 1:
        return [list(paths)]
    groups: dict[object, list[Path]] = {}
    for path in paths:
        try:
            key: object = chosen(runs_of(path), run, label=str(path)).identity
        except InputError:
            key = path  # said when it is its turn
        groups.setdefault(key, []).append(path)
    return list(groups.values())


def replay_all(groups: Sequence[Sequence[Path]], **options: Any) -> Table:
    """Judge every group; `options` as of `replay`."""
    rows: list[tuple[str, Verdict | str]] = []
    for group in groups:
        label = str(group[0]) + (f" and {len(group) - 1} more" if len(group) > 1 else "")
        try:
            rows.append((label, replay(group, **options)))
        except InputError as error:
            rows.append((label, str(error)))
    return Table(tuple(rows))
