"""Where the numbers of a picture lie: ranges that end near the data, ticks, and the columns of a long run."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from agent.contract.arrays import Array

_NICE = (1.0, 2.0, 2.5, 5.0, 10.0)
_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_MARGIN = 0.04  # of the range, beyond the data


class Scale(NamedTuple):
    """A range of values, linear or logarithmic."""

    low: float
    high: float
    log: bool = False

    def of(self, values: Array) -> Array:
        """0 at `low`, 1 at `high`."""
        if not self.log:
            return np.asarray((values - self.low) / (self.high - self.low))
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(np.log(values / self.low) / math.log(self.high / self.low))

    def ticks(self, wanted: int = 6) -> list[float]:
        """Round numbers within the range, about as many as `wanted`; decades where it is logarithmic."""
        if self.log:
            first, last = math.ceil(math.log10(self.low) - 1e-9), math.floor(math.log10(self.high) + 1e-9)
            every = max(1, math.ceil((last - first + 1) / wanted))
            return [float(f"1e{exponent}") for exponent in range(first, last + 1, every)]
        step = nice_step((self.high - self.low) / wanted)
        first, last = math.ceil(self.low / step - 1e-9), math.floor(self.high / step + 1e-9)
        return [round(number * step, 12 - math.floor(math.log10(step))) for number in range(first, last + 1)]


def nice_step(least: float) -> float:
    """1, 2, 2.5 or 5 times a power of ten, not below `least`."""
    power = 10.0 ** math.floor(math.log10(least))
    return next(nice * power for nice in _NICE if nice * power >= least * (1.0 - 1e-9))


def linear(values: Iterable[Array], *, from_zero: bool = False) -> Scale:
    """A scale that ends near the data; `from_zero` where a length is shown."""
    finite = [part[np.isfinite(part)] for part in values]
    low = min((float(part.min()) for part in finite if part.size), default=0.0)
    high = max((float(part.max()) for part in finite if part.size), default=1.0)
    low = 0.0 if from_zero else low
    room = (high - low) * _MARGIN or max(abs(high), 1.0) * _MARGIN
    return Scale(low if from_zero else low - room, high + room)


def logarithmic(values: Iterable[Array], *, decades: float = math.inf) -> Scale:
    """A logarithmic scale of the values above 0; the lowest may be left out, so that it has no more `decades`."""
    finite = [part[np.isfinite(part) & (part > 0.0)] for part in values]
    high = max((float(part.max()) for part in finite if part.size), default=1.0)
    low = min((float(part.min()) for part in finite if part.size), default=high / 10.0)
    room = max(1.3, (high / low) ** _MARGIN)
    return Scale(max(low / room, high * 10.0**-decades, 1e-300), high * room, log=True)


class Columns(NamedTuple):
    """A run in columns of `stretch` steps each; the last may have fewer."""

    first: int  # step
    stop: int
    stretch: int

    @property
    def number(self) -> int:
        return -(-(self.stop - self.first) // self.stretch)

    def extremes(self, values: Array) -> tuple[Array, Array]:
        """The smallest and the largest value of every column, (count, ...); NaN where it has none."""
        shown = values[self.first : self.stop].astype(np.float64)
        if self.stretch == 1:
            return shown, shown
        filled = np.full((self.number * self.stretch, *shown.shape[1:]), np.nan)
        filled[: len(shown)] = shown
        columns = filled.reshape(self.number, self.stretch, *shown.shape[1:])
        return np.fmin.reduce(columns, axis=1), np.fmax.reduce(columns, axis=1)

    def means(self, values: Array) -> Array:
        """The mean over the known values of every column, (count, ...); NaN where none is."""
        if self.stretch == 1:
            return np.asarray(values[self.first : self.stop].astype(np.float64))
        shown = values[self.first : self.stop].astype(np.float64)
        starts = np.arange(0, len(shown), self.stretch)
        known = np.add.reduceat(np.isfinite(shown).astype(np.float64), starts, axis=0)
        total = np.add.reduceat(np.nan_to_num(shown), starts, axis=0)
        return np.asarray(np.where(known > 0.0, total / np.maximum(known, 1.0), np.nan))


def columns(first: int, stop: int, most: int) -> Columns:
    """At most so many columns, of whole steps."""
    return Columns(first, stop, max(1, -(-(stop - first) // most)))


def brief(value: float, digits: int = 4) -> str:
    """A number for people: 0.0881, 1.2·10⁻¹⁶."""
    mantissa, _, exponent = f"{value:.{digits}g}".partition("e")
    text = f"{mantissa}·10{str(int(exponent)).translate(_RAISED)}" if exponent else mantissa
    return text.replace("-", "−")


def brief_all(values: Array, digits: int = 4) -> Sequence[str]:
    """The same for many, "null" where there is none: JSON."""
    return [f"{value:.{digits}g}" if math.isfinite(value) else "null" for value in values.tolist()]


def step_ticks(first: int, last: int, wanted: int = 8) -> list[int]:
    """Round steps from `first` to `last`, about as many as `wanted`."""
    step = max(1, int(nice_step(max(1.0, (last - first) / wanted))))
    step = 5 * step // 2 if str(step).startswith("2") and step * wanted < (last - first) else step
    return list(range(-(-first // step) * step, last + 1, step))
