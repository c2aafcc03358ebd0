"""What chance decides: modes, losses, deliveries, disturbance, drawn from counter-based streams.

Every draw is a function of (seed, stream, step) alone: numpy's Philox generator with key (seed, stream) and a
counter that starts at a multiple of the step. So a live run, a simulation and a replay see the same draws
whatever their order, a restarted coordinator goes on with the same chain, and every machine draws the same bits.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from agent.contract.arrays import Array
from agent.contract.elementary import cos_of_turns, exp, log, sin
from agent.contract.errors import InputError
from agent.contract.problem import Problem
from agent.contract.problem.disturbance import DampedSine, Impulse, Quiet, Samples, White, WorstCase

MODES, LOSSES, DISTURBANCE, DELIVERIES, FAULTS = 1, 2, 3, 4, 5  # the streams
_BLOCK = 256  # steps drawn at once; results do not depend on it
_WORDS = 4  # 64-bit words that one count of Philox gives


class Stream:
    """`width` independent uniform numbers in [0, 1) for every step."""

    def __init__(self, *, seed: int, stream: int, width: int) -> None:
        self._key = np.array([seed, stream], dtype=np.uint64)
        self._width = width
        self._counts = -(-width // _WORDS)  # of Philox, for one step
        self._first = -1
        self._block = np.empty((0, width))

    def uniform(self, first: int, steps: int) -> Array:
        """Draws of steps first ... first + steps - 1, (steps, width)."""
        counter = np.array([first * self._counts, 0, 0, 0], dtype=np.uint64)
        words = np.random.Philox(key=self._key, counter=counter).random_raw(steps * self._counts * _WORDS)
        words = words.reshape(steps, self._counts * _WORDS)[:, : self._width]
        return np.asarray((words >> np.uint64(11)) * 2.0**-53)

    def at(self, step: int) -> Array:
        """Draws of one step, (width,)."""
        first = step - step % _BLOCK
        if first != self._first:
            self._first, self._block = first, self.uniform(first, _BLOCK)
        return np.asarray(self._block[step - first])


def modes(problem: Problem, *, seed: int) -> Iterator[int]:
    """r(0), r(1), ... as indices: r(0) is the initial mode, then one row of Pi after the other."""
    stream = Stream(seed=seed, stream=MODES, width=1)
    cumulative = np.cumsum(problem.markov.transition, axis=1)
    cumulative /= cumulative[:, -1:]  # a row may miss 1 by rounding
    s, step = problem.mode_index(problem.markov.initial), 0
    while True:
        yield s
        s = int(np.searchsorted(cumulative[s], stream.at(step)[0], side="right"))
        step += 1


class Losses:
    """theta_i(k) of eq. (3): independent, 1 with probability beta_i."""

    def __init__(self, problem: Problem, *, seed: int) -> None:
        self._beta = problem.beta
        self._stream = Stream(seed=seed, stream=LOSSES, width=problem.n)

    def at(self, step: int) -> Array:
        """1.0 where the plant is in y_i(k), 0.0 where the measurement is lost, (n,)."""
        return (self._stream.at(step) < self._beta).astype(np.float64)


class Deliveries:
    """Whether the message of node j reaches node i at a step: independent, true with probability rho_ij."""

    def __init__(self, problem: Problem, *, seed: int) -> None:
        links, names = problem.links or (), problem.node_names
        self._n = problem.n
        self._at = [names.index(link.receiver) for link in links], [names.index(link.sender) for link in links]
        self._rho = np.array([link.delivery_probability for link in links])
        self._stream = Stream(seed=seed, stream=DELIVERIES, width=len(links))  # in the order of the problem file

    def at(self, step: int) -> NDArray[np.bool_]:
        """(n, n): row i for what node i gets; true where no message is ever lost."""
        delivered = np.ones((self._n, self._n), dtype=bool)
        delivered[self._at] = self._stream.at(step) < self._rho
        return delivered


class DisturbanceSource:
    """w(k), (nw,). `worst_case` is that of the gains; InputError where the problem asks for it and they lack it."""

    def __init__(self, problem: Problem, *, seed: int, worst_case: Array | None = None) -> None:
        if isinstance(problem.disturbance, WorstCase) and worst_case is None:
            raise InputError(
                'the problem asks for disturbance kind "worst-case", but the gains have no worst_case; '
                "design them again"
            )
        self._disturbance, self._worst_case = problem.disturbance, worst_case
        self._nw = problem.nw
        self._stream = Stream(seed=seed, stream=DISTURBANCE, width=2 * problem.nw)

    def at(self, step: int) -> Array:
        match self._disturbance:
            case Quiet():
                return np.zeros(self._nw)
            case DampedSine(amplitude=amplitude, decay=decay, frequency=frequency):
                return np.full(self._nw, amplitude * exp(-decay * step) * sin(frequency * step))
            case Impulse(amplitude=amplitude, at=at):
                return np.full(self._nw, amplitude if step == at else 0.0)
            case Samples(values=values):
                return values[step].copy() if step < len(values) else np.zeros(self._nw)
            case WorstCase(amplitude=amplitude):
                assert self._worst_case is not None
                return amplitude * self._worst_case[step] if step < len(self._worst_case) else np.zeros(self._nw)
            case White(deviation=deviation):
                return deviation * normal(self._stream.at(step))


def normal(uniform: Array) -> Array:
    """Standard normal draws from twice as many uniform ones, by Box and Muller; (..., 2 m) -> (..., m)."""
    half = uniform.shape[-1] // 2
    radius = np.sqrt(-2.0 * log(1.0 - uniform[..., :half]))  # 1 - u is exact
    return np.asarray(radius * cos_of_turns(uniform[..., half:]))
