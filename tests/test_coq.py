"""The kernel of Coq on small certificates, where it is installed, and the file that is written for it."""

from __future__ import annotations

import json
import runpy
import shutil
from fractions import Fraction
from pathlib import Path
from typing import Any

import pytest
from places import ROOT

TOOL = runpy.run_path(str(ROOT / "tools" / "coq_certificate.py"))
CORRECT, INCORRECT = (ROOT / "tools" / "certificates" / kind for kind in ("correct", "incorrect"))
with_coq = pytest.mark.skipif(shutil.which("coqc") is None, reason="coqc is not on PATH; Debian's package is coq")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What is the same for all certificates, accepted by Coq."""
    made = tmp_path_factory.mktemp("coq")
    shutil.copytree(ROOT / "tools" / "coq", made, dirs_exist_ok=True)
    for name in ("model", "decide", "sound"):
        accepted, said = TOOL["asked"](made, name)
        assert accepted, said
    return made


def read(path: Path) -> Any:
    return json.loads(
        path.read_text(), **dict.fromkeys(("parse_float", "parse_int"), lambda text: Fraction(float(text)))
    )


def accepted(folder: Path, text: str) -> bool:
    """Whether Coq accepts the theorems; it has to be the decision that fails, and nothing else."""
    (folder / "certificate.v").write_text(text)
    good, said = TOOL["asked"](folder, "certificate")
    assert ("Axioms:" if good else '"true = true" while it is expected to have type\n "decide filters') in said
    return good


@with_coq
def test_what_17_and_18_prove_is_a_theorem_and_a_gamma_a_millionth_lower_is_none(folder: Path) -> None:
    file = read(CORRECT / "theorem2-alone.json")
    assert accepted(folder, TOOL["certificate"](file))
    file["certificate"]["gamma"] *= 1 - Fraction(1, 2**20)
    assert not accepted(folder, TOOL["certificate"](file))


@with_coq
@pytest.mark.parametrize("stem", ["P", "R", "H-theorem2"])
def test_a_number_that_is_moved_is_refused(stem: str, folder: Path) -> None:
    assert not accepted(folder, TOOL["certificate"](read(INCORRECT / f"{stem}.json")))


@with_coq
def test_the_recursion_is_a_theorem_and_one_of_its_steps_more_is_none(folder: Path) -> None:
    text = TOOL["certificate"](read(CORRECT / "unbiased-seen-links-unstable.json"))
    assert accepted(folder, text)
