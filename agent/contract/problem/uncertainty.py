"""How far the numbers of a problem may be off what really is: `tolerance` beside them, and the table `uncertainty`.

A run takes no notice of any of it: filters work with the numbers of the file. What it says is a box of models, for all
of which `design` and `verify` prove a gamma.
"""

from __future__ import annotations

import math
from fractions import Fraction
from typing import Annotated, Any, NamedTuple

import numpy as np
from pydantic import PlainValidator

from agent.contract.arrays import Array, Model, shape_text
from agent.contract.errors import counted, shortened


class Tolerance(NamedTuple):
    """How far a number may be off: in its own units, or as a part of it."""

    size: Fraction
    relative: bool

    def of(self, value: float) -> Fraction:
        return self.size * abs(Fraction(value)) if self.relative else self.size


def tolerance(value: Any, most: float = math.inf) -> Tolerance:
    """Of 0.02, or of "2%", both taken as the decimals that they are. Raises ValueError: what would be right."""
    part = isinstance(value, str) and value.endswith("%")
    text = value.removesuffix("%").strip() if isinstance(value, str) and part else value
    try:
        about = math.nan if isinstance(text, bool | list | dict) else float(text)
    except (TypeError, ValueError, OverflowError):
        about = math.nan
    if (isinstance(value, str) and not part) or not 0.0 <= about <= (100.0 if part else most) or math.isinf(about):
        limit = "0 or more" if math.isinf(most) else f"from 0 to {most:g}"
        raise ValueError(f'{shortened(value)} is no tolerance; it is a number {limit}, or a part up to "100%"')
    if about == 0.0:  # what is too small for a float64 has a numerator of as many digits as it likes
        return Tolerance(Fraction(0), part)
    return Tolerance(Fraction(str(text)) / (100 if part else 1), part)


def _probability(value: Any) -> Any:
    """+- so much, or [below, above]."""
    if not isinstance(value, list | tuple):
        tolerance(value, most=1.0)
        return value
    if len(value) != 2:
        raise ValueError(f"{shortened(value)} has {counted(len(value), 'entry')}; write [below, above]")
    for side in value:
        tolerance(side, most=1.0)
    return list(value)


def _rows(value: Any) -> Any:
    """Total variation, of each row or of all."""
    for size in value if isinstance(value, list | tuple) else [value]:
        try:
            part = tolerance(size, most=1.0).relative
        except ValueError:
            part = True
        if part:
            raise ValueError(f"{shortened(size)} is no total variation; it is a number from 0 to 1, such as 0.05")
    return list(value) if isinstance(value, list | tuple) else value


def _entries(value: Any) -> Any:
    """+- so much of every entry, or a matrix that has it for each."""
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if not isinstance(value, list | tuple):
        tolerance(value)
        return value
    rows = [list(row) if isinstance(row, list | tuple) else None for row in value]
    if not rows or any(not row or len(row) != len(rows[0] or ()) for row in rows):
        raise ValueError(f"{shortened(value)} is no tolerance; it is a number, a part such as '2%', or a list of rows")
    for row in rows:
        for entry in row or ():
            tolerance(entry)
    return rows


def _size(value: Any) -> Any:
    tolerance(value)
    return value


def _probable_size(value: Any) -> Any:
    tolerance(value, most=1.0)
    return value


def _total_variation(value: Any) -> Any:
    if isinstance(value, list | tuple):
        raise ValueError(f"{shortened(value)} is no total variation; it is a number from 0 to 1, such as 0.05")
    return _rows(value)


Probable = Annotated[Any, PlainValidator(_probability)]
Rows = Annotated[Any, PlainValidator(_rows)]
Entries = Annotated[Any, PlainValidator(_entries)]


class OfPlant(Model):
    """`tolerance` of the plant: of entries of the matrices."""

    A: Entries | None = None
    B: Entries | None = None
    M: Entries | None = None


class OfNode(Model):
    """`tolerance` of a node."""

    C: Entries | None = None
    D: Entries | None = None
    arrival_probability: Probable | None = None


class OfLink(Model):
    """`tolerance` of a link."""

    delivery_probability: Probable | None = None


class OfChain(Model):
    """`tolerance` of the chain: total variation of every row of Pi, or of each."""

    transition: Rows | None = None


class Uncertainty(Model):
    """The table `uncertainty`: for all that has no `tolerance` of its own.

    `probabilities` are those of arrival and delivery that are below 1; a probability of 1 is taken to be certain.
    """

    probabilities: Annotated[Any, PlainValidator(_probable_size)] | None = None
    transition: Annotated[Any, PlainValidator(_total_variation)] | None = None
    A: Annotated[Any, PlainValidator(_size)] | None = None
    B: Annotated[Any, PlainValidator(_size)] | None = None
    C: Annotated[Any, PlainValidator(_size)] | None = None
    D: Annotated[Any, PlainValidator(_size)] | None = None
    M: Annotated[Any, PlainValidator(_size)] | None = None


def check_shape(name: str, given: Any, matrix: Array) -> None:
    """A tolerance for each entry has the shape of the matrix."""
    if isinstance(given, list) and np.shape(given) != matrix.shape:
        raise ValueError(
            f"tolerance of {name} is {len(given)} x {len(given[0])}; it has to be like {name}, {shape_text(matrix)}"
        )


def certain(document: dict[str, Any]) -> dict[str, Any]:
    """The document of a problem without its tolerances."""

    def bare(part: Any) -> Any:
        return {key: value for key, value in part.items() if key != "tolerance"} if isinstance(part, dict) else part

    return {
        key: [bare(entry) for entry in part] if isinstance(part, list | tuple) else bare(part)
        for key, part in document.items()
        if key != "uncertainty"
    }
