"""Whoever looks is told to end when it is time, and never otherwise."""

from __future__ import annotations

from typing import Any

import pytest

from designer.patience import Budget, TimeIsUp, look, looking


class Clock:
    """Stands still."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


def budget_of(seconds: float) -> tuple[Budget, Clock]:
    clock = Clock()
    return Budget(seconds, clock), clock


def ended_by(check: Any) -> type[BaseException] | None:
    try:
        with looking(check):
            look()
    except (KeyboardInterrupt, TimeIsUp) as why:
        return type(why)
    return None


def test_nobody_who_looks_is_ended_where_nobody_asked() -> None:
    look()
    with pytest.raises(TimeIsUp), looking(Budget(0.0).check):
        look()
    look()


@pytest.mark.parametrize(
    ("asked", "search", "comparison", "last"),
    [(0, None, None, None), (1, KeyboardInterrupt, KeyboardInterrupt, None)] + 2 * [(2, *3 * [KeyboardInterrupt])],
)
def test_signals_end_what_they_are_enough_for(asked: int, search: Any, comparison: Any, last: Any) -> None:
    budget, _ = budget_of(1.0)
    budget.asked = asked
    assert ended_by(budget.check) is search
    assert ended_by(budget.check_comparison) is comparison
    assert ended_by(budget.choosing(0.0)) is last
    assert ended_by(budget.check_last) is last


@pytest.mark.parametrize(
    ("now", "search", "choice", "comparison"),
    [(5.9, None, None, None), (6.1, TimeIsUp, None, None), (8.1, TimeIsUp, TimeIsUp, None), (10.1, *3 * [TimeIsUp])],
)
def test_a_search_leaves_time_for_the_choice_that_leaves_time_for_the_proof(
    now: float, search: Any, choice: Any, comparison: Any
) -> None:
    budget, clock = budget_of(10.0)
    budget.keep(4.0)
    clock.now = now
    assert ended_by(budget.check) is search
    assert ended_by(budget.choosing(0.0)) is choice
    assert ended_by(budget.check_comparison) is comparison
    assert ended_by(budget.check_last) is None


def test_a_proof_gets_all_that_was_kept_and_a_little_in_any_case() -> None:
    budget, clock = budget_of(10.0)
    budget.keep(4.0)
    begun = {now: budget.proving(1.0) for clock.now in (0.0, 9.5) for now in [clock.now]}
    clock.now = 9.9
    assert ended_by(begun[0.0]) is ended_by(begun[9.5]) is None
    clock.now = 10.1
    assert (ended_by(begun[0.0]), ended_by(begun[9.5])) == (TimeIsUp, None)
    clock.now = 10.6
    assert ended_by(begun[9.5]) is TimeIsUp


def test_a_search_that_is_over_leaves_its_time_to_what_comes_after_it() -> None:
    budget, clock = budget_of(10.0)
    budget.keep(4.0)
    clock.now = 2.0
    budget.end()
    assert ended_by(budget.check) is TimeIsUp
    for clock.now, proof, comparison in ((9.9, None, None), (10.1, TimeIsUp, TimeIsUp)):
        assert ended_by(budget.proving(0.0)) is proof
        assert ended_by(budget.check_comparison) is comparison


def test_searches_share_what_is_left() -> None:
    """The second has all of it."""
    budget, clock = budget_of(10.0)
    clock.now = 2.0
    with budget.leaving(0.5):
        assert budget.left == 4.0
        with budget.leaving(0.5):
            assert budget.left == 2.0
        assert budget.left == 4.0
    assert budget.left == 8.0
    with Budget().leaving(0.5):
        assert ended_by(Budget().check) is None


def test_a_search_with_an_answer_before_its_end_gets_a_share_of_what_is_left() -> None:
    """Of all that is left, and nothing where nothing is; signals do not end it; what it asks for is left out."""
    budget, clock = budget_of(10.0)
    budget.keep(4.0)
    clock.now = 2.0
    budget.asked, budget.over = 1, True  # to be proved, when no search comes any more
    half, all_of_it = budget.over_after(0.5, "half"), budget.over_after(1.0, "all")
    clock.now = 5.9
    assert not half()
    clock.now = 6.1
    assert half()
    assert half()
    assert not all_of_it()
    assert budget.left_out == ["half"]
    clock.now = 10.1
    assert all_of_it()
    assert budget.over_after(1.0, "late")()
    assert budget.left_out == ["half", "all", "late"]


def test_what_there_has_to_be_is_there() -> None:
    """KeyboardInterrupt that comes from elsewhere counts for none the first time."""
    budget, _ = budget_of(0.0)
    to_come: list[BaseException] = [KeyboardInterrupt()]

    def work() -> str:
        if to_come:
            raise to_come.pop()
        look()
        return "proved"

    assert budget.to_its_end(work, lambda: "at once") == "proved"
    budget.asked = 2
    assert budget.to_its_end(work, lambda: "at once") == "at once"


def test_what_is_left_out_is_known() -> None:
    budget, clock = budget_of(1.0)

    def work() -> str:
        clock.now += 0.6
        look()
        return "compared"

    assert [budget.compared(name, work) for name in ("one", "two", "three")] == ["compared", None, None]
    assert budget.left_out == ["two", "three"]


def test_what_goes_on_is_said_every_few_seconds_with_what_is_left_of_it() -> None:
    budget, clock = budget_of(1.0)
    told: list[str] = []
    budget.tell = told.append
    budget.goes_on("proving gamma", lambda: 900)
    with looking(budget.check_last):
        for step in range(1, 201):
            clock.now += 0.1
            look(step)
    assert 2 <= len(told) <= 4
    assert all(words.endswith("of about 900") for words in told)
    assert told[0].startswith("proving gamma, step ")
