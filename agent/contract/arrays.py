"""What the models of the contract are made of: read-only float64 arrays, nested lists in files, and strict numbers."""

from __future__ import annotations

import struct
import sys
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import ConfigDict, Field, PlainSerializer, PlainValidator

from agent.contract.errors import counted, shortened
from agent.contract.files import canonical, digest
from agent.contract.frozen import Frozen

Array = NDArray[np.float64]
Number = Annotated[float, Field(strict=True)]  # neither "0.5" nor true is a number


class Model(Frozen):
    """Strict about keys: an unknown one is refused, never ignored."""

    model_config = ConfigDict(extra="forbid", arbitrary_types_allowed=True, allow_inf_nan=False)

    def canonical(self) -> bytes:
        """Canonical JSON: equal models have equal bytes, float64 bit for bit."""
        return canonical(self.document())

    def digest(self) -> str:
        """SHA-256 of the canonical JSON."""
        return digest(self.document())

    def __eq__(self, other: object) -> bool:
        return isinstance(other, type(self)) and self.canonical() == other.canonical()

    def __hash__(self) -> int:
        return hash(self.canonical())


def read_only(values: ArrayLike) -> Array:
    """A contiguous float64 copy that refuses to be written to."""
    copy = np.array(values, dtype=np.float64, order="C")
    copy.flags.writeable = False
    return copy


def _matrix(value: Any) -> Array:
    """A (rows, columns) array from a list of equally long, non-empty lists of finite numbers."""
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if not (isinstance(value, list) and value and all(isinstance(row, list) and row for row in value)):
        raise ValueError(f"must be a matrix, a list of rows such as [[1.0, 0.0]], got {shortened(value)}")
    for number, row in enumerate(value, 1):
        if len(row) != len(value[0]):
            raise ValueError(f"row {number} has {counted(len(row), 'entry')}; row 1 has {len(value[0])}")
        for entry in row:
            if isinstance(entry, bool) or not isinstance(entry, int | float):
                raise ValueError(f"row {number} holds {shortened(entry)}, which is not a number")
            if not abs(entry) <= sys.float_info.max:  # NaN, infinity, or an integer beyond float64
                raise ValueError(f"row {number} holds {shortened(entry)}; every entry must be a finite float64")
    return read_only(np.array(value, dtype=np.float64))


Matrix = Annotated[Array, PlainValidator(_matrix), PlainSerializer(lambda array: array.tolist())]


def _vector(value: Any) -> Array:
    """A (length,) array from a non-empty list of finite numbers."""
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if not (isinstance(value, list) and value and not any(isinstance(entry, list) for entry in value)):
        raise ValueError(f"must be a list of numbers such as [0.1, 0.0], got {shortened(value)}")
    return read_only(_matrix([value])[0])


Vector = Annotated[Array, PlainValidator(_vector), PlainSerializer(lambda array: array.tolist())]


def ulps(a: float, b: float) -> int:
    """How many float64 numbers lie from one to the other: 0 for equal bits, 1 for neighbours, and for 0.0 and -0.0."""
    return abs(_place(a) - _place(b))


def _place(value: float) -> int:
    """A float64's place in the order of all of them."""
    bits: int = struct.unpack("<q", struct.pack("<d", value))[0]
    return bits if bits >= 0 else -(bits & 0x7FFF_FFFF_FFFF_FFFF) - 1


def shape_text(array: Array) -> str:
    """ "2 x 3" for an array of shape (2, 3)."""
    return " x ".join(str(size) for size in array.shape)
