"""The worst entries by their slope, and how near a proof for many entries comes to them."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
from made_recordings import random_gains, real_problem

from agent.contract.gains import Gains
from designer.box import deviating
from designer.box.deviating import Deviating, worst_constant
from designer.box.extent import Box, box_of, truth_at, within
from designer.box.robust import proved_at, robust
from designer.box.weights import Recipe
from designer.box.worst import real_model, worst
from designer.gain.exact import exact_gain
from designer.proof.ball_model import told
from designer.proof.cube import Cube


@cache
def six() -> tuple[Gains, Box]:
    """Nodes of two states, with losses seen and hidden, lossy links and weights; every entry may be off."""
    gains = random_gains(real_problem(3, unbiased=False, ny=(1, 2, 1, 1, 2, 1), modes=2))
    return gains, box_of(gains.problem, within(["A,B,C,D=1%"]))


def cube_of(gains: Gains, box: Box) -> Cube:
    return Cube(gains.problem, gains.K, gains.H, told(gains.problem)._replace(carry=box.carry), box.entries)


def test_forty_entries_of_six_nodes_are_proved_not_far_above_the_worst_that_is_found() -> None:
    gains, box = six()
    assert len(box.entries) == 40
    found = robust(gains.problem, gains.K, gains.H, box)
    assert found.gamma is not None
    assert found.found <= found.gamma < 1.03 * found.found
    assert found.recipe.rounds

    again = proved_at(gains.problem, gains.K, gains.H, box, found.worst, found.gamma, found.recipe)
    assert again is not None
    assert again.holds
    without = proved_at(gains.problem, gains.K, gains.H, box, found.worst, found.gamma, Recipe(0, ()))
    assert without is not None
    assert not without.holds  # so it is the rounds that prove it


def small() -> tuple[Gains, Box]:
    gains = random_gains(real_problem(4, unbiased=False, ny=(1, 1), modes=2))
    return gains, box_of(gains.problem, within(["A,B,C,D,M=2%"]))


def test_the_worst_entries_are_as_bad_as_is_said_and_no_single_sign_is_worse() -> None:
    gains, box = small()
    problem, found = gains.problem, worst(gains.problem, gains.K, gains.H, box)

    def gain(signs: tuple[int, ...]) -> float:
        truth = truth_at(problem, box, [], found.rows, signs)
        return exact_gain(real_model(problem, gains.K, gains.H, truth)).low

    assert gain(found.signs) == pytest.approx(found.gain, rel=1e-4)
    assert set(found.signs) <= {-1, 1}
    for k in range(len(box.entries)):
        flipped = (*found.signs[:k], -found.signs[k], *found.signs[k + 1 :])
        assert gain(flipped) < found.gain * (1.0 + 1e-3)


def test_the_slope_by_an_entry_agrees_with_differences(monkeypatch: pytest.MonkeyPatch) -> None:
    gains, box = small()
    cube = cube_of(gains, box)
    monkeypatch.setattr(deviating, "_WIDTH", 1e-10)
    monkeypatch.setattr(deviating, "_HORIZON", 20)
    at = Deviating(0.0, np.zeros_like(cube.deviations.radii), np.zeros_like(cube.deviations.of_M))
    g = deviating._least(cube, at, 100.0)
    by_D, by_M = deviating._slopes(cube, at, g * (1.0 + 1e-6))

    def rise(entry: int, step: float = 1e-4) -> float:
        ends = []
        for sign in (-1.0, 1.0):
            moved = at._replace(D=at.D.copy(), of_M=at.of_M.copy())
            of_letter = moved.of_M if box.entries[entry].matrix == "M" else moved.D
            of_letter[cube.deviations.places[entry]] = sign * step
            ends.append(deviating._least(cube, moved, g))
        return (ends[1] - ends[0]) / step

    slopes = []
    for entry, place in zip(box.entries, cube.deviations.places, strict=True):
        slopes.append(float(by_M[place] if entry.matrix == "M" else by_D[place]))
    chosen = [*np.argsort(-np.abs(slopes))[:3].tolist(), [entry.matrix for entry in box.entries].index("M")]
    ratios = [rise(k) / slopes[k] for k in chosen]
    assert ratios == pytest.approx([ratios[0]] * len(ratios), rel=0.02)


def test_a_model_that_has_no_gain_is_infinite() -> None:
    gains, _ = small()
    box = box_of(gains.problem, within(["A=60%"]))
    assert math.isinf(worst(gains.problem, gains.K, gains.H, box).gain)
    assert worst_constant(cube_of(gains, box), 1.0).low > 100.0
