"""Boxes of models as data: what may be asked for, where it is cut, and which corners decide."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from made_recordings import random_problem, real_problem

from agent.contract.errors import InputError
from designer.box.extent import box_of, corners, row_corners, within
from designer.problems import find


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("beta=0.1", "is none of probabilities, transition"),
        ("probabilities", '"" is no tolerance; it is above 0 and at most 1, like 0.02 or 2%'),
        ("probabilities=-0.1", '"-0.1" is no tolerance'),
        ("probabilities=nan", '"nan" is no tolerance'),
        ("probabilities=1/0", '"1/0" is no tolerance'),
        ("probabilities=1e999999999", '"1e999999999" is no tolerance'),
        ("probabilities=1e-999999999", '"1e-999999999" is no tolerance'),
        ("probabilities=150%", '"150%" is no tolerance'),
        ("transition=5%", '"5%" is no tolerance; it is above 0 and at most 1, like 0.05'),
    ],
)
def test_what_is_no_tolerance_is_refused(text: str, sentence: str) -> None:
    with pytest.raises(InputError) as caught:
        within([text])
    assert sentence in str(caught.value)
    assert "\n" not in str(caught.value)


def test_what_cannot_vary_or_varies_in_too_many_ways_is_refused() -> None:
    with pytest.raises(InputError, match="zhu2020-ideal has no arrival or delivery probability below 1"):
        box_of(find("zhu2020-ideal"), within(["probabilities=0.1"]))
    with pytest.raises(InputError, match="has one topology"):
        box_of(random_problem(0, modes=1), within(["transition=0.1"]))
    with pytest.raises(InputError, match="probabilities is there twice"):
        within(["probabilities=0.1", "probabilities=0.2"])
    many = real_problem(0, unbiased=False, ny=(1,) * 8, modes=3)
    with pytest.raises(InputError, match=r"corners, of .* probabilities .* up to 1024 are looked at"):
        box_of(many, within(["probabilities=0.1"]))


def test_intervals_hold_what_was_asked_for_and_are_cut_at_0_and_1() -> None:
    problem = find("zhu2020-lossy")
    for text, size in (("probabilities=0.2", None), ("probabilities=10%", Fraction(1, 10))):
        box = box_of(problem, within([text]))
        assert len(box.intervals) == 4
        for part in box.intervals:
            value = Fraction(float(problem.beta[part.at]))
            far = Fraction(1, 5) if size is None else size * value
            low, high = max(value - far, Fraction(0)), min(value + far, Fraction(1))
            assert low - Fraction(1, 2**52) <= Fraction(part.low) <= low
            assert high <= Fraction(part.high) <= high + Fraction(1, 2**52)
            assert part.cut == (value + far > 1)
        said = [remark for remark in box.remarks() if "is cut to" in remark]
        assert len(said) == sum(part.cut for part in box.intervals)
    assert box_of(problem, within(["probabilities=0.2"])).remarks()[0].startswith('arrival at node "2" is cut to [0.')


@pytest.mark.parametrize("row", [(0.5, 0.3, 0.2), (0.9, 0.1, 0.0, 0.0), (1.0, 0.0)])
@pytest.mark.parametrize("distance", [Fraction(1, 20), Fraction(2, 5), Fraction(1)])
def test_the_corners_of_a_row_are_of_its_box_and_span_it(row: tuple[float, ...], distance: Fraction) -> None:
    middle = [Fraction(pi) for pi in row]
    middle = [pi / sum(middle) for pi in middle]
    found = row_corners(tuple(middle), distance)
    for pi in found:
        assert sum(pi) == 1
        assert min(pi) >= 0
        assert sum(abs(a - b) for a, b in zip(pi, middle, strict=True)) / 2 <= distance
    rng, ends = np.random.default_rng(0), np.array(found, dtype=np.float64)
    for _ in range(300):
        other = rng.dirichlet(np.full(len(row), 0.4))
        far = np.abs(other - row).sum() / 2
        other = row + (other - row) * min(1.0, float(distance) / far)
        c = rng.normal(size=len(row))
        assert c @ other <= (ends @ c).max() + 1e-12


def test_every_end_and_every_row_is_in_a_corner() -> None:
    problem = find("zhu2020-lossy")
    box = box_of(problem, within(["probabilities=0.02", "transition=0.05"]))
    every = corners(problem, box)
    assert len(every) == box.corners
    for s, rows in enumerate(box.rows):
        met = {(tuple(corner.beta), tuple(corner.transition[s])) for corner in every}
        assert len(met) == 16 * len(rows)
