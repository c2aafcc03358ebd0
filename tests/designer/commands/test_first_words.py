"""What somebody meets who tries something wrong: a folder for a file, an option cut short, Ctrl-C at once."""

from __future__ import annotations

import json
import re
from pathlib import Path
from types import ModuleType

import pytest
from places import ROOT

import agent.__main__
import designer.__main__
from designer.cli import main

GOLDEN = ROOT / "recordings" / "golden"
LOSSY, GAINS = str(GOLDEN / "zhu2020-lossy.mcap"), str(GOLDEN / "zhu2020-lossy.gains.json")
RECORDER = "recorder", GAINS, "--connect", "tcp/127.0.0.1:1"
README = (ROOT / "README.md").read_text()


@pytest.mark.parametrize("folder", [".", "/"])
@pytest.mark.parametrize("words", [("run", GAINS), ("recover", LOSSY), RECORDER], ids=lambda words: words[0])
def test_a_folder_is_no_recording(words: tuple[str, ...], folder: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*words, "-o", folder]) == 2
    assert capsys.readouterr().err.endswith(f"peakmesh: {folder} is a folder; name a file in it\n")


def commands() -> set[str]:
    """Those of the README, which has every one (tests/test_readme.py)."""
    rows = README.partition("| command | does | prints |\n")[2].partition("\n\n")[0].splitlines()[1:]
    return {name for row in rows for name in re.findall(r"`(\w+)", row.split(" | ")[0])}


@pytest.mark.parametrize("words", [[], *([name] for name in sorted(commands())), ["keys", "init"]], ids=" ".join)
def test_no_option_may_be_cut_short(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    """--hel is no --help: else every new option could break a script."""
    with pytest.raises(SystemExit) as ended:
        main([*words, "--hel"])
    assert ended.value.code == 2
    with pytest.raises(SystemExit) as ended:
        main([*words, "--help"])
    assert ended.value.code == 0


class Interrupting(ModuleType):
    """A module whose import somebody interrupts."""

    def __getattr__(self, name: str) -> object:
        raise KeyboardInterrupt


@pytest.mark.parametrize("package", [agent, designer], ids=lambda package: package.__name__)
def test_ctrl_c_while_it_is_loaded_is_a_sentence(
    package: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(agent.__main__.sys.modules, f"{package.__name__}.cli", Interrupting("cli"))
    assert package.__main__.main() == 130
    assert capsys.readouterr().err == "peakmesh: interrupted\n"


def test_what_has_nothing_to_estimate_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """By its file, as every other fault."""
    path = tmp_path / "mine.toml"
    text = (ROOT / "designer" / "problems" / "two-nodes.toml").read_text()
    path.write_text(text.replace("M = [[1.0]]", "M = [[0.0]]"))
    for words in (["design", str(path)], ["analyse", str(path), "--gains", GAINS], ["run", str(path)]):
        assert main(words) == 2
        assert f"peakmesh: {path}: plant: M is zero, " in capsys.readouterr().err


def test_numbers_are_numbers(capsys: pytest.CaptureFixture[str]) -> None:
    """In what show says of a recording, and compare of two; verify says of which file."""
    assert main(["show", LOSSY, "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert (facts["seed"], facts["steps"], facts["complete_steps"]) == (2020, 60, 60)
    assert main(["compare", LOSSY, LOSSY, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["facts"]["seed"] == [2020, 2020]
    assert main(["verify", GAINS, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["file"] == GAINS
