"""The smallest PNG there is for a map of a few colours: one byte for each cell, and a table of colours."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from designer.report.colours import Colour


def png(cells: NDArray[np.uint8], colours: Sequence[Colour]) -> bytes:
    """(rows, columns) of positions in `colours`, of which there are 256 at most."""
    rows, columns = cells.shape
    lines = np.hstack([np.zeros((rows, 1), dtype=np.uint8), cells])  # each begins with its filter: none
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        [
            _chunk(b"IHDR", struct.pack(">IIBBBBB", columns, rows, 8, 3, 0, 0, 0)),
            _chunk(b"PLTE", bytes(part for colour in colours for part in colour[:3])),
            _chunk(b"tRNS", bytes(colour[3] for colour in colours)),
            _chunk(b"IDAT", zlib.compress(lines.tobytes(), 9)),
            _chunk(b"IEND", b""),
        ]
    )


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
