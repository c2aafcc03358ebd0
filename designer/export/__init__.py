"""A recording as a table for other programs: CSV and Parquet, long or wide, and MATLAB's .mat.

Long: a row for each number, with step, node, field and value. Wide: a row for each step, a column for each number.
Every float64 comes back bit for bit.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from designer.export.tables import write_csv, write_parquet
from designer.replay.log import Log

FORMATS = ("csv", "parquet", "mat")


def export(log: Log, output: Path, *, to: str, wide: bool = False, force: bool = False) -> dict[str, Any]:
    """Write the table, whole or not at all; returns its facts. Raises InputError where it cannot be written.

    `to` is one of FORMATS; a .mat file has arrays, which are neither long nor wide.
    """
    writers: dict[str, Callable[[], int]] = {
        "csv": lambda: write_csv(log, output, wide=wide, force=force),
        "parquet": lambda: write_parquet(log, output, wide=wide, force=force),
        "mat": lambda: _write_mat(log, output, force=force),
    }
    rows = writers[to]()
    return {
        "recording": log.label,
        "output": str(output),
        "format": to,
        "shape": "arrays" if to == "mat" else "wide" if wide else "long",
        "steps": log.steps,
        "rows": rows,
        "absent": log.census.missing.total + log.census.lacking.total,
        "finished": log.finished,
        "damage": log.damage,
    }


def _write_mat(log: Log, output: Path, *, force: bool) -> int:
    from designer.export.matlab import write_mat  # it loads scipy

    return write_mat(log, output, force=force)
