"""How this machine's numpy adds up matrix products: processors differ in the order, and so in the last digits."""

from __future__ import annotations

import hashlib

import numpy as np


def fingerprint() -> str:
    """Equal where products of all sizes up to 8 are equal bit for bit; the factors are exact everywhere."""
    digest = hashlib.sha256()
    for rows in range(1, 9):
        for columns in range(1, 9):
            matrix = 1.0 / np.arange(3.0, 3.0 + rows * columns).reshape(rows, columns)
            digest.update((matrix @ (1.0 / np.arange(7.0, 7.0 + columns))).tobytes())
            digest.update((matrix @ matrix.T).tobytes())
    return digest.hexdigest()
