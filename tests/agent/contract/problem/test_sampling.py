"""Plants of continuous time: exact at their samples, said in files, and refused where they make no sense."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_recordings import random_problem
from scipy.linalg import expm

from agent.contract.errors import InputError
from agent.contract.problem import Problem
from agent.contract.problem.parts import Plant
from agent.contract.problem.sampling import sampled
from designer.model.units import NaturalUnits
from designer.show import describe, text

PLANT: dict[str, Any] = {
    "A_continuous": [[0.0, 1.0], [-2.0, -3.0]],
    "B_continuous": [[0.0, 0.0], [1.0, 0.5]],
    "sample_time": 0.1,
    "M": [[1.0, 0.0]],
}


@pytest.mark.parametrize("period", [1e-3, 0.1, 3.0])
def test_it_is_the_exponential(period: float) -> None:
    """Of a matrix with B beside it, against scipy."""
    rng = np.random.default_rng(0)
    A, B = rng.normal(size=(3, 3)), rng.normal(size=(3, 2))
    both = np.zeros((5, 5))
    both[:3] = np.hstack([A, B])
    expected = expm(both * period)[:3]
    np.testing.assert_allclose(np.hstack(sampled(A, B, period)), expected, rtol=1e-12, atol=1e-14)


def test_it_is_exact() -> None:
    """Known numbers: a double integrator, decay, growth, what is stiff, and a plant that stands still."""
    A, B = sampled(np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]]), 0.5)
    assert (A.tolist(), B.tolist()) == ([[1.0, 0.5], [0.0, 1.0]], [[0.125], [0.5]])
    for rate in (-1.0, 1.0, -300.0, 600.0):
        (a,), (b,) = (row for matrix in sampled(np.array([[rate]]), np.array([[1.0]]), 1.0) for row in matrix.tolist())
        assert a == pytest.approx(np.exp(rate), rel=1e-14)
        assert b == pytest.approx(np.expm1(rate) / rate, rel=1e-14)
    A, B = sampled(np.zeros((1, 1)), np.array([[3.0]]), 0.25)
    assert (A.tolist(), B.tolist()) == ([[1.0]], [[0.75]])


def continuous() -> Problem:
    document = random_problem(5, ny=(1, 2, 1), modes=2).document()
    return Problem.from_document(document | {"plant": PLANT})


def test_a_problem_keeps_what_it_was_made_of(tmp_path: Path) -> None:
    """The document has both, is read again as the same, and is shown; in other units the plant is one of samples."""
    problem = continuous()
    A, B = sampled(np.array(PLANT["A_continuous"]), np.array(PLANT["B_continuous"]), 0.1)
    assert (problem.plant.A.tolist(), problem.plant.B.tolist()) == (A.tolist(), B.tolist())
    assert Problem.from_document(problem.document()) == problem
    natural = NaturalUnits(problem).problem.plant
    assert natural.sample_time is None
    np.testing.assert_allclose(np.linalg.eigvals(natural.A), np.linalg.eigvals(A))
    document = random_problem(5, ny=(1, 2, 1), modes=2).document()
    assert "sample_time" not in document["plant"]


def test_show_says_what_was_sampled(tmp_path: Path) -> None:
    lines = [f"{key} = {value}" for key, value in PLANT.items()]
    (tmp_path / "p.toml").write_text(
        'name = "p"\n[plant]\n' + "\n".join(lines) + '\n[[node]]\nname = "1"\nC = [[1.0, 0.0]]\nD = [[0.0, 1.0]]\n'
        'arrival_probability = 1.0\n[[topology]]\nname = "on"\nhears = { "1" = [] }\n'
        '[markov]\ntransition = [[1.0]]\ninitial = "on"\n'
    )
    facts = describe(tmp_path / "p.toml")
    assert facts["sample_time"] == 0.1
    assert "discretised" in facts
    assert "A = exp(A_continuous T)" in text(facts)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"sample_time": None}, "sample_time is missing; a plant of continuous time has"),
        ({"B_continuous": None}, "B_continuous is missing"),
        ({"sample_time": 0.0}, "sample_time"),
        ({"sample_time": 1e6}, "sample more often"),
        ({"A_continuous": [[800.0, 0.0], [0.0, 1.0]], "sample_time": 1.0}, "beyond float64; sample more often"),
        ({"A_continuous": [[1.0, 0.0]]}, "A_continuous is 1 x 2; it must be square"),
        ({"B_continuous": [[1.0]]}, "B_continuous is 1 x 1; A_continuous is 2 x 2"),
        ({"A_continuous": [[0.0, "x"], [0.0, 0.0]]}, "row 1 holds"),
        ({"A": [[0.9, 0.0], [0.0, 0.9]]}, "A and B follow from"),
        ({"A": [[0.9, 0.0], [0.0, 0.9]], "B": [[1.0], [0.0]]}, "A is not what"),
    ],
)
def test_what_makes_no_sense_is_refused(change: dict[str, Any], said: str) -> None:
    plant = {key: value for key, value in (PLANT | change).items() if value is not None}
    with pytest.raises(InputError) as caught:
        Plant.from_document(plant)
    assert said in str(caught.value)
