"""Matrices of fractions: exact, slow, and written without regard to any code that they are held against."""

from __future__ import annotations

from fractions import Fraction

import numpy as np

Exact = list[list[Fraction]]


def exact(matrix: np.ndarray) -> Exact:
    """The floats of a matrix, each as the fraction that it is."""
    return [[Fraction(entry) for entry in row] for row in np.asarray(matrix, dtype=np.float64).tolist()]


def zeros(rows: int, columns: int) -> Exact:
    return [[Fraction(0)] * columns for _ in range(rows)]


def diagonal(entries: np.ndarray) -> Exact:
    out = zeros(len(entries), len(entries))
    for i, entry in enumerate(entries.tolist()):
        out[i][i] = Fraction(entry)
    return out


def transposed(A: Exact) -> Exact:
    return [list(column) for column in zip(*A, strict=True)]


def times(A: Exact, B: Exact) -> Exact:
    columns = transposed(B)
    return [
        [sum((a * b for a, b in zip(row, column, strict=True) if a and b), Fraction(0)) for column in columns]
        for row in A
    ]


def plus(A: Exact, B: Exact, factor: Fraction | int = 1) -> Exact:
    """A + factor B."""
    return [[a + factor * b for a, b in zip(*rows, strict=True)] for rows in zip(A, B, strict=True)]


def block(A: Exact, rows: range, columns: range) -> Exact:
    return [[A[i][j] for j in columns] for i in rows]


def solved(A: Exact, B: Exact) -> Exact:
    """A^-1 B."""
    n, rows = len(A), [list(a) + list(b) for a, b in zip(A, B, strict=True)]
    for k in range(n):
        pivot = next(i for i in range(k, n) if rows[i][k])
        rows[k], rows[pivot] = rows[pivot], rows[k]
        rows[k] = [entry / rows[k][k] for entry in rows[k]]
        for i in range(n):
            if i != k and rows[i][k]:
                rows[i] = [a - rows[i][k] * b for a, b in zip(rows[i], rows[k], strict=True)]
    return [row[n:] for row in rows]


def positive_definite(S: Exact) -> bool:
    """By elimination: all pivots above 0."""
    rest = [list(row) for row in S]
    while rest:
        pivot, *first = rest[0]
        if pivot <= 0:
            return False
        rest = [[a - row[0] * b / pivot for a, b in zip(row[1:], first, strict=True)] for row in rest[1:]]
    return True
