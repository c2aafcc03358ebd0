"""--quiet: on stderr nothing but errors and warnings."""

from __future__ import annotations

import io
from typing import TextIO

KEPT = ("peakmesh: ", "warning: ")


class Quiet(io.TextIOBase):
    """Passes on the lines that begin so; it is no terminal, on which bars would be drawn."""

    def __init__(self, stream: TextIO) -> None:
        self._stream, self._begun = stream, ""

    def write(self, text: str) -> int:
        *lines, self._begun = (self._begun + text).split("\n")
        for line in lines:
            if line.startswith(KEPT):
                self._stream.write(f"{line}\n")
        return len(text)

    def flush(self) -> None:
        self._stream.flush()

    def fileno(self) -> int:
        return self._stream.fileno()
