"""What the files of a recording are called. A long run may be split into parts, each a whole recording.

`run.mcap`, `run.part2.mcap`, `run.part3.mcap`, ...; a part is written under its name and `.part`, and gets its name
when it is whole.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Sequence
from pathlib import Path

from agent.contract.errors import InputError
from agent.contract.files import refuse_overwrite


def part_path(path: Path, number: int) -> Path:
    """Part `number` = 1, 2, ... of the recording `path`."""
    return path if number == 1 else path.with_name(f"{path.stem}.part{number}{path.suffix}")


def unfinished(path: Path) -> Path:
    """What a part is called while it is written."""
    return path.with_name(path.name + ".part")


def files_of(path: Path) -> list[Path]:
    """What there is of the recording `path`, in the order of its parts; an unfinished one has the name `unfinished`."""
    if not path.name:  # . or /
        return []
    name = re.compile(re.escape(path.stem) + r"\.part([2-9]|[1-9][0-9]+)" + re.escape(path.suffix) + r"(\.part)?")
    later = [(int(found[1]), there) for there in path.parent.glob("*") if (found := name.fullmatch(there.name))]
    first = [there for there in (path, unfinished(path)) if there.exists()]
    return [*first, *(there for _, there in sorted(later))]


def in_words(files: Sequence[Path | str]) -> str:
    """The files of a recording as a person reads them: "run.mcap", "run.mcap and 2 more, to run.part3.mcap"."""
    first, *more = files
    return f"{first} and {len(more)} more, to {more[-1]}" if more else str(first)


def refuse_recording(path: Path, *, force: bool) -> None:
    """Raise InputError where the recording `path` may not be replaced, or could not be written."""
    refuse_overwrite(path, force=force)  # first: what is a folder has no other parts
    for there in (unfinished(path), *files_of(path)):
        refuse_overwrite(there, force=force)
    try:
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise InputError(f"{path} could not be written: {error.strerror}") from error
