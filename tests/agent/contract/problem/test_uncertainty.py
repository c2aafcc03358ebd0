"""How far numbers may be off, as a problem file says it."""

from __future__ import annotations

import tomllib
from fractions import Fraction
from typing import Any

import pytest

from agent.contract.errors import InputError
from agent.contract.problem import Problem
from agent.contract.problem.uncertainty import Tolerance, tolerance
from designer.problems import find
from designer.problems.written import to_toml

TOLERANT: dict[str, Any] = {
    "plant": {"tolerance": {"A": "1%", "B": 0.001, "M": [[0, 0.1]]}},
    "node": {"1": {"tolerance": {"C": [[0.1, "2%"]], "arrival_probability": [0.05, "2%"]}}},
    "markov": {"tolerance": {"transition": [0.05, 0, 0.1, 0]}},
    "uncertainty": {"probabilities": 0.02, "D": "5%"},
}


@pytest.mark.parametrize(
    ("value", "of_3"),
    [
        (0.5, Fraction(1, 2)),
        (0.02, Fraction(2, 100)),
        ("2%", Fraction(6, 100)),
        (0, Fraction(0)),
        ("0.5 %", Fraction(15, 1000)),
    ],
)
def test_a_tolerance_is_a_number_or_a_part(value: Any, of_3: Fraction) -> None:
    assert tolerance(value).of(-3.0) == of_3


def test_tolerances_survive_being_written_and_read_and_leave_the_rest_as_it_was() -> None:
    problem = find("zhu2020-lossy")
    tolerant = problem.with_(**TOLERANT)
    assert Problem.from_document(tomllib.loads(to_toml(tolerant))) == tolerant
    assert tolerant != problem
    assert tolerant.certain() == problem
    assert tolerant.digest() != problem.digest() == problem.certain().digest()


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (
            {"node": {"1": {"tolerance": {"arrival_probability": -1}}}},
            'node "1": tolerance: arrival_probability: -1 is',
        ),
        (
            {"node": {"1": {"tolerance": {"arrival_probability": 1.5}}}},
            "1.5 is no tolerance; it is a number from 0 to 1",
        ),
        ({"node": {"1": {"tolerance": {"arrival_probability": "101%"}}}}, "'101%' is no tolerance"),
        ({"node": {"1": {"tolerance": {"arrival_probability": [0.1] * 3}}}}, "has 3 entries; write [below, above]"),
        ({"node": {"1": {"tolerance": {"C": [[1, 2, 3]]}}}}, "tolerance of C is 1 x 3; it has to be like C, 1 x 2"),
        ({"node": {"1": {"tolerance": {"C": [[1, 2], [3]]}}}}, "is no tolerance; it is a number, a part such as"),
        ({"node": {"1": {"tolerance": 0.1}}}, 'node "1": tolerance: must be a table of keys and values'),
        ({"plant": {"tolerance": {"A": True}}}, "plant: tolerance: A: True is no tolerance; it is a number 0 or more"),
        ({"plant": {"tolerance": {"A": float("nan")}}}, "A: nan is no tolerance"),
        ({"plant": {"tolerance": {"A": "1e999999999%"}}}, "is no tolerance"),
        ({"plant": {"tolerance": {"C": 1}}}, "plant: tolerance: C: this key is not known here"),
        ({"markov": {"tolerance": {"transition": "2%"}}}, "'2%' is no total variation; it is a number from 0 to 1"),
        (
            {"markov": {"tolerance": {"transition": [0.1]}}},
            "has 1 entry; it is a number, or one for each of 4 topologies",
        ),
        (
            {"uncertainty": {"probabilties": 1}},
            'uncertainty: probabilties: this key is not known here; did you mean "pro',
        ),
        ({"uncertainty": {"A": [[1]]}}, "uncertainty: A: [[1]] is no tolerance"),
        ({"uncertainty": {"transition": [0.1]}}, "uncertainty: transition: [0.1] is no total variation"),
    ],
)
def test_what_is_no_tolerance_is_refused_in_one_sentence(change: dict[str, Any], sentence: str) -> None:
    with pytest.raises(InputError) as caught:
        find("zhu2020-lossy").with_(**change)
    assert sentence in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_part_that_is_too_small_for_a_float_is_0() -> None:
    assert tolerance("1e-999999999%") == Tolerance(Fraction(0), relative=True)
