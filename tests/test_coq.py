"""The kernel of Coq on small certificates, where it is installed, and the file that is written for it."""

from __future__ import annotations

import json
import re
import runpy
import shutil
from fractions import Fraction
from pathlib import Path
from typing import Any

import pytest
from places import ROOT

TOOL = runpy.run_path(str(ROOT / "tools" / "coq_certificate.py"))
CORRECT = ROOT / "tools" / "certificates" / "correct"
with_coq = pytest.mark.skipif(shutil.which("coqc") is None, reason="coqc is not on PATH; Debian's package is coq")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """With what is the same for all certificates, accepted by Coq."""
    made = tmp_path_factory.mktemp("coq")
    shutil.copytree(ROOT / "tools" / "coq", made, dirs_exist_ok=True)
    for name in ("model", "decide", "sound"):
        accepted, said = TOOL["asked"](made, name)
        assert accepted, said
    return made


def read(name: str) -> Any:
    text = (CORRECT / f"{name}.json").read_text()
    return json.loads(text, **dict.fromkeys(("parse_float", "parse_int"), lambda digits: Fraction(float(digits))))


def accepted(folder: Path, text: str) -> bool:
    """Whether Coq accepts the theorems. Where not, it has to be because of what is decided."""
    (folder / "certificate.v").write_text(text)
    good, said = TOOL["asked"](folder, "certificate")
    assert ("Axioms:" if good else 'The term "eq_refl" has type "true = true"') in said
    return good


@with_coq
def test_what_17_and_18_and_the_recursion_prove_are_theorems(folder: Path) -> None:
    text = TOOL["certificate"](read("full"))
    assert re.findall(r"Theorem (\w+)", text) == ["bound_1", "inequalities_1", "bound_2"]
    assert accepted(folder, text)


@with_coq
def test_a_gamma_that_is_a_millionth_below_what_17_and_18_prove_is_refused(folder: Path) -> None:
    file = read("theorem2-alone")
    file["certificate"]["gamma"] *= 1 - Fraction(1, 2**20)
    assert not accepted(folder, TOOL["certificate"](file))


@with_coq
def test_steps_of_the_recursion_are_not_believed(folder: Path) -> None:
    """Those of a file, for a gamma that is below the lower end of its exact gain."""
    file = read("full")
    del file["certificate"]["theorem1_gamma"]
    text, (low, _) = TOOL["certificate"](file), file["certificate"]["exact"]
    (claimed,) = re.findall(r"gamma_1 := (\S+)\. ", text)
    assert not accepted(folder, text.replace(f"gamma_1 := {claimed}", f"gamma_1 := {TOOL['number'](low)}"))


def test_what_coq_is_given_are_the_numbers_of_the_file() -> None:
    for name in ("links", "weighted", "two-outputs-theorem2", "unbiased-some-seen-links"):
        file = read(name)
        problem, text = file["problem"], "\n".join(TOOL["filters"](file))
        for letter in "ABM":
            assert _numbers(text, letter) == _flat(problem["plant"][letter])
        assert _numbers(text, "Pi") == _flat(problem["markov"]["transition"])
        assert _numbers(text, "adjacency") == _flat([mode["adjacency"] for mode in problem["topology"]])
        assert sorted(_numbers(text, "K")) == sorted(_flat(file["K"]))
        assert sorted(_numbers(text, "H")) == sorted(_flat(file["H"]))
        nodes = [[v["arrival_probability"], v.get("weight", Fraction(1)), v["C"], v["D"]] for v in problem["node"]]
        assert _numbers(text, "nodes") == _flat(nodes)


def _numbers(text: str, key: str) -> list[Fraction]:
    """What Coq reads of an entry, as Python's own reader of such numbers has it."""
    (part,) = re.findall(rf"^  {key} := (.*?)(?:;$| \|}}\.)", text, flags=re.MULTILINE | re.DOTALL)
    if key == "nodes":
        part = text[text.index("  nodes := ") + 11 : text.index("  rho := ")]
    return [Fraction(float.fromhex(token)) for token in re.findall(r"-?0x[0-9a-f]+p-?\d+|(?<![\w.])0(?!x)", part)]


def _flat(entries: Any) -> list[Fraction]:
    if isinstance(entries, dict):
        entries = list(entries.values())
    return [number for entry in entries for number in _flat(entry)] if isinstance(entries, list) else [entries]


@pytest.mark.parametrize(
    ("old", "new", "why"),
    [('"gamma":', '"gamma":9.0,"gamma":', "ValueError"), ('"K":', '"k":', "KeyError"), ("{", "[", "JSONDecodeError")],
)
def test_of_what_cannot_be_read_coq_is_not_asked(
    old: str, new: str, why: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "gains.json").write_text((CORRECT / "full.json").read_text().replace(old, new))
    monkeypatch.setattr("sys.argv", ["coq_certificate.py", str(tmp_path / "gains.json"), str(tmp_path / "coq")])
    assert TOOL["main"]() == 2
    assert f"Coq was not asked: {why}" in capsys.readouterr().out
    assert not (tmp_path / "coq").exists()


def test_without_coq_it_is_said_which_package_has_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(
        "sys.argv", ["coq_certificate.py", str(CORRECT / "full.json"), str(tmp_path / "coq"), "theorem1"]
    )
    assert TOOL["main"]() == 2
    assert "Debian's package is coq" in capsys.readouterr().out
    assert not (tmp_path / "coq").exists()


def test_theorem1_leaves_out_what_only_the_recursion_proves() -> None:
    text = TOOL["certificate"](read("full"), with_recursion=False)
    assert re.findall(r"Theorem (\w+)", text) == ["bound_1", "inequalities_1"]
    with pytest.raises(AssertionError, match="prove no gamma"):
        TOOL["certificate"](read("links"), with_recursion=False)
