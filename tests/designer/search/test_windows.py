"""Windows of large networks: what they cover, what is kept of them, and who computes them."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from agent.contract.problem import Problem
from benchmarks.design import banded
from designer.gain.exact import exact_gain
from designer.model.error_model import StackedGains, error_model, measurement_slices
from designer.patience import Budget
from designer.search import windows as room
from designer.search.descent import follow
from designer.search.starts import least_variance_gains
from designer.search.windows import WEIGHT, window_gains, windows


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Windows of small networks, one after the other in this process."""
    monkeypatch.setattr(room, "_CORE", 8)
    monkeypatch.setattr(room, "_NODES", 16)
    monkeypatch.setattr(room, "each", lambda function, items, *, dask: map(function, items))


def shuffled(problem: Problem) -> Problem:
    """The same network, its nodes in another order."""
    document, order = problem.document(), np.random.default_rng(1).permutation(problem.n)
    document["node"] = [document["node"][i] for i in order]
    for topology in document["topology"]:
        topology["adjacency"] = np.array(topology["adjacency"])[np.ix_(order, order)].tolist()
    return Problem.from_document(document)


@pytest.mark.parametrize("problem", [banded(70), shuffled(banded(70))], ids=["in a row", "in any order"])
def test_every_node_is_in_one_core_with_all_whom_it_hears_around_it(problem: Problem) -> None:
    found = windows(problem)
    assert sorted(itertools.chain(*(window.core for window in found))) == list(range(70))
    for core, nodes in found:
        assert len(nodes) == len(set(nodes)) <= 60
        for i in core:
            assert set(problem.ever_heard(int(i))) <= set(nodes)


def test_where_everybody_hears_everybody_there_are_no_windows() -> None:
    document = banded(101).document()
    for topology in document["topology"]:
        topology["adjacency"] = np.ones((101, 101)).tolist()
    assert windows(Problem.from_document(document)) == []


def rows_of(problem: Problem, gains: StackedGains, i: int) -> list[np.ndarray]:
    rows = slice(i * problem.nx, (i + 1) * problem.nx)
    return [part[:, rows] for part in gains]


def test_of_each_window_the_gains_of_its_core_are_kept(small: None) -> None:
    """They are those that its own network has, at the same nodes; the exact gain of all falls far."""
    problem = shuffled(banded(20))
    start = least_variance_gains(problem)
    told: list[tuple[int, int]] = []
    found = window_gains(problem, start, budget=Budget(), report=lambda *done: told.append(done))
    assert found.ended is None
    assert told == [(1, 3), (2, 3), (3, 3)]
    columns = measurement_slices(problem)
    for core, nodes in windows(problem):
        names = [problem.node_names[i] for i in nodes]
        document = problem.document()
        document["node"] = [node for node in document["node"] if node["name"] in names]
        for topology in document["topology"]:
            topology["adjacency"] = np.array(topology["adjacency"])[np.ix_(nodes, nodes)].tolist()
        part = Problem.from_document(document)
        assert part.node_names == tuple(names)
        gains = follow(part, least_variance_gains(part), (WEIGHT,))
        assert gains is not None
        for i in core:
            K, H = rows_of(problem, found.gains, i)
            K_part, H_part = rows_of(part, gains, names.index(problem.node_names[i]))
            at = np.concatenate([np.arange(j * problem.nx, (j + 1) * problem.nx) for j in nodes])
            measured = np.concatenate([np.arange(columns[j].start, columns[j].stop) for j in nodes])
            np.testing.assert_array_equal(K[:, :, at], K_part)
            np.testing.assert_array_equal(H[:, :, measured], H_part)
            assert np.count_nonzero(K) == np.count_nonzero(K_part)
            assert np.count_nonzero(H) == np.count_nonzero(H_part)
    before, after = (exact_gain(error_model(problem, *gains)).high for gains in (start, found.gains))
    assert after < 0.9 * before


def test_what_windows_led_to_is_kept_when_time_is_over(small: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first core has other gains, the rest those from before."""
    problem = banded(24)
    start = least_variance_gains(problem)
    monkeypatch.setattr(room, "_descended", lambda part: tuple(1.001 * each for each in least_variance_gains(part)))
    done = [0]
    budget = Budget(1.0, clock=lambda: done[-1])
    found = window_gains(problem, start, budget=budget, report=lambda number, of: done.append(number))
    assert found.ended == "out of time"
    changed = [i for i in range(24) if not np.array_equal(*(rows_of(problem, g, i)[0] for g in (start, found.gains)))]
    assert changed == windows(problem)[0].core.tolist()


def test_a_window_without_stable_gains_keeps_those_from_before(small: None, monkeypatch: pytest.MonkeyPatch) -> None:
    problem = banded(16)
    start = least_variance_gains(problem)
    monkeypatch.setattr(room, "_descended", lambda part: None)
    for before, after in zip(start, window_gains(problem, start, budget=Budget()).gains, strict=True):
        np.testing.assert_array_equal(before, after)


@pytest.mark.parametrize(("factor", "stays"), [(1.5, False), (1e6, True)])
def test_where_errors_would_grow_less_is_taken_of_the_windows(
    small: None, monkeypatch: pytest.MonkeyPatch, factor: float, stays: bool
) -> None:
    """Half of the way, or a quarter; and nothing where that is too much."""
    problem = banded(16)
    start = least_variance_gains(problem)

    def too_much(part: Problem) -> StackedGains:
        K_bar, H_bar = least_variance_gains(part)
        return factor * K_bar, H_bar

    monkeypatch.setattr(room, "_descended", too_much)
    found = window_gains(problem, start, budget=Budget()).gains
    assert np.array_equal(found[0], start[0]) == stays
    assert exact_gain(error_model(problem, *found)).stable


def test_ctrl_c_keeps_the_windows_that_are_done(small: None, monkeypatch: pytest.MonkeyPatch) -> None:
    problem = banded(16)
    start, done = least_variance_gains(problem), []

    def descended(part: Problem) -> StackedGains:
        if done:
            raise KeyboardInterrupt
        done.append(part)
        K_bar, H_bar = least_variance_gains(part)
        return 1.001 * K_bar, H_bar

    monkeypatch.setattr(room, "_descended", descended)
    found = window_gains(problem, start, budget=Budget())
    assert found.ended == "interrupted"
    assert not np.array_equal(start[0], found.gains[0])


def test_the_numbers_do_not_depend_on_who_computes_them(cluster: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """On processes of this machine, on a cluster, and here."""
    monkeypatch.setattr(room, "_CORE", 6)
    monkeypatch.setattr(room, "_NODES", 8)
    problem = banded(12)
    start = least_variance_gains(problem)
    here, spread = (
        window_gains(problem, start, budget=Budget()),
        window_gains(problem, start, budget=Budget(), dask=cluster),
    )
    monkeypatch.setattr(room, "each", lambda function, items, *, dask: map(function, items))
    alone = window_gains(problem, start, budget=Budget())
    for K_and_H in zip(here.gains, spread.gains, alone.gains, strict=True):
        np.testing.assert_array_equal(K_and_H[0], K_and_H[1])
        np.testing.assert_array_equal(K_and_H[0], K_and_H[2])
    assert not np.array_equal(here.gains[0], start[0])
