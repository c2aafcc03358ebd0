"""exp, log, sin and cos against ball arithmetic; and the same bits by whatever instructions numpy has."""

from __future__ import annotations

import math
from collections.abc import Callable

import flint
import numpy as np
import pytest

from agent.contract.arrays import Array
from agent.contract.elementary import cos_of_turns, exp, log, sin

Function = Callable[[Array], Array]


def samples(rng: np.random.Generator) -> dict[str, tuple[Function, Array, Callable[[flint.arb], flint.arb]]]:
    near, wide = rng.uniform(-10.0, 10.0, 500), rng.uniform(-1e6, 1e6, 500)
    u = np.floor(rng.random(500) * 2.0**53) * 2.0**-53
    return {
        "exp": (
            exp,
            np.concatenate([-rng.exponential(5.0, 500), rng.uniform(-700.0, 700.0, 500), [0.0]]),
            flint.arb.exp,
        ),
        "log": (
            log,
            np.concatenate([1.0 - u, 1.0 - u * 1e-6, rng.exponential(1e5, 500), [2.0**-53, 1.0]]),
            flint.arb.log,
        ),
        "sin": (sin, np.concatenate([near, wide, np.arange(500.0)]), flint.arb.sin),
        "cos": (cos_of_turns, np.concatenate([u, np.arange(8) / 8.0, [2.0**-53]]), lambda u: (2 * u).cos_pi()),
    }


@pytest.mark.parametrize("name", ["exp", "log", "sin", "cos"])
def test_errors_are_below_3_units_in_the_last_place(name: str) -> None:
    function, points, exactly = samples(np.random.default_rng(1))[name]
    for x, found in zip(points.tolist(), function(points).tolist(), strict=True):
        with flint.ctx.workprec(200):
            truth = exactly(flint.arb(x))
            error = abs(float(flint.arb(found) - truth))
        assert error < 3.0 * math.ulp(float(truth)), (x, found)


def test_what_is_known_is_exact() -> None:
    assert (exp(0.0), log(1.0), sin(0.0)) == (1.0, 0.0, 0.0)
    assert cos_of_turns([0.0, 0.25, 0.5, 0.75]).tolist() == [1.0, 0.0, -1.0, 0.0]
    assert exp([-800.0, -1e9]).tolist() == [0.0, 0.0]


def test_values_are_those_of_every_version_and_machine() -> None:
    """A recording's seed is worth nothing where they change."""
    found = [float(f(x)).hex() for f, x in ((exp, -0.4), (log, 0.7), (sin, 2.0), (cos_of_turns, 0.3))]
    assert found == ["0x1.57343067270eep-1", "-0x1.6d3c324e13f4fp-2", "0x1.d18f6ead1b446p-1", "-0x1.3c6ef372fe94ep-2"]
