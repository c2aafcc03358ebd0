"""The filter of one node as C99: constants as hexadecimal floats, no memory but what the caller gives, no library."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from importlib.resources import files
from string import Template
from typing import Any, NamedTuple

import numpy as np

from agent.contract.arrays import Array
from agent.contract.errors import InputError
from agent.contract.gains import Gains, NodeGains
from agent.embed.names import Names


class Real(NamedTuple):
    """A type of numbers in C."""

    name: str
    limits: str  # what its limits in float.h begin with
    digits: int  # binary, of its mantissa
    bits: int
    suffix: str
    is_wide: str  # where FLT_EVAL_METHOD says that wider numbers are computed


REALS = {
    np.dtype(np.float64): Real("double", "DBL", 53, 64, "", "FLT_EVAL_METHOD < 0 || FLT_EVAL_METHOD == 2"),
    np.dtype(np.float32): Real("float", "FLT", 24, 32, "f", "FLT_EVAL_METHOD != 0 && FLT_EVAL_METHOD != 16"),
}


def filled(template: str, gains: Gains, names: Names, dtype: np.dtype[Any], **rest: object) -> str:
    """A template of this room, with what all of them name."""
    real = REALS[dtype]
    return Template(files("agent.embed").joinpath(template).read_text()).substitute(
        node=names.node, NODE=names.constants, network=gains.problem.name, digest=gains.digest(), real=real.name,
        REAL=real.limits, **rest,
    )  # fmt: skip


def header(gains: Gains, names: Names, own: NodeGains, dtype: np.dtype[Any]) -> str:
    """The .h: sizes, places, functions."""
    real, senders = REALS[dtype], list(names.senders)
    return filled(
        "node.h.in", gains, names, dtype, name=own.node, digits=real.digits, bits=real.bits, is_wide=real.is_wide,
        nx=own.M.shape[1], ny=len(own.C), nz=len(own.M), ny_most=max(widths(own).values()), senders=len(senders),
        modes=len(own.links), own=senders.index(own.node), losses=_losses(own),
        sender_places=_places(names, names.senders), mode_places=_places(names, names.modes),
    )  # fmt: skip


def body(gains: Gains, names: Names, own: NodeGains, dtype: np.dtype[Any]) -> str:
    """The .c: constants and arithmetic."""
    place, unbiased = {sender: j for j, sender in enumerate(names.senders)}, own.A is not None
    links = [(place[link.sender], link.H.shape[1], mode) for mode, heard in own.links.items() for link in heard]
    zero, blocks = number(0.0, dtype), "a_ij K_ij and a_ij H_ij of its links"
    return filled(
        "node.c.in", gains, names, dtype, name=own.node, zero=zero, minus_zero=number(-0.0, dtype),
        links=",\n".join(f"    {{{sender}, {ny}}} /* {mode} */" for sender, ny, mode in links),
        modes_table=",\n".join(_modes(own)),
        rows=_table(np.concatenate([own.rows[mode].ravel() for mode in own.links]), dtype),
        C=_table(own.C, dtype), M=_table(own.M, dtype),
        beta="" if own.seen else f"{number(own.arrival_probability, dtype)} * ",
        blocks=f"A, then {blocks}, of which the former are for x_hat_j - x_hat_i" if unbiased else blocks,
        first_sum="times(row, own)" if unbiased else number(-0.0, dtype),
        skip="\n    row += NX;" if unbiased else "",
        told="(x_hat[c] - own[c])" if unbiased else "x_hat[c]",
    )  # fmt: skip


def number(value: float, dtype: np.dtype[Any]) -> str:
    """A hexadecimal constant of exactly this value, rounded to float where that is asked for."""
    with np.errstate(over="ignore"):
        rounded = float(dtype.type(value))
    if not np.isfinite(rounded):
        raise InputError(
            f"{value:g} is beyond {REALS[dtype].name}{'; leave --float out' if np.isfinite(value) else ''}"
        )
    return rounded.hex() + REALS[dtype].suffix


def numbers(values: Iterable[float], dtype: np.dtype[Any]) -> str:
    """Constants with commas between."""
    return ", ".join(number(value, dtype) for value in values)


def widths(own: NodeGains) -> dict[str, int]:
    """How many numbers the innovation has of everybody whom the node hears in some mode."""
    return {own.node: len(own.C)} | {link.sender: link.H.shape[1] for heard in own.links.values() for link in heard}


def _losses(own: NodeGains) -> str:
    if own.seen:
        return "The node sees its losses: y - C x_hat."
    return "y - beta C x_hat: a loss of the model is hidden, and y is there all the same."


def _places(names: Names, of: dict[str, str]) -> str:
    return ",\n".join(
        f"    {names.constants}_{constant} = {j} /* {name} */" for j, (name, constant) in enumerate(of.items())
    )


def _modes(own: NodeGains) -> Iterator[str]:
    first = begin = 0
    for mode, heard in own.links.items():
        rows = own.rows[mode]
        yield f"    {{{first}, {first + len(heard)}, {begin}, {rows.shape[1]}}} /* {mode} */"
        first, begin = first + len(heard), begin + rows.size


def _table(values: Array, dtype: np.dtype[Any], *, across: int = 4) -> str:
    flat = values.ravel()
    return ",\n".join(f"    {numbers(flat[at : at + across], dtype)}" for at in range(0, len(flat), across))
