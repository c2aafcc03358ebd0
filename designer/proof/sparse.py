"""Sparse matrices of a proof in floats: scipy's, and where it is not installed rows of our own, which are slower.

Both add up the products of a row's entries in some order; that is all a proof takes for granted of them, and `fault` of
designer.proof.machine looks at whichever is there.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from agent.contract.arrays import Array

Indices = NDArray[np.int64]


def matrix(entries: Array, rows: Indices, columns: Indices, shape: tuple[int, int]) -> Any:
    """With these entries at these places, and with `data`, `indptr`, `nnz`, `T`, [rows] and @ as scipy's have them."""
    try:
        from scipy import sparse
    except ModuleNotFoundError:
        return Rows.of(entries, rows, columns, shape)
    return sparse.csr_array((entries, (rows, columns)), shape=shape)


class Rows:
    """Row i has `data[indptr[i] : indptr[i + 1]]`, in the columns `indices` of the same places."""

    def __init__(self, data: Array, indices: Indices, indptr: Indices, columns: int) -> None:
        self.data, self.indices, self.indptr, self._columns = data, indices, indptr, columns

    @classmethod
    def of(cls, entries: Array, rows: Indices, columns: Indices, shape: tuple[int, int]) -> Rows:
        order = np.lexsort((columns, rows))
        indptr = np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=shape[0]))])
        return cls(np.asarray(entries)[order], columns[order], indptr.astype(np.int64), shape[1])

    @property
    def nnz(self) -> int:
        return len(self.data)

    @property
    def T(self) -> Rows:
        return Rows.of(self.data, self.indices, self._row_of_each(), (self._columns, len(self.indptr) - 1))

    def tocsr(self) -> Rows:
        return self

    def __getitem__(self, at: Indices) -> Rows:
        lengths = np.diff(self.indptr)
        kept = np.concatenate([np.arange(self.indptr[i], self.indptr[i + 1]) for i in at] or [np.arange(0)])
        indptr = np.concatenate([[0], np.cumsum(lengths[at])]).astype(np.int64)
        return Rows(self.data[kept], self.indices[kept], indptr, self._columns)

    def __matmul__(self, X: Array) -> Array:
        """Times (columns,) or (columns, k)."""
        out, filled = np.zeros((len(self.indptr) - 1, *X.shape[1:])), np.flatnonzero(np.diff(self.indptr))
        terms = self.data.reshape(-1, *[1] * (X.ndim - 1)) * X[self.indices]
        if len(filled):
            out[filled] = np.add.reduceat(terms, self.indptr[filled], axis=0)
        return out

    def _row_of_each(self) -> Indices:
        return np.repeat(np.arange(len(self.indptr) - 1), np.diff(self.indptr))
