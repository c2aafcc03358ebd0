"""Boxes of models as data: what may be asked for, where it is cut, and which corners decide."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from made_recordings import random_problem, real_problem

from agent.contract.errors import InputError
from designer.box.extent import box_in, box_of, corners, within
from designer.box.robust import robust
from designer.box.rows import row_corners
from designer.model.error_model import link_gains
from designer.problems import find
from designer.search.starts import ignoring


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


def test_the_tolerances_of_a_problem_are_its_box_and_its_own_words_come_first() -> None:
    problem = find("zhu2020-lossy")
    assert box_in(problem) is None
    said = problem.with_(uncertainty={"probabilities": 0.02, "transition": 0.05})
    asked = box_of(problem, within(["probabilities=0.02", "transition=0.05"]))
    assert box_in(said) == asked._replace(extent="tolerances of the problem file")
    own = said.with_(
        node={
            "2": {"tolerance": {"arrival_probability": [0.25, "10%"]}},
            "3": {"tolerance": {"arrival_probability": 0}},
        },
        markov={"tolerance": {"transition": [0, 0.05, 0, 0]}},
    )
    box = box_in(own)
    assert box is not None
    ends = {part.at: (part.low, part.high) for part in box.intervals}
    assert ends.keys() == {(0,), (1,), (3,)}
    assert ends[1,] == pytest.approx((0.6, 0.935), abs=1e-15)
    assert [len(rows) > 1 for rows in box.rows] == [False, True, False, False]
    assert box.rows[1] == asked.rows[1]


def test_a_probability_of_1_is_certain_unless_it_says_that_it_is_not() -> None:
    problem = find("zhu2020-ideal").with_(uncertainty={"probabilities": 0.02})
    assert box_in(problem) is None
    box = box_in(problem.with_(node={"1": {"tolerance": {"arrival_probability": 0.02}}}))
    assert box is not None
    assert [(part.at, part.high, part.cut) for part in box.intervals] == [((0,), 1.0, True)]


def test_a_tolerance_moves_with_the_value_beside_it() -> None:
    problem = find("zhu2020-lossy").with_(node={"1": {"tolerance": {"arrival_probability": [0.01, 0.02]}}})
    for value in (0.5, 0.8):
        box = box_in(problem.with_(node={"1": {"arrival_probability": value}}))
        assert box is not None
        assert (box.intervals[0].low, box.intervals[0].high) == pytest.approx((value - 0.01, value + 0.02), abs=1e-15)


def test_where_m_cancels_it_is_said_of_boxes_of_entries() -> None:
    """And floats that see no gain of such a model any more are no end of the program."""
    problem = find("zhu2020-lossy")
    M = [[1.0, -1.0 - 1e-9, *[0.0] * (problem.nx - 2)]]
    alike = problem.with_(
        plant={"A": 0.5 * np.eye(problem.nx), "B": np.full((problem.nx, problem.nw), 0.7), "M": np.array(M)}
    )
    for texts, said in ((["C=1%"], True), (["D=1%"], False), (["probabilities=0.02"], False)):
        remarks = box_of(alike, within(texts)).remarks()
        assert any(remark.startswith("M nearly cancels") for remark in remarks) is said
    assert not any("cancels" in remark for remark in box_of(problem, within(["C=1%"])).remarks())
    K, H = link_gains(alike, *ignoring(alike))
    assert robust(alike, K, H, box_of(alike, within(["C=1%"]))).lines()


def test_a_box_of_too_many_corners_is_refused_in_a_problem_too() -> None:
    many = real_problem(0, unbiased=False, ny=(1,) * 8, modes=3).with_(uncertainty={"probabilities": 0.1})
    with pytest.raises(InputError, match=r"uncertainty: the box has .* corners"):
        box_in(many)
