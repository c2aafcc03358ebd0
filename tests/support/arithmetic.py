"""How this machine's numpy adds up matrix products: processors differ in it, and so in the last digits."""

from __future__ import annotations

import hashlib

import numpy as np

SAMPLES = 100  # of each size: one alone may come out equal by chance


def fingerprint() -> str:
    """Equal where products of the sizes that the paper's examples have are equal bit for bit."""
    digest, random = hashlib.sha256(), np.random.default_rng(0)  # its numbers are the same everywhere
    for rows in range(1, 5):
        for columns in range(1, 5):
            for _ in range(SAMPLES):
                matrix, vector = random.random((rows, columns)), random.random(columns)
                digest.update((matrix @ vector).tobytes())
    return digest.hexdigest()
