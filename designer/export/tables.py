"""Long and wide tables, written a block of steps at a time, so that memory does not grow with what is written."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from agent.contract.arrays import Array
from agent.contract.extras import needing
from agent.contract.files import writing_whole
from designer.export.columns import Column, columns
from designer.replay.log import Log

LONG = ("step", "node", "field", "value")
_NUMBERS_AT_ONCE = 200_000  # in a block


def write_csv(log: Log, output: Path, *, wide: bool, force: bool) -> int:
    """With a line of titles; numbers as the shortest decimals that give them back, NaN for none. Returns the rows."""
    parts = list(columns(log))
    with writing_whole(output, force=force) as part, part.open("w", encoding="ascii", newline="\n") as file:
        if wide:
            file.write(",".join(["step", "mode_name", *(column.title for column in parts)]) + "\n")
            for now in _blocks(log, parts):
                rows = zip(*(_texts(column.values(now)) for column in parts), strict=True)
                heads = zip(range(now.start, now.stop), _mode_names(log, now), strict=True)
                file.writelines(f"{k},{name},{','.join(row)}\n" for (k, name), row in zip(heads, rows, strict=True))
            return log.steps
        file.write(",".join(LONG) + "\n")
        middles = [f",{column.whose},{column.field}," for column in parts]
        for now in _blocks(log, parts):
            rows = zip(*(_texts(column.values(now)) for column in parts), strict=True)
            for k, row in zip(range(now.start, now.stop), rows, strict=True):
                file.writelines(f"{k}{middle}{value}\n" for middle, value in zip(middles, row, strict=True))
    return log.steps * len(parts)


def write_parquet(log: Log, output: Path, *, wide: bool, force: bool) -> int:
    """The same tables; node, field and mode_name as dictionaries. Returns the rows."""
    with needing("--parquet"):
        import pyarrow as pa
        import pyarrow.parquet as pq
    parts = list(columns(log))
    word = pa.dictionary(pa.int32(), pa.string())
    whose, fields = _dictionary(column.whose for column in parts), _dictionary(column.field for column in parts)

    def block(now: slice) -> Any:
        steps = np.arange(now.start, now.stop, dtype=np.int64)
        values = [column.values(now) for column in parts]
        if wide:
            return [steps, pa.array(list(_mode_names(log, now))).dictionary_encode().cast(word), *values]
        both = (pa.DictionaryArray.from_arrays(np.tile(at, len(steps)), names) for at, names in (whose, fields))
        return [np.repeat(steps, len(parts)), *both, np.column_stack(values).ravel()]

    titles = ["step", "mode_name", *(column.title for column in parts)] if wide else LONG
    types = [pa.int64(), word, *[pa.float64()] * len(parts)] if wide else [pa.int64(), word, word, pa.float64()]
    schema = pa.schema(list(zip(titles, types, strict=True)))
    words = [field.name for field in schema if field.type == word]  # numbers that hardly repeat need no dictionary
    with (
        writing_whole(output, force=force) as part,
        pq.ParquetWriter(part, schema, use_dictionary=words) as writer,
    ):
        for now in _blocks(log, parts):
            writer.write_table(pa.table(block(now), schema=schema))
    return log.steps if wide else log.steps * len(parts)


def _blocks(log: Log, parts: list[Column]) -> Iterator[slice]:
    at_once = max(1, _NUMBERS_AT_ONCE // len(parts))
    for first in range(0, log.steps, at_once):
        yield slice(first, min(first + at_once, log.steps))


def _texts(values: Array) -> Iterator[str]:
    return ("NaN" if value != value else repr(value) for value in values.tolist())


def _mode_names(log: Log, now: slice) -> Iterator[str]:
    """As they were sent; "" where no message is."""
    return (log.modes.texts[mode] if mode >= 0 else "" for mode in log.mode[now].tolist())


def _dictionary(names: Iterator[str]) -> tuple[Array, list[str]]:
    """The place of each name in a list without repetitions, and that list."""
    found: dict[str, int] = {}
    places = [found.setdefault(name, len(found)) for name in names]
    return np.array(places, dtype=np.int32), list(found)
