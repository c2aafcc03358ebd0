"""help, completion, --quiet and NO_COLOR."""

from __future__ import annotations

import io
import shutil
import subprocess
import sys
from argparse import Namespace
from pathlib import Path

import pytest
from places import GOLDEN

from agent.cli import perform
from agent.commands.quiet import Quiet
from designer.cli import main
from designer.commands.watch import _print_table
from designer.watch.scene import Scene


def said(words: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    assert main(words) == 0
    return capsys.readouterr().out


@pytest.mark.parametrize("words", [[], ["design"], ["keys"], ["keys", "init"]], ids=" ".join)
def test_help_is_what_the_option_says(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main([*words, "--help"])
    assert capsys.readouterr().out == said(["help", *words], capsys)


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["desing"], 'there is no command "desing"; did you mean "design"?'),
        (["xyz"], 'there is no command "xyz"; there are demo, '),
        (["design", "zhu2020-lossy"], "peakmesh design has no commands of its own"),
    ],
)
def test_help_with_what_is_not_there(words: list[str], sentence: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["help", *words]) == 2
    assert f"peakmesh: {sentence}" in capsys.readouterr().err


def test_the_version_is_said_in_short(capsys: pytest.CaptureFixture[str]) -> None:
    for option in ("-V", "--version"):
        with pytest.raises(SystemExit) as ended:
            main([option])
        assert ended.value.code == 0
        assert capsys.readouterr().out == "peakmesh 0.1.0\n"


# completion, asked of the shells themselves
BASH = """
compopt() { :; }
source "$1"; shift
COMP_WORDS=("$@") COMP_CWORD=$(($# - 1)) COMP_LINE="$*" COMP_POINT=999
$(complete -p peakmesh | sed 's/.*-F \\([^ ]*\\) .*/\\1/') peakmesh "${@: -1}" "${@: -2:1}"
printf '%s\\n' "${COMPREPLY[@]}"
"""
ASKED = {
    ("peakmesh", "des"): "design",
    ("peakmesh", "design", "two-nodes", "--bud"): "--budget",
    ("peakmesh", "completion", "z"): "zsh",
    ("peakmesh", "keys", "ren"): "renew",
    ("peakmesh", "replay", "zhu2020-los"): "zhu2020-lossy.mcap",
    ("peakmesh", "verify", "zhu2020-ideal.g"): "zhu2020-ideal.gains.json",
    ("peakmesh", "run", "zhu2020-ideal.g"): "zhu2020-ideal.gains.json",
}


def script(shell: str, folder: Path, capsys: pytest.CaptureFixture[str]) -> Path:
    if shutil.which(shell) is None:
        pytest.skip(f"there is no {shell} here")
    path = folder / "_peakmesh"
    path.write_text(said(["completion", shell], capsys))
    return path


def ask(command: list[str | Path]) -> set[str]:
    ran = subprocess.run(command, cwd=GOLDEN, capture_output=True, text=True, timeout=120)
    assert ran.stderr == ""
    return {line.split("\t")[0] for line in ran.stdout.splitlines()}


def test_bash_completes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made = script("bash", tmp_path, capsys)
    for words, wanted in ASKED.items():
        found = ask(["bash", "-c", BASH, "bash", made, *words])
        assert wanted in found, words
        assert all(each.startswith(words[-1]) for each in found), words


def test_fish_completes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made = script("fish", tmp_path, capsys)
    for words, wanted in ASKED.items():
        assert wanted in ask(["fish", "-N", "-c", f"source {made}; complete -C '{' '.join(words)}'"]), words


def test_zsh_knows_whose_completion_it_is(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """From a folder of fpath; what it would complete is seen by a person alone."""
    made = script("zsh", tmp_path, capsys)
    program = f"fpath=({made.parent} $fpath); autoload -U compinit; compinit -u -D; echo $_comps[peakmesh]"
    assert ask(["zsh", "-f", "-c", program]) == {"_peakmesh"}
    assert ask(["zsh", "-f", "-n", made]) == set()


# what is left out
def test_quiet_keeps_what_is_wrong() -> None:
    """Whole lines, in whatever pieces they come; no terminal, so that no bar is drawn."""
    kept = io.StringIO()
    quiet = Quiet(kept)
    print("  12 s  from least variance", "warning: w is small", sep="\n", file=quiet)
    for piece in ("peak", "mesh: no\nof", "f\n", "peakmesh: half"):
        quiet.write(piece)
    assert kept.getvalue() == "warning: w is small\npeakmesh: no\n"
    assert not quiet.isatty()


def test_quiet_is_for_every_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """What is told of a table is kept where it is a warning; the result is on stdout all the same."""
    cut = tmp_path / "cut.mcap"
    cut.write_bytes((GOLDEN / "zhu2020-lossy.mcap").read_bytes()[:-20000])
    assert main(["export", str(cut), "--csv", "--quiet"]) == 0
    told = capsys.readouterr()
    assert told.out.endswith(f"table      {tmp_path / 'cut.csv'}\n")
    assert told.err
    assert all(line.startswith("warning: ") for line in told.err.splitlines())
    for quiet, heard in ((False, "12 s\n"), (True, "")):
        options = Namespace(call=lambda options: print("12 s", file=sys.stderr) or 0, command="design", quiet=quiet)
        assert perform(options) == 0
        assert capsys.readouterr().err == heard
    assert main(["verify", "no-such-file", "-q"]) == 2
    assert capsys.readouterr().err.startswith("peakmesh: no-such-file does not exist")


@pytest.mark.parametrize(("variable", "coloured"), [("", True), ("1", False)])
def test_no_color_is_heeded(variable: str, coloured: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.setenv("NO_COLOR", variable)
    terminal = Terminal()
    monkeypatch.setattr("sys.stdout", terminal)
    _print_table(Scene("a-run").seen(), True)
    assert ("\x1b[33m" in terminal.getvalue()) is coloured


def test_no_colour_goes_into_a_pipe(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.delenv("FORCE_COLOR", raising=False)
    _print_table(Scene("a-run").seen(), True)
    assert "\x1b" not in capsys.readouterr().out
