"""The fixture `mesh` as a user's tests have it, in a pytest of their own; and that nobody is left, whatever happens."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from made_recordings import random_gains, random_problem
from peakmesh import InputError, Mesh
from places import ROOT
from runs import MANY, PATIENCE

from agent.contract.gains import Gains

TESTS = """
import sys

import pytest


def test_that_forgets_the_verdict(mesh):
    mesh("gains.json", sensors={"n0": lambda step: [1.0 / (step - 3)]}, steps=20)


def test_that_fails_before_the_end(mesh):
    mesh("gains.json", steps=2_000_000)
    raise ValueError("mine")


def test_of_a_recording_that_was_changed(mesh):
    run = mesh("gains.json", sensors={"n0": [sys.executable, r"SENSOR", "{run}", "{node}", "{address}"]}, steps=20)
    run.wait()
    whole = run.recording.read_bytes()
    run.recording.write_bytes(whole[: len(whole) // 2])
    run.verdict()


def test_of_a_plant_of_another_kind(mesh):
    node = [sys.executable, "-m", "designer", "node", "--wait", "300", "--deadline", "300", "{gains}"]
    mesh("gains.json", nodes={"n1": node}, plant=lambda x, w: 0.5 * x + w.sum(), steps=20)


def test_that_expects_a_failure(mesh):
    run = mesh("gains.json", sensors={"n0": lambda step: "three"}, steps=20)
    with pytest.raises(Exception, match="ValueError: could not convert"):
        run.verdict()
"""


@pytest.fixture(scope="module")
def pair() -> Gains:
    """Every a_ij is 0 or 1."""
    problem = random_problem(11, ny=(1, 2), modes=2)
    weights = {topology.name: {"adjacency": np.sign(topology.adjacency)} for topology in problem.topologies}
    return random_gains(problem.with_(topology=weights))


def processes(word: object) -> dict[int, str]:
    """Those whose command line has this word, by process id."""
    found = {}
    for entry in Path("/proc").iterdir():
        with contextlib.suppress(OSError, ValueError):
            command = (entry / "cmdline").read_text().replace("\0", " ")
            if str(word) in command and int(entry.name) != os.getpid():
                found[int(entry.name)] = command
    return found


def of_docs() -> str:
    """The tests that docs/library.md shows, for a node that the gains here have; they have ten lines at most."""
    found = re.findall(r"```python\n(def test_.*?)```", (ROOT / "docs" / "library.md").read_text(), flags=re.DOTALL)
    assert all(len([line for line in text.splitlines() if line.strip()]) <= 10 for text in found)
    assert [re.findall(r"def (test_\w+)", text) for text in found] == [["test_my_sensor"], ["test_my_filter"]]
    return "\n\n".join(["import peakmesh", *found]).replace('"level"', '"n0"')


def wait_until_nobody_has(word: object) -> None:
    deadline = time.monotonic() + PATIENCE
    while left := processes(word):
        assert time.monotonic() < deadline, left
        time.sleep(0.01)


def test_tests_of_a_user(pytester: pytest.Pytester, pair: Gains) -> None:
    """Each fails for its own reason, or passes; the recordings stay, and no process does."""
    pair.save(pytester.path / "gains.json")
    pytester.makepyfile(TESTS.replace("SENSOR", str(ROOT / "docs" / "sensor.py")), test_of_docs=of_docs())
    words = ["-n", "0", "-p", "no:cacheprovider", "--basetemp", str(pytester.path / "kept")]
    said = pytester.runpytest_subprocess(*words, timeout=PATIENCE)
    said.assert_outcomes(passed=5, failed=2, errors=2)
    text = said.stdout.str()
    assert 'sensor "n0" failed: ZeroDivisionError: ' in text
    assert "ValueError: mine" in text
    for why in ("nothing can be said: it holds nothing to compare", "DIVERGES"):
        kept = re.search(rf"AssertionError: (.*run\.mcap): {why}", text)
        assert kept is not None
        assert Path(kept[1]).exists()
    wait_until_nobody_has(pytester.path)


def test_a_mesh_whose_maker_is_killed_ends(tmp_path: Path, pair: Gains) -> None:
    """kill -9 leaves no process behind."""
    pair.save(tmp_path / "gains.json")
    recording = tmp_path / "run.mcap"
    program = (
        "from peakmesh import Mesh\n"
        f"with Mesh('gains.json', {str(recording)!r}, steps={MANY}):\n    print('there', flush=True)\n    input()\n"
    )
    words = [sys.executable, "-c", program]
    with subprocess.Popen(words, cwd=tmp_path, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as maker:
        try:
            assert maker.stdout is not None
            assert maker.stdout.readline() == b"there\n"
            assert processes(recording)
        finally:
            os.kill(maker.pid, signal.SIGKILL)
    wait_until_nobody_has(recording)


def test_a_mesh_that_cannot_start_says_why(tmp_path: Path, pair: Gains) -> None:
    with pytest.raises(InputError, match=r"^node \"n7\" does not exist; "):
        Mesh(pair, tmp_path / "run.mcap", sensors={"n7": lambda step: [0.0]})
    with pytest.raises(InputError, match=r"^steps is 0; it must be a whole number"):
        Mesh(pair, tmp_path / "run.mcap", steps=0)
    with pytest.raises(
        InputError, match=r"^the command of sensor \"n0\", no-such-command, cannot be started: there is"
    ):
        Mesh(pair, tmp_path / "run.mcap", sensors={"n0": "no-such-command"})
    wait_until_nobody_has(tmp_path)
