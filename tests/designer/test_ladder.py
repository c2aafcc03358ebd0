"""The ladder, and the choice of the default method."""

from __future__ import annotations

import csv
from decimal import Decimal
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from agent.contract.errors import InputError
from agent.contract.problem import Problem
from benchmarks.design import banded
from designer.cli import main
from designer.ladder import Ladder, ladder_of, percent, rounded_up, rung_text
from designer.problems import find, names
from designer.search.effort import (
    BUDGET,
    MOST_NODES,
    default_budget,
    default_method,
    in_words,
    refuse_without_memory,
    seconds_of_exact,
    seconds_within,
    whole_fits,
)
from designer.synthesis import design


def test_slow_plants_are_known_to_take_longer() -> None:
    """As many times as long as the horizon that their search comes to."""
    quick = find("zhu2020-lossy")

    def with_radius(radius: float) -> Problem:
        document = quick.document()
        A = np.array(document["plant"]["A"])
        document["plant"]["A"] = (A * radius / quick.plant.spectral_radius).tolist()
        return Problem.from_document(document)

    estimates = [seconds_of_exact(with_radius(radius)) for radius in (0.5, 0.99, 0.999, 0.9999)]
    assert estimates[0] == seconds_of_exact(quick)
    assert 3.0 < estimates[1] / estimates[0] < 10.0
    assert 10.0 < estimates[2] / estimates[0] <= estimates[3] / estimates[0] <= 32.0


def test_the_distances() -> None:
    """Of what is certified: below the least that Theorem 2 gives, which is proved too, and above the floor."""
    ladder = Ladder(2.0, (2.19, 2.2), 2.2, (3.0, 3.1), 4.1, theorem2_least=4.0)
    assert (ladder.against_theorem2, ladder.above_floor) == (2.2 / 4.0 - 1.0, 2.2 / 2.0 - 1.0)
    assert ladder.lines() == [
        "2.000000  floor",
        "2.200000  exact gain of these gains",
        "2.200000  gamma, certified: 45.0 % below all that Theorem 2 can give, 10.0 % above the floor",
        "3.100000  exact gain of Theorem 2's gains",
        "4.000000  proved: no gains have less by Theorem 2",
        "4.100000  Theorem 2's bound, as a solver gave it",
    ]
    assert ladder._replace(theorem2_least=None).against_theorem2 is None  # a solver's word is compared with nothing
    assert ladder._replace(gamma=None).against_theorem2 is None


def test_both_of_a_designs_proved_gammas_are_rungs() -> None:
    """Of an LMI's gains: the exact gain's, and Theorem 1's, which lies above all by as much as it was backed off."""
    gains = design(find("zhu2020-lossy"), method="decomposed")
    proved, lines = gains.certificate, ladder_of(gains).lines()
    assert proved.theorem1_gamma is not None
    assert [line.partition("  ")[2].partition(":")[0] for line in lines] == [
        "floor",
        "exact gain of these gains",
        "gamma, certified",
        "proved",
        "Theorem 2's bound, as a solver gave it",
        "what Theorem 1 certifies of these gains",
    ]
    assert lines[2].startswith(rounded_up(proved.gamma))
    assert lines[5].startswith(rounded_up(proved.theorem1_gamma))
    values = [float(rung_text(*rung)) for rung in ladder_of(gains).rungs()]
    assert values == sorted(values)


def test_what_is_not_there_is_not_said() -> None:
    """No percentage above a floor of zero, and no rung that was not computed."""
    assert Ladder(0.0, None, 1.0, None, None).lines() == [
        "0.000000  floor",
        "1.000000  gamma, certified",
        "-         exact gain of these gains: not computed; analyse does",
    ]
    assert Ladder(0.5, None, 1.0, None, 1.0).lines()[1] == "1.000000  gamma, certified: 100.0 % above the floor"
    assert Ladder(None, (0.9, 1.0), None, None, None).lines() == ["1.000000  exact gain of these gains"]
    assert Ladder(1e-12, (0.9, 1.0), None, None, None).above_floor is None
    upper_end_alone = Ladder(0.0, (0.0, 1.0), 1.0, None, None).lines()
    assert upper_end_alone[-1] == "-         exact gain of these gains: not known, as no lower end of it was proved"


def test_rungs_stand_as_they_are_read() -> None:
    """A solver may stop a hair below what is proved, which is rounded down to where it is below the solver's."""
    ladder = Ladder(0.0, None, 0.2, None, 0.34797423, theorem2_least=0.34797427)
    assert ladder.lines()[2:4] == [
        "0.347974  proved: no gains have less by Theorem 2",
        "0.347975  Theorem 2's bound, as a solver gave it",
    ]


def test_numbers_of_different_length_stand_in_one_column() -> None:
    assert Ladder(0.0, (1.7e-4, 1.79884e-4), 1.8e-4, None, 0.2).lines()[1:] == [
        "0.0001799  exact gain of these gains",
        "0.0001800  gamma, certified",
        "0.200000   Theorem 2's bound, as a solver gave it",
    ]


def test_bounds_from_below_are_rounded_down() -> None:
    lines = Ladder(1.0000019, None, 2.0, None, None, theorem2_least=1.2345678).lines()
    assert (lines[0], lines[1]) == ("1.000001  floor", "1.234567  proved: no gains have less by Theorem 2")


def test_an_lmi_beyond_the_paper_is_not_theorem_2() -> None:
    """The name of the LMI stands on every line that speaks of it."""
    lines = Ladder(0.0, (1.0, 1.0), 1.0, (2.0, 2.0), 4.0, "the LMI", theorem2_least=4.0).lines()
    assert lines[1:] == [
        "1.000000  exact gain of these gains",
        "1.000000  gamma, certified: 75.0 % below all that the LMI can give",
        "2.000000  exact gain of the LMI's gains",
        "4.000000  proved: no gains have less by the LMI",
        "4.000000  the LMI's bound, as a solver gave it",
    ]
    document = find("two-nodes").document()
    gains = design(Problem.from_document(document | {"unbiased": True}), method="decomposed")
    assert (ladder_of(gains).lmi, ladder_of(gains).theorem2) == ("the LMI", gains.certificate.lmi_gamma)
    assert ladder_of(design(find("two-nodes"), method="decomposed")).lmi == "Theorem 2"


@pytest.mark.parametrize(
    "bound", [0.34799211731349844, 1.0, 2.2, 0.1 + 0.2, 1.1e-9, 9.9999999e-4, 5e-324, 123456.7, 1e300]
)
def test_a_bound_is_never_rounded_down(bound: float) -> None:
    """What is shown is not below it, by six decimals and four digits, whichever is more; its own decimals stay."""
    shown = rounded_up(bound)
    assert 0 <= Decimal(shown) - Decimal(str(bound)) < max(Decimal(str(bound)) / 10**3, Decimal(shown) / 10**9)
    assert len(shown.partition(".")[2]) >= 6


def test_bounds_are_shown_as_they_are_read() -> None:
    assert [rounded_up(bound) for bound in (2.2, 0.3479921, 1.1e-9)] == ["2.200000", "0.347993", "0.000000001100"]


def test_percentages() -> None:
    assert [percent(part) for part in (-0.2954, 0.031, 1e-9, -1e-9)] == ["-29.5 %", "+3.1 %", "0.0 %", "0.0 %"]


def test_the_default_is_exact_where_a_network_is_searched_at_once_or_in_windows() -> None:
    """And for many designs of one problem, where they take ten minutes together at most."""
    assert {name: default_method(find(name)) for name in names()} == dict.fromkeys(names(), "exact")
    assert [default_method(banded(n)) for n in (MOST_NODES, MOST_NODES + 1)] == ["exact", "exact"]
    assert [default_method(everybody_hears_everybody(n)) for n in (4, MOST_NODES + 1)] == ["exact", "decomposed"]
    lossy = find("zhu2020-lossy")
    many = BUDGET / seconds_of_exact(lossy)
    assert [default_method(lossy, designs=part * many) for part in (0.9, 1.1)] == ["exact", "decomposed"]


def everybody_hears_everybody(n: int) -> Problem:
    document = banded(n).document()
    for topology in document["topology"]:
        topology["adjacency"] = np.ones((n, n)).tolist()
    return Problem.from_document(document)


def test_the_estimate_grows_with_the_cube_of_large_networks_and_the_least_with_the_square() -> None:
    """Where the windows of a network are searched first, and then perhaps no more, the least is little more."""
    estimates = [seconds_within(banded(n), 1e9) for n in (4, 8, 16, 32, 64, 128)]
    usual = [later.usual / earlier.usual for earlier, later in pairwise(estimates)]
    least = [later.least / earlier.least for earlier, later in pairwise(estimates)]
    assert min(usual + least) > 1.1
    assert 7.0 < usual[-1] < 8.0
    assert 3.5 < least[-1] < 4.0
    assert seconds_within(banded(MOST_NODES + 1), 1e9).least < seconds_within(banded(MOST_NODES), 1e9).least


@pytest.mark.parametrize("budget", [60.0, 600.0])
def test_a_budget_ends_the_search_and_leaves_time_for_the_proof(budget: float) -> None:
    """Windows may take all of it, and so what is proved of 500 nodes makes a minute longer."""
    small, large = (seconds_within(banded(n), budget) for n in (100, 500))
    assert small.most == budget
    assert large.least <= large.most
    assert (large.most > budget) == (budget == 60.0)


def test_memory_that_does_not_suffice_is_said_before() -> None:
    problem = banded(50)
    refuse_without_memory(problem, free=1e9)
    with pytest.raises(
        InputError, match=r"needs about 0\.4 GB of memory for 50 nodes and 4 modes, and 0\.1 GB are free"
    ):
        refuse_without_memory(problem, free=1e8)


def test_windows_need_less_memory_than_a_search_of_all_at_once() -> None:
    large, dense = banded(500), everybody_hears_everybody(MOST_NODES + 1)
    assert [whole_fits(large, free=free) for free in (2e9, 4e9)] == [False, True]
    refuse_without_memory(large, free=2e9)
    with pytest.raises(InputError, match=r"needs about 1\.3 GB of memory for 500 nodes"):
        refuse_without_memory(large, free=9e8)
    with pytest.raises(InputError, match=r"needs about 1\.3 GB of memory for 201 nodes"):
        refuse_without_memory(dense, free=9e8)


def test_seconds_in_words() -> None:
    assert [in_words(s) for s in (0.1, 40.0, 700.0, 7300.0)] == ["2 seconds", "40 seconds", "12 minutes", "2 hours"]


def test_a_table_for_a_paper_has_every_rung() -> None:
    """In CSV the numbers bit for bit, in LaTeX as they are read, and what LaTeX would take for its own escaped."""
    ladder = Ladder(0.0, (0.1, 0.123456789), 0.2, None, 1 / 3)
    rows = list(csv.reader(ladder.table("my_net", "csv").splitlines()))
    assert rows[0] == ["", "my_net"]
    assert [(name, float(value)) for name, value in rows[1:]] == ladder.rungs()
    lines = ladder.table("my_net", "latex").splitlines()
    assert lines[:4] == [r"\begin{tabular}{lr}", r"\toprule", r" & my\_net \\", r"\midrule"]
    assert lines[4:-2] == [
        r"floor & 0.000000 \\",
        r"exact gain of these gains & 0.123457 \\",
        r"gamma, certified & 0.200000 \\",
        r"Theorem 2's bound, as a solver gave it & 0.333334 \\",
    ]
    assert lines[-2:] == [r"\bottomrule", r"\end{tabular}"]


@pytest.mark.parametrize("command", ["design", "analyse"])
def test_commands_print_it_alone(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["design", "two-nodes", "-o", "g.json", "--method", "decomposed"]) == 0
    words = {"design": ["--method", "decomposed", "-o", "new.json"], "analyse": ["--gains", "g.json"]}[command]
    capsys.readouterr()
    assert main([command, "two-nodes", *words, "--table", "csv"]) == 0
    rows = list(csv.reader(capsys.readouterr().out.splitlines()))
    assert (rows[0], rows[1][0]) == (["", "two-nodes"], "floor")
    assert main([command, "two-nodes", *words, "--force", "--table", "csv", "--json"]) == 2
    assert "leave one of them out" in capsys.readouterr().err


def test_a_plant_that_hardly_decays_has_a_shorter_budget() -> None:
    """Where the network is small; and that of others is as it was."""
    quick = find("two-nodes")
    document = quick.document()
    document["plant"]["A"] = (np.array(document["plant"]["A"]) * 0.9999 / quick.plant.spectral_radius).tolist()
    assert default_budget(Problem.from_document(document)) < default_budget(quick) == BUDGET
