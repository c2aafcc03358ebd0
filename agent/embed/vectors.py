"""What a self-test tells a node, step by step, and what must come out: from a recording, or from the agent's filter."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from agent.contract.arrays import Array
from agent.contract.errors import InputError, listed
from agent.contract.gains import Gains, NodeGains
from agent.contract.keys import decode, estimate, measurement
from agent.contract.messages import Estimate, Measurement
from agent.contract.recording.reader import RecordingReader
from agent.filter import Pair, innovation, step
from agent.product import product

_GROWN = 1e30  # where an estimate of a made run is larger, it begins again, so that float32 can hold the next
_EACH = 10  # steps after which a made run begins again


class Vector(NamedTuple):
    """One step. Where it `begins`, x_hat is given; else it must come out, as innovation and z_hat must."""

    step: int
    begins: bool
    y: Array | None  # None: nothing arrived
    pair: Pair
    z_hat: Array
    mode: str  # by which the next x_hat is made; "" where none is
    heard: dict[str, Pair]  # from other nodes


def recorded(gains: Gains, node: str, recording: Path, *, steps: int) -> list[Vector]:
    """The first `steps` of a recording, as the messages have them.

    Where the recording has a gap, or the node began again, the test begins again. Raises InputError for a recording
    of other gains, and for one in which the node says nothing.
    """
    own = gains.for_node(node)
    told, measured = _messages(gains, own, recording, steps=steps)
    said = [k for k in sorted(told[node]) if not told[node][k].measured or k in measured]
    if not said:
        raise InputError(
            f'{recording} has no step of node "{node}" and its measurement below {steps}; a self-test needs one'
        )
    goes_on = {k for k, after in pairwise(said) if after == k + 1 and _can_go_on(told, node, after)}
    vectors = []
    for k in said:
        message, following = told[node][k], told[node].get(k + 1)
        mode, heard = (following.mode, following.heard) if following and k in goes_on else ("", [])
        y = measured[k].y if message.measured else []
        pairs = {j: _pair(told[j][k]) for j in heard if j != node}
        begins = k - 1 not in goes_on and (k > 0 or any(message.x_hat))
        vectors.append(
            Vector(k, begins, np.array(y) if y else None, _pair(message), np.array(message.z_hat), mode, pairs)
        )
    _check(own, vectors, recording)
    return vectors


def _messages(
    gains: Gains, own: NodeGains, recording: Path, *, steps: int
) -> tuple[dict[str, dict[int, Estimate]], dict[int, Measurement]]:
    """What every node said that this one hears, and what this one measured; of two for one step, the first sent."""
    topics = {estimate(link.sender): link.sender for links in own.links.values() for link in links}
    told: dict[str, dict[int, Estimate]] = {sender: {} for sender in topics.values()}
    measured: dict[int, Measurement] = {}
    with RecordingReader(recording) as reader:
        if reader.gains.digest() != gains.digest():
            raise InputError(
                f"{recording} is of the gains {reader.gains.digest()[:12]}..., these are {gains.digest()[:12]}...; "
                "a self-test needs a recording of the same"
            )
        for logged in reader.messages():
            if logged.topic not in topics and logged.topic != measurement(own.node):
                continue
            try:
                message = decode(logged.topic, logged.payload)
            except ValueError:
                continue  # it cannot be read; as if it were missing
            if message.step < steps and isinstance(message, Estimate):
                told[topics[logged.topic]].setdefault(message.step, message)
            elif message.step < steps and isinstance(message, Measurement):
                measured.setdefault(message.step, message)
    return told, measured


def _can_go_on(told: dict[str, dict[int, Estimate]], node: str, k: int) -> bool:
    """Whether x_hat(k) was made from what the recording has of step k - 1."""
    message = told[node][k]
    return not message.origin and all(k - 1 in told.get(j, {}) for j in message.heard)


def _pair(message: Estimate) -> Pair:
    return Pair(np.array(message.x_hat), np.array(message.innovation))


def _check(own: NodeGains, vectors: list[Vector], recording: Path) -> None:
    """Raise InputError for what cannot be of these gains."""
    nx, sizes = own.M.shape[1], {link.sender: link.H.shape[1] for links in own.links.values() for link in links}
    for vector in vectors:
        where = f'{recording}: step {vector.step} of node "{own.node}"'
        if vector.mode and vector.mode not in own.links:
            raise InputError(f'{where}: there is no mode "{vector.mode}"; the gains have {listed(own.links)}')
        if vector.mode and not vector.heard.keys() <= {link.sender for link in own.links.get(vector.mode, ())}:
            raise InputError(
                f'{where}: it hears {", ".join(vector.heard)} in mode "{vector.mode}"; by its gains it does not'
            )
        pairs = {own.node: vector.pair} | vector.heard
        fits = all((len(pair.x_hat), len(pair.innovation)) == (nx, sizes[j]) for j, pair in pairs.items())
        if not fits or len(vector.z_hat) != len(own.M) or (vector.y is not None and len(vector.y) != len(own.C)):
            raise InputError(f"{where}: a message has another number of numbers than its gains ask for")


def made(own: NodeGains, *, steps: int, dtype: np.dtype[Any]) -> list[Vector]:
    """A run of chance: every mode, what does not arrive, sizes over twelve decades, new beginnings."""
    random, modes, nx = np.random.default_rng(0), list(own.links), own.M.shape[1]

    def some(size: int) -> Array:
        return np.asarray((random.normal(size=size) * 10.0 ** random.uniform(-6, 6)).astype(dtype))

    vectors = []
    for k in range(steps):
        mode, begins = modes[k % len(modes)], k > 0 and k % _EACH == 0
        others = [link for link in own.links[mode] if link.sender != own.node and random.random() < 0.8]
        heard = {link.sender: Pair(some(nx), some(link.H.shape[1])) for link in others}
        y = some(len(own.C)) if random.random() < 0.8 else None
        x_hat = some(nx) if begins and k % (2 * _EACH) else np.zeros(nx)
        vectors.append(Vector(k, begins, y, Pair(x_hat, np.zeros(len(own.C))), np.zeros(len(own.M)), mode, heard))
    return vectors


def answered(own: NodeGains, told: list[Vector], dtype: np.dtype[Any]) -> list[Vector]:
    """The same with what `agent.filter` answers, in numbers of this type."""
    with np.errstate(over="ignore", invalid="ignore"):  # what is beyond it is refused where it is written
        return list(_answers(_of_type(own, dtype), told, dtype))


def _answers(own: NodeGains, told: list[Vector], dtype: np.dtype[Any]) -> Iterator[Vector]:
    x_hat: Array | None = np.zeros(own.M.shape[1], dtype)
    nothing = np.zeros(len(own.C), dtype)
    for vector in told:
        begins = vector.begins or x_hat is None
        if vector.begins:
            x_hat = vector.pair.x_hat.astype(dtype)
        elif x_hat is None:
            x_hat = np.zeros(own.M.shape[1], dtype)
        y = None if vector.y is None else vector.y.astype(dtype)
        nu = nothing if y is None else innovation(own, y, x_hat)
        heard = {j: Pair(*(part.astype(dtype) for part in pair)) for j, pair in vector.heard.items()}
        pair, following = Pair(x_hat, nu), None
        if vector.mode:
            following = step(own, vector.mode, _filled(own, vector.mode, heard | {own.node: pair}, dtype))
            if not (np.abs(following) < _GROWN).all():
                following = None
        mode = vector.mode if following is not None else ""
        yield Vector(vector.step, begins, y, pair, product(own.M, x_hat), mode, heard)
        x_hat = following


def _of_type(own: NodeGains, dtype: np.dtype[Any]) -> NodeGains:
    rows = {mode: rows.astype(dtype) for mode, rows in own.rows.items()}
    return own._replace(
        C=own.C.astype(dtype), M=own.M.astype(dtype), rows=rows, A=None if own.A is None else own.A.astype(dtype),
        arrival_probability=dtype.type(own.arrival_probability),
    )  # fmt: skip


def _filled(own: NodeGains, mode: str, heard: dict[str, Pair], dtype: np.dtype[Any]) -> dict[str, Pair]:
    """With what stands in for the pairs that did not arrive, in numbers of this type."""
    x_hat = heard[own.node].x_hat
    return {
        link.sender: heard.get(link.sender) or Pair(x_hat, np.zeros(link.H.shape[1], dtype)) for link in own.links[mode]
    }
