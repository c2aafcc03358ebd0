"""The golden recordings come back: the command that made them makes them again, and what they hold has not changed."""

from __future__ import annotations

import os
import platform
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from places import GOLDEN, ROOT
from runs import answer, peakmesh

from designer.compare import compare
from designer.replay import replay

COMMANDS = dict(
    re.findall(
        r"^\| `golden/(\S+\.mcap)` \| `peakmesh (run .*)` \|$", (ROOT / "recordings/README.md").read_text(), re.M
    )
)


def test_every_golden_recording_has_its_command() -> None:
    assert sorted(COMMANDS) == sorted(path.name for path in GOLDEN.glob("*.mcap"))


@pytest.mark.parametrize("name", COMMANDS)
def test_a_golden_recording_comes_back(name: str, tmp_path: Path) -> None:
    """Bit for bit, on every machine."""
    *words, output = COMMANDS[name].split()
    assert output == f"recordings/golden/{name}"
    path = tmp_path / name
    assert answer(peakmesh(*words, path, "--json", cwd=ROOT))["missing"] == 0
    found = compare(GOLDEN / name, path)
    assert all(a == b for a, b in found.facts.values()), found.text()
    assert (found.messages, *map(sum, map(dict.values, found.only))) == (600, 0, 0)
    assert found.identical, found.text()


@pytest.mark.parametrize("name", COMMANDS)
def test_a_golden_recording_agrees(name: str) -> None:
    verdict = replay(GOLDEN / name)
    assert (verdict.agrees, verdict.finished, verdict.steps) == (True, True, 60)


# Processors: BLAS chooses its kernels, and numpy its loops, by what a processor can do.
NUMPY = (np._core if hasattr(np, "_core") else np.core)._multiarray_umath
OPTIONAL = [name for name in NUMPY.__cpu_dispatch__ if NUMPY.__cpu_features__[name]]
PROCESSORS = {
    "this": {},
    "an old one": {"OPENBLAS_CORETYPE": "Prescott"},
    "a newer one": {"OPENBLAS_CORETYPE": "Haswell"},
    "one without wide registers": {"NPY_DISABLE_CPU_FEATURES": " ".join(OPTIONAL)},
}


def otherwise(name: str, processor: dict[str, str], *words: str) -> tuple[int, int]:
    """In how many steps, and of how many, a golden recording's numbers come out otherwise on a processor."""
    command = [sys.executable, ROOT / "tests/support/recomputed.py", GOLDEN / name, *words]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), **processor}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True, timeout=120)
    differ, steps = map(int, done.stdout.split())
    return differ, steps


@pytest.mark.parametrize("processor", PROCESSORS)
def test_every_processor_makes_the_same_bits(processor: str) -> None:
    """The plant's and every node's, of the recording with losses."""
    assert otherwise("zhu2020-lossy.mcap", PROCESSORS[processor]) == (0, 59 * 9)


@pytest.mark.skipif(platform.machine() != "x86_64", reason="these kernels of BLAS are x86-64's")
def test_processors_differ_where_blas_adds_up() -> None:
    """Teeth: by BLAS, no recording could come back on every processor."""
    found = [otherwise("zhu2020-lossy.mcap", PROCESSORS[name], "--blas")[0] for name in ("an old one", "a newer one")]
    assert found[0] != found[1]
