"""One node as C for a device: eqs. (4) and (5) with its gains as constants, and a program that tests it there.

Bit for bit what `agent.filter` computes: products and sums in the same order, each rounded once.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from agent.contract.errors import InputError
from agent.contract.files import refuse_overwrite, write_whole
from agent.contract.gains import Gains
from agent.embed import selftest, source
from agent.embed.names import names_of
from agent.embed.network import network_header
from agent.embed.vectors import Vector, answered, made, recorded

STEPS = 200  # that a self-test has, where nothing else is asked for


def export(
    gains: Gains,
    node: str,
    folder: Path,
    *,
    single: bool = False,
    recording: Path | None = None,
    steps: int = STEPS,
    force: bool = False,
) -> dict[str, Any]:
    """Write a header, a source and a self-test of the node into `folder`, and what a program in a run needs to know.

    The self-test has the first `steps` of `recording`, or made ones of the agent's own filter. In `single` precision a
    recording gives what the node is told, and the agent's filter in float32 what it must answer. Returns the facts.
    Raises InputError for what cannot be written, or is not of these gains.
    """
    names = names_of(gains.problem, node)
    own, dtype = gains.for_node(node), np.dtype(np.float32 if single else np.float64)
    told = recorded(gains, node, recording, steps=steps) if recording else made(own, steps=steps, dtype=dtype)
    vectors = answered(own, told, dtype) if single or not recording else told
    texts = {
        f"{names.node}.h": source.header(gains, names, own, dtype),
        f"{names.node}.c": source.body(gains, names, own, dtype),
        f"{names.node}_selftest.c": selftest.program(
            gains, names, own, vectors, dtype, is_recorded=recording is not None
        ),
        f"{names.node}_run.h": network_header(gains, names, own, dtype),
    }
    _write(folder, texts, force=force)
    return {
        "node": node,
        "problem": gains.problem.name,
        "gains": gains.digest(),
        "real": source.REALS[dtype].name,
        "output": str(folder),
        "name": names.node,
        "files": list(texts),
        "recording": str(recording) if recording else None,
        "steps": len(vectors),
        "begins": sum(vector.begins for vector in vectors),
        "off": _off(told, vectors) if recording and single else None,
        "largest": max(float(np.abs(vector.pair.x_hat).max()) for vector in vectors),
    }


def _write(folder: Path, texts: dict[str, str], *, force: bool) -> None:
    """All files or, as far as that can be known beforehand, none."""
    if folder.is_file():
        raise InputError(f"{folder} is a file; --output takes a folder")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"the folder {folder} could not be made: {error.strerror}") from error
    for name in texts:
        refuse_overwrite(folder / name, force=force)
    for name, text in texts.items():
        write_whole(folder / name, text.encode(), force=force)


def _off(told: list[Vector], vectors: list[Vector]) -> float:
    """By how much, at most, an estimate is off the recorded one."""
    return max(
        float(np.abs(one.pair.x_hat - other.pair.x_hat.astype(float)).max())
        for one, other in zip(told, vectors, strict=True)
    )
