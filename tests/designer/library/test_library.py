"""`import peakmesh`: what its functions answer is what the commands do."""

from __future__ import annotations

import asyncio
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import peakmesh
import pytest
from made_recordings import random_gains, random_problem
from places import GOLDEN
from runs import PATIENCE, roles_left

from agent.contract.gains import Gains
from agent.contract.problem import Problem

RECORDING = GOLDEN / "zhu2020-lossy.mcap"


@pytest.fixture(scope="module")
def pair() -> Gains:
    return random_gains(random_problem(11, ny=(1, 2), modes=2))


# names
def test_every_name_is_there() -> None:
    assert set(peakmesh.__all__) <= set(dir(peakmesh))
    assert all(getattr(peakmesh, name).__doc__ for name in peakmesh.__all__)
    with pytest.raises(AttributeError, match="has no attribute 'desing'; it has Gains, "):
        peakmesh.__getattr__("desing")


def script(folder: Path, text: str) -> subprocess.CompletedProcess[str]:
    (folder / "script.py").write_text(text)
    words = [sys.executable, "script.py"]
    return subprocess.run(words, cwd=folder, capture_output=True, text=True, timeout=PATIENCE, check=False)


def test_files_of_the_same_name_beside_a_script_are_no_harm(tmp_path: Path) -> None:
    """Unless they have been imported already: that is said."""
    for name in ("agent", "designer"):
        (tmp_path / f"{name}.py").write_text("mine = 1\n")
    used = "import peakmesh\nprint(peakmesh.find('two-nodes').n)\n"
    assert script(tmp_path, used).stdout == "2\n"
    said = script(tmp_path, f"import agent\n{used}").stderr.splitlines()[-1]
    assert said.startswith(f"ImportError: {tmp_path / 'agent.py'} has been imported as 'agent'")


# problems
def arrays(problem: Problem) -> dict[str, Any]:
    """The arguments of from_arrays."""
    return {
        **{name: getattr(problem.plant, name) for name in "ABM"},
        **{name: {node.name: getattr(node, name) for node in problem.nodes} for name in "CD"},
        "arrival_probability": {node.name: node.arrival_probability for node in problem.nodes},
        "adjacency": {topology.name: topology.adjacency for topology in problem.topologies},
        "transition": problem.markov.transition,
        "initial": problem.markov.initial,
        "disturbance": problem.disturbance.document(),
    }


def test_a_problem_of_arrays_is_that_of_the_file() -> None:
    problem = peakmesh.find("zhu2020-lossy")
    assert Problem.from_arrays(problem.name, **arrays(problem)) == problem
    # fmt: off
    one = Problem.from_arrays("one", A=0.5 * np.eye(1), B=[[1]], M=[[1]], C={"a": [[1]]}, D={"a": [[1]]},
                              adjacency={"alone": np.eye(1, dtype=int)}, arrival_probability=np.float64(0.5))
    # fmt: on
    assert (one.beta.tolist(), one.markov.initial) == ([0.5], "alone")


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"A": np.zeros((2, 3))}, "plant: A is 2 x 3; it must be square"),
        ({"D": {"1": [[1.0]]}}, 'C has the nodes "1", "2", "3" and "4", D has "1"; both need the same ones'),
        ({"arrival_probability": {"1": 0.5}}, 'arrival_probability has the nodes "1"; C has "1", "2", "3" and "4"'),
        ({"adjacency": {}}, "adjacency is empty; it needs a matrix for each mode"),
        ({"arrival_probability": 2}, 'node "1": arrival_probability: 2.0 is not in (0, 1]; '),
        ({"disturbanse": {}}, "disturbanse: this key is not known here"),
    ],
)
def test_arrays_that_are_no_problem_are_refused(change: dict[str, Any], sentence: str) -> None:
    problem = peakmesh.find("zhu2020-lossy")
    with pytest.raises(peakmesh.InputError) as caught:
        Problem.from_arrays(problem.name, **arrays(problem) | change)
    assert str(caught.value).startswith(sentence)


def test_a_copy_has_what_was_changed_and_nothing_stale() -> None:
    problem = peakmesh.find("zhu2020-lossy")
    assert problem.beta.tolist() == [0.79, 0.85, 0.78, 0.92]  # cached
    copy = problem.with_(
        name="mine",
        plant={"A": 0.5 * problem.plant.A},
        node={"*": {"arrival_probability": 0.5}, "2": {"arrival_probability": 0.25}},
        disturbance={"kind": "impulse", "at": 3},
    )
    assert copy.beta.tolist() == [0.5, 0.25, 0.5, 0.5]
    assert np.array_equal(copy.plant.A, 0.5 * problem.plant.A)
    assert np.array_equal(copy.plant.B, problem.plant.B)
    assert (copy.name, copy.disturbance.kind, copy.topologies) == ("mine", "impulse", problem.topologies)
    assert problem.with_() == problem
    apart = problem.with_(topology={"*": {"hears": {}}, "1": {"adjacency": np.ones((4, 4))}})
    assert [len(apart.neighbours(s, 0)) for s in range(4)] == [4, 1, 1, 1]


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"node": {"5": {"C": 1}}}, 'node "5" does not exist; there are "1", "2", "3" and "4", and "*" for all'),
        ({"node": {"2": {"arrival": 1}}}, 'node "2": arrival: this key is not known here'),
        ({"plant": {"A": np.eye(3)}}, "plant: "),
        ({"nodes": []}, "nodes: this key is not known here"),
    ],
)
def test_what_cannot_be_changed_is_refused(change: dict[str, Any], sentence: str) -> None:
    with pytest.raises(peakmesh.InputError) as caught:
        peakmesh.find("zhu2020-lossy").with_(**change)
    assert str(caught.value).startswith(sentence)


# files and words
def test_files_are_named_by_str_or_path(tmp_path: Path, pair: Gains) -> None:
    for path in (tmp_path / "gains.json", str(tmp_path / "others.json")):
        pair.save(path)
        assert peakmesh.Gains.load(path) == pair
    assert peakmesh.replay(RECORDING).document() == peakmesh.replay(str(RECORDING)).document()


def test_what_is_shown_of_them_is_a_line(pair: Gains) -> None:
    for thing in (peakmesh.find("zhu2020-lossy"), pair, peakmesh.replay(RECORDING)):
        assert len(repr(thing)) < 200
        assert "\n" not in repr(thing)
        assert thing._repr_html_().count("<") == thing._repr_html_().count(">") >= 2
    assert repr(peakmesh.find("zhu2020-lossy")) == "Problem(zhu2020-lossy: 4 nodes, 2 states, 4 modes)"


# answers
def test_gains_may_be_given_in_any_form(tmp_path: Path, pair: Gains) -> None:
    pair.save(tmp_path / "gains.json")
    forms = (tmp_path / "gains.json", (pair.K, pair.H))
    found = {peakmesh.analyse(pair.problem, form).radius for form in forms}
    assert len(found) == 1
    with pytest.raises(peakmesh.InputError, match="what is given does not fit zhu2020-lossy: K has gains for"):
        peakmesh.analyse("zhu2020-lossy", (pair.K, pair.H))
    with pytest.raises(peakmesh.InputError, match=r"^K: must be a table of keys and values, got 3$"):
        peakmesh.analyse(pair.problem, (3, pair.H))


def test_the_certificate_of_a_recording_is_proved_again() -> None:
    assert peakmesh.verify(peakmesh.load(RECORDING).gains).holds


def test_a_simulation_takes_no_processes_of_its_own(pair: Gains) -> None:
    ensemble = peakmesh.simulate(pair, runs=2000, steps=3, w=[[1] * pair.problem.nw])
    assert ensemble.peaks.shape == (2000,)


# runs
def test_a_notebook_runs_a_network(tmp_path: Path, pair: Gains) -> None:
    """Where an event loop runs in this thread, and another one is the main thread, which alone has signals."""
    words: list[dict[str, Any]] = []

    async def cell() -> peakmesh.Run:
        return peakmesh.run(pair, str(tmp_path / "run.mcap"), steps=20, seed=3, wait=PATIENCE, report=words.append)

    with ThreadPoolExecutor(1) as thread:
        run = thread.submit(asyncio.run, cell()).result()
    assert (run.steps, run.seed, run.missing, run.parts) == (20, 3, 0, (tmp_path / "run.mcap",))
    assert any("listening" in word for word in words)
    assert run.replay().agrees
    assert peakmesh.load(*run.parts).gains == pair
    assert roles_left() == {}


def test_nodes_and_plant_may_be_functions(tmp_path: Path, pair: Gains) -> None:
    """They are asked for each step in turn, and what they return is recorded; nothing of them is left."""
    asked: list[tuple[str, list[str]]] = []

    def node(mode: str, heard: dict[str, tuple[Any, Any]]) -> list[float]:
        asked.append((mode, list(heard)))
        heard["n0"][0][:] = np.nan  # it is a copy
        return [1.0 + len(asked)] * pair.problem.nx

    def plant(x: Any, w: Any) -> Any:
        return x + w.sum() + 1.0

    run = peakmesh.run(
        pair, tmp_path / "run.mcap", steps=20, wait=PATIENCE, deadline=PATIENCE, nodes={"n0": node}, plant=plant
    )
    log = peakmesh.load(*run.parts)
    assert log.x_hat[1:, : pair.problem.nx].tolist() == [[2.0 + k] * pair.problem.nx for k in range(19)]
    assert len(asked) >= 19  # the last step leads to nothing, and the run may be over before
    assert [mode for mode, _ in asked] == [log.modes.texts[s] for s in log.mode][: len(asked)]
    assert all("n0" in heard for _, heard in asked)
    assert np.array_equal(log.x[1:], log.x[:-1] + log.w[:-1].sum(axis=1, keepdims=True) + 1.0)
    assert run.replay().exit_code == 1
    assert roles_left() == {}
    assert not {thread.name for thread in threading.enumerate()} & {"plant", "node-n0", "work"}


@pytest.mark.parametrize(
    ("who", "function", "sentence"),
    [
        ("nodes", lambda mode, heard: 1 / 0, 'node "n0" failed: ZeroDivisionError: division by zero'),
        (
            "plant",
            lambda x, w: [1.0],
            "the plant failed: ValueError: it returned an array of shape (1,); a state has shape (2,)",
        ),
        (
            "plant",
            lambda x, w: x + np.inf,
            "the plant failed: ValueError: it returned [inf, inf]; a state has finite numbers",
        ),
    ],
)
def test_a_function_that_fails_ends_the_run(
    who: str, function: Any, sentence: str, tmp_path: Path, pair: Gains
) -> None:
    mine = {who: {"n0": function} if who == "nodes" else function}
    with pytest.raises(peakmesh.RunBroken) as broken:
        peakmesh.run(pair, tmp_path / "run.mcap", steps=20, wait=PATIENCE, deadline=PATIENCE, **mine)
    assert str(broken.value) == sentence


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"steps": 0}, "steps is 0; it must be a whole number from 1 to 2147483647"),
        ({"seed": 1.5}, "seed is 1.5; it must be a whole number"),
        ({"period": 0}, "period is 0; it must be a number of seconds"),
        ({"external": "n9"}, 'node "n9" does not exist'),
        ({"nodes": {"n9": abs}}, 'node "n9" does not exist'),
        ({"plant": abs, "external": ["n0", "n1"], "period": 1.0}, "the plant is yours, but none takes part in a paced"),
        ({"faults": ["kill:node=n0,step=1"]}, "--fault kill:node=n0,step=1: a lock-step run survives nothing"),
    ],
)
def test_a_run_that_cannot_be_is_refused(options: dict[str, Any], sentence: str, tmp_path: Path, pair: Gains) -> None:
    with pytest.raises(peakmesh.InputError) as caught:
        peakmesh.run(pair, tmp_path / "run.mcap", **options)
    assert str(caught.value).startswith(sentence)
    assert list(tmp_path.iterdir()) == []
