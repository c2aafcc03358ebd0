"""An install for a board: what `pip install peakmesh` brings, without any extra, and all that works with it."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tomllib
import venv
from collections.abc import Iterator
from importlib.metadata import distribution
from pathlib import Path

import pytest
from made_recordings import record
from paced_runs import PacedRun
from places import GOLDEN, ROOT

from agent.contract.extras import EXTRAS
from agent.contract.gains import Gains
from designer.proof import certificate
from designer.replay import replay
from designer.replay.gamma import checked_gamma

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
LOSSY, GAINS = GOLDEN / "zhu2020-lossy.mcap", GOLDEN / "zhu2020-lossy.gains.json"

# Every command that is no part of a run, in a folder of its own, and what it needs beside an install for a board.
WORDS = {
    "show": "",
    f"show {LOSSY}": "",
    "new tank": "",
    f"verify {GAINS}": "",
    f"verify {GAINS} --balls": "",
    f"replay {LOSSY}": "",
    f"replay {LOSSY} --with {GAINS} --write audit.mcap": "",
    f"report {LOSSY} -o page.html": "",
    f"recover {LOSSY} -o whole.mcap": "",
    f"compare {LOSSY} whole.mcap": "",
    f"simulate {GAINS} --runs 5 --steps 20": "",
    f"export {LOSSY} --csv -o table.csv": "",
    f"export {GAINS} --npz -o gains.npz": "",
    f"export {GAINS} --c --node 2 -o node2": "",
    "keys init --problem zhu2020-lossy -o keys": "",
    "design two-nodes": "cvxpy",
    "demo two-nodes": "cvxpy",
    "run two-nodes": "cvxpy",
    "design two-nodes --price": "cvxpy",
    "sweep two-nodes --set plant.A.1.1=0.1:0.2:2": "cvxpy",
    f"analyse zhu2020-lossy --gains {GAINS}": "scipy",
    f"identify {LOSSY}": "scipy",
    "reproduce": "cvxpy",
    "reproduce --figures figures": "matplotlib",
    f"report {LOSSY} --figures figures": "matplotlib",
    f"export {LOSSY} --mat -o table.mat": "scipy",
    f"export {GAINS} --mat -o gains.mat": "scipy",
    f"export {LOSSY} --parquet -o table.parquet": "pyarrow",
    f"simulate {GAINS} --runs 5 --steps 20 --dask tcp/127.0.0.1:1": "distributed",
}


def requirements(requirement: str) -> Iterator[str]:
    """A distribution, and all that it is not installed without."""
    name = re.split(r"[\s<>=!~;\[(]", requirement)[0]
    yield name
    for further in distribution(name).requires or ():
        if "extra ==" not in further:
            try:
                yield from requirements(further)
            except ModuleNotFoundError:  # of another platform
                continue


@pytest.fixture(scope="module")
def python(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """That of an environment with the package and its requirements, and nothing else."""
    folder = tmp_path_factory.mktemp("board") / "venv"
    venv.create(folder, symlinks=True)
    (site,) = folder.glob("lib/python*/site-packages")
    names = {name for requirement in PROJECT["dependencies"] for name in requirements(requirement)}
    for name in names:
        found = distribution(name)
        for top in {file.parts[0] for file in found.files or () if not file.parts[0].startswith((".", "__pycache__"))}:
            (site / top).symlink_to(found.locate_file(top))
    itself = distribution("peakmesh")
    (meta,) = {file.parts[0] for file in itself.files or () if file.parts[0].endswith(".dist-info")}
    (site / meta).symlink_to(itself.locate_file(meta))
    (site / "here.pth").write_text(f"{ROOT}\n{ROOT / 'designer' / 'library'}\n")
    return folder / "bin" / "python"


def run(python: Path, *words: object, folder: Path) -> subprocess.CompletedProcess[str]:
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    command = [str(word) for word in (python, *words)]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=300)


def test_nothing_of_the_extras_is_there(python: Path, tmp_path: Path) -> None:
    """So that the tests below mean something; and all of the table is known to pyproject.toml."""
    program = "import importlib.util, sys; print([name for name in sys.argv[1:] if importlib.util.find_spec(name)])"
    assert run(python, "-c", program, *EXTRAS, "numpy", folder=tmp_path).stdout == "['numpy']\n"
    extras = PROJECT["optional-dependencies"]
    names = {"foxglove": "foxglove-sdk"}
    for module, extra in EXTRAS.items():
        assert any(requirement.startswith(names.get(module, module)) for requirement in extras[extra]), module
    assert {extra for extra in extras if extra not in ("test", "check", "docs")} == set(EXTRAS.values())


MANY = """
import contextlib, io, json, sys
from designer.cli import main
for words in json.loads(sys.argv[1]):
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(io.StringIO()) as err:
        code = main(words.split())
    print(json.dumps([code, out.getvalue(), err.getvalue()]))
"""


def test_commands_work_or_say_in_a_sentence_what_they_need(python: Path, tmp_path: Path) -> None:
    """A replay says what it says with everything: the proof of gamma, and what is left of it after faults."""
    gains = Gains.load(GAINS)
    faulty = PacedRun(gains, steps=30, away={"2": range(10, 15)}).messages
    paced = record(tmp_path / "paced.mcap", gains, faulty, steps=30, period="0.1")
    needs = {**WORDS, f"replay {paced}": ""}
    ran = run(python, "-c", MANY, json.dumps(list(needs)), folder=tmp_path)
    assert ran.stderr == ""
    said = dict(zip(needs, map(json.loads, ran.stdout.splitlines()), strict=True))
    for words, needed in needs.items():
        code, _, errors = said[words]
        if needed:
            assert code == 2, words
            assert errors.splitlines()[-1].endswith(f" needs {needed}: pip install 'peakmesh[{EXTRAS[needed]}]'"), words
        else:
            assert code == 0, (words, errors)
    for recording, finding in ((LOSSY, "certificate  holds"), (paced, "valid at the end; 7 steps with faults")):
        assert said[f"replay {recording}"][1] == replay(recording).text() + "\n"
        assert finding in said[f"replay {recording}"][1]


def test_a_whole_run(python: Path, tmp_path: Path) -> None:
    """Seven processes, none of which has more than a board has."""
    ran = run(python, "-m", "agent", "run", GAINS, "--steps", 20, "-o", "run.mcap", folder=tmp_path)
    assert (ran.returncode, ran.stderr) == (0, "")
    assert replay(tmp_path / "run.mcap").outcome == "agrees"


def test_the_library_says_it_too(python: Path, tmp_path: Path) -> None:
    program = "import peakmesh, sys\ntry: peakmesh.design('two-nodes')\nexcept peakmesh.InputError as e: print(e)"
    ran = run(python, "-c", program, folder=tmp_path)
    assert ran.stdout == "design needs cvxpy: pip install 'peakmesh[design]'\n", ran.stderr


def test_a_defect_is_no_missing_extra() -> None:
    """What is missing and in no extra stays a traceback."""
    program = "from agent.contract.extras import needing\nwith needing('it'): import no_such_module"
    ran = run(Path(sys.executable), "-c", program, folder=ROOT)
    assert "ModuleNotFoundError: No module named 'no_such_module'" in ran.stderr


def test_a_proof_that_needs_more_is_not_called_a_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    """A network so large that its proof takes scipy: nothing is said of gamma, and why."""

    def verify(gains: Gains) -> None:
        raise ModuleNotFoundError("No module named 'scipy'", name="scipy")

    monkeypatch.setattr(certificate, "verify", verify)
    gamma = checked_gamma(Gains.load(GAINS))
    assert gamma.failure == "the proof of so large a network needs scipy: pip install 'peakmesh[design]'"
    assert gamma.text().startswith(f"certificate  NOT CHECKED: {gamma.failure}; ")
