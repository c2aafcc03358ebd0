"""L-BFGS on functions that are not smooth."""

from __future__ import annotations

import numpy as np

from agent.contract.arrays import Array
from designer.search import bfgs


def test_bfgs_finds_a_minimum_with_a_kink() -> None:
    """Nesterov's nonsmooth variant of Rosenbrock's function, minimum 0 at (1, 1)."""

    def kinked(x: Array) -> tuple[float, Array]:
        inner = x[1] - 2.0 * x[0] ** 2 + 1.0
        gradient = np.array([(x[0] - 1.0) / 2.0 - 4.0 * x[0] * np.sign(inner), np.sign(inner)])
        return float((x[0] - 1.0) ** 2 / 4.0 + abs(inner)), gradient

    point = bfgs.start(kinked, np.array([-1.0, 1.3]), np.copy)
    for _ in range(300):
        following = bfgs.step(kinked, point)
        if following is None:
            break
        point = following
    assert point.value < 1e-5


def test_a_quadratic_is_minimised_from_an_inverse_hessian_of_any_size() -> None:
    """A thousand times too large or too small: in 30 steps."""
    curvatures = np.array([1.0, 1.0, 1.0, 10.0, 10.0, 300.0])

    def quadratic(x: Array) -> tuple[float, Array]:
        return float(curvatures @ x**2) / 2.0, curvatures * x

    for factor in (1e-3, 1.0, 1e3):
        point = bfgs.start(quadratic, np.ones(6), lambda q, factor=factor: factor * q)  # type: ignore[misc]
        for _ in range(30):
            following = bfgs.step(quadratic, point)
            if following is None:
                break
            point = following
        assert point.value < 1e-12
