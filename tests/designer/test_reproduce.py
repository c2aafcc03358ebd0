"""The paper's table: relations that its computed values keep, whatever they are."""

from __future__ import annotations

import csv

import pytest

from designer.ladder import rounded_down, rounded_up
from designer.reproduce import EXAMPLES, PRINTED, ROWS, Reproduced, reproduce

KEYS = [row.key for row in ROWS]


@pytest.fixture(scope="module")
def paper() -> Reproduced:
    """Both examples, without the rows that take long."""
    return reproduce(rows=["printed", "clarabel", "least", "decomposed", "certified", "theorem2_exact", "floor"])


def value(table: Reproduced, name: str, key: str) -> float:
    found = table.values[name][key]
    assert found is not None
    return found


@pytest.mark.parametrize("name", EXAMPLES)
def test_the_ladder_holds(paper: Reproduced, name: str) -> None:
    """Floor <= exact gain of Theorem 2's gains <= their certified gamma, which is the optimum of the LMI."""
    floor, exact, certified = (value(paper, name, key) for key in ("floor", "theorem2_exact", "certified"))
    least = value(paper, name, "least")
    assert floor <= exact <= certified
    assert least <= certified <= least * (1.0 + 2e-4)
    assert certified == pytest.approx(value(paper, name, "clarabel"), rel=1e-4)
    assert value(paper, name, "decomposed") == pytest.approx(value(paper, name, "clarabel"), rel=1e-4)


def test_what_is_said_of_the_printed_values(paper: Reproduced) -> None:
    """One lies below the optimum and one above; the distances are those of the table."""
    first, reached, second = paper.remarks()
    least, above = (
        value(paper, EXAMPLES[0], "least"),
        PRINTED[EXAMPLES[1]] / value(paper, EXAMPLES[1], "clarabel") - 1.0,
    )
    assert PRINTED[EXAMPLES[0]] < least
    assert above > 0.0
    assert (
        f"{100.0 * (1.0 - PRINTED[EXAMPLES[0]] / least):.1f} % below all that the convex problem (42) can give" in first
    )
    assert f"is proved: no point of (42) has less than {rounded_down(least)}" in first
    assert f"{value(paper, EXAMPLES[0], 'theorem2_exact'):.4f}" in reached
    assert f"{100.0 * above:.1f} % above the optimum" in second


def test_without_a_proof_solvers_have_the_word(paper: Reproduced) -> None:
    """And of a printed value that is not below what is proved."""
    values = paper.values[EXAMPLES[0]]
    for least in (None, 0.2):
        (said, _) = Reproduced({EXAMPLES[0]: values | {"least": least}}, {}).remarks()
        assert "% below the optimum of the convex problem (42) that a solver gives" in said
        assert "As far as solvers tell, it cannot come from (42)" in said
        assert "proved" not in said


def test_its_table_for_a_paper_is_the_one_that_is_printed() -> None:
    """In CSV every number bit for bit, and nothing where there is none; in LaTeX the cells of the text."""
    values = {
        "zhu2020-ideal": {"printed": 0.23, "consensus": None},
        "zhu2020-lossy": {"printed": 0.36, "consensus": 1 / 3},
    }
    table = Reproduced(values, {})
    head, *rows = csv.reader(table.table("csv").splitlines())
    assert head == ["", "zhu2020-ideal", "zhu2020-lossy"]
    assert [row[1:] for row in rows] == [["0.23", "0.36"], ["", repr(1 / 3)]]
    shown = [line.removesuffix(r" \\").split(" & ")[1:] for line in table.table("latex").splitlines() if " & " in line]
    assert shown == [["zhu2020-ideal", "zhu2020-lossy"], ["0.23", "0.36"], ["not stable", "0.333333"]]
    assert all(cell in table.text() for row in shown for cell in row)


def test_every_row() -> None:
    """On a problem of which nothing is printed: two solvers agree, and the design for the exact gain is the lowest."""
    said: list[str] = []
    table = reproduce(["two-nodes"], report=said.append)
    assert list(table.values["two-nodes"]) == KEYS
    assert len(said) == len(KEYS)
    assert table.values["two-nodes"]["printed"] is None
    assert value(table, "two-nodes", "scs") == pytest.approx(value(table, "two-nodes", "clarabel"), rel=5e-3)
    least = value(table, "two-nodes", "exact")
    assert value(table, "two-nodes", "floor") <= least <= value(table, "two-nodes", "consensus") * (1.0 + 1e-3)
    assert table.remarks() == []
    assert rounded_up(least) in table.text()


def test_a_solver_that_is_not_there_is_said() -> None:
    values = dict.fromkeys(KEYS, 1.0) | {"scs": None, "consensus": None, "least_variance": None}
    text = Reproduced({"zhu2020-ideal": values}, {}).text()
    assert "no answer" in text
    assert "not stable" in text
    assert "two solvers" not in text
