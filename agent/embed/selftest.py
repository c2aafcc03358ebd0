"""A program in C that tells a node what it was told, and compares every number that it answers."""

from __future__ import annotations

from typing import Any

import numpy as np

from agent.contract.arrays import Array
from agent.contract.gains import Gains, NodeGains
from agent.embed.names import Names
from agent.embed.source import filled, numbers, widths
from agent.embed.vectors import Vector


def program(
    gains: Gains, names: Names, own: NodeGains, vectors: list[Vector], dtype: np.dtype[Any], *, is_recorded: bool
) -> str:
    """The text of the program; the vectors are recorded, or else made up and answered by the agent's filter."""
    agents = "what the node of peakmesh answers" + (" in float" if dtype == np.float32 else "")
    whose = "what the node of a recorded run did" if is_recorded and dtype == np.float64 else agents
    return filled(
        "selftest.c.in", gains, names, dtype, name=own.node, whose=whose, steps=len(vectors),
        vectors=",\n".join(_vector(names, own, vector, dtype) for vector in vectors),
    )  # fmt: skip


def _vector(names: Names, own: NodeGains, vector: Vector, dtype: np.dtype[Any]) -> str:
    def braced(values: Array, size: int = 0) -> str:
        return f"{{{numbers([*values, *[0.0] * (size - len(values))], dtype)}}}"

    most, x_hat = max(widths(own).values()), vector.pair.x_hat
    nothing = np.zeros(0)
    pairs = [
        f"{{{braced(pair.x_hat, len(x_hat))}, {braced(pair.innovation, most)}, 1}}" if pair
        else f"{{{braced(nothing, len(x_hat))}, {braced(nothing, most)}, 0}}"
        for pair in (vector.heard.get(sender) for sender in names.senders)
    ]  # fmt: skip
    zero = not x_hat.any() and not np.signbit(x_hat).any()
    begins = "GOES_ON" if not vector.begins else "BEGINS_WITH_ZERO" if zero else "BEGINS_WITH_X_HAT"
    mode = f"{names.constants}_{names.modes[vector.mode]}" if vector.mode else "NO_STEP"
    y = nothing if vector.y is None else vector.y
    return (
        f"    {{{vector.step}, {begins}, {int(vector.y is not None)}, {braced(y, len(own.C))},\n"
        f"     {braced(x_hat)}, {braced(vector.pair.innovation)}, {braced(vector.z_hat)},\n"
        f"     {mode}, {{{', '.join(pairs)}}}}}"
    )
