"""Signals while gains are designed: whatever comes, when and how often, there is a file that holds what it says."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from agent.contract.gains import Gains
from designer import beyond_gamma, synthesis, undercut
from designer.box import design as box_design
from designer.cli import main
from designer.commands import design as command
from designer.commands.stopping import HURRYING, NOTHING, STOPPED, STOPPING
from designer.lmi import conic, lmi_design
from designer.patience import Budget
from designer.proof.certificate import verify
from designer.search import descent, exact_design, quiet
from designer.search.barrier import Barrier
from designer.search.descent import Progress

SEARCH, PROOF, COMPARISON = "search", "proof", "comparison"
LOSSY = ("--set", "node.left.arrival_probability=0.9")  # where chance has no say all is known at once
SLACK = ("--peak-slack", "5%")
BOX = ("--within", "probabilities=0.02")
DECOMPOSED, DIFFUSION = ("--method", "decomposed"), ("--method", "diffusion")


class Phase(NamedTuple):
    """What goes on as a signal comes: the first call of a function, in a design with these options."""

    kind: str
    room: Any
    name: str
    options: tuple[str, ...] = ()
    left_out: str = ""  # where it is cut short

    def __str__(self) -> str:
        return "-".join([self.kind, self.name.strip("_"), *self.options[-1:]])


GRADIENT = Phase(SEARCH, Barrier, "_swept")
SOLVER = Phase(SEARCH, conic, "clarabel", DECOMPOSED)
CONFIRMED = Phase(PROOF, exact_design, "confirmed")
LOWER_END = Phase(COMPARISON, exact_design, "lower_end", (), "the lower end of the exact gain")
PHASES = [
    Phase(SEARCH, exact_design, "least_variance_gains"),
    Phase(SEARCH, exact_design, "_solved"),
    GRADIENT,
    Phase(SEARCH, descent._Search, "_centre"),
    Phase(SEARCH, quiet._Search, "_minimised", SLACK),
    Phase(SEARCH, box_design._Search, "follow", BOX),
    Phase(SEARCH, box_design._Search, "prove", BOX),
    SOLVER,
    Phase(PROOF, descent._Search, "choose"),
    Phase(PROOF, quiet._Search, "measured", SLACK, "the search for the least noise"),
    CONFIRMED,
    CONFIRMED._replace(options=DIFFUSION),
    Phase(PROOF, box_design, "robust", BOX, "what holds for every model of the box"),
    Phase(PROOF, lmi_design, "satisfies_17", DECOMPOSED, "the exact gain of these gains"),
    LOWER_END,
    Phase(COMPARISON, synthesis, "floor_below", (), "the floor"),
    Phase(COMPARISON, beyond_gamma, "node_gains", (), "noise, and the gains of single nodes"),
    Phase(COMPARISON, synthesis, "_with_gain", DECOMPOSED, "the exact gain of these gains"),
    Phase(COMPARISON, undercut, "undercut", DECOMPOSED, "the least that the LMI can give"),
]


WAITING = """
import sys
from designer.cli import main
from designer.search import descent, exact_design

def choose(*given):
    print("choosing", flush=True)
    sys.stdin.readline()
    return proper(*given)

descent._WEIGHTS, exact_design._LMI_STATES = descent._WEIGHTS[:1], 0
proper, descent._Search.choose = descent._Search.choose, choose
sys.exit(main(["design", "two-nodes", "-o", sys.argv[1]]))
"""


class Stopped(NamedTuple):
    """A design that signals came to."""

    code: int
    gains: Gains | None
    said: str
    result: dict[str, Any]
    gradients: int  # that were made after the signals


def stopped(phase: Phase, signals: int, folder: Path, capsys: pytest.CaptureFixture[str]) -> Stopped:
    """They come one after the other, before the function does what it does."""
    to_come, gradients = [signal.SIGINT, signal.SIGTERM][:signals], list[None]()
    proper, swept = getattr(phase.room, phase.name), Barrier._swept

    def pressed(*given: Any, **named: Any) -> Any:
        while to_come:
            os.kill(os.getpid(), to_come.pop())
        return proper(*given, **named)

    def counted(*given: Any, **named: Any) -> Any:
        found = swept(*given, **named)
        gradients.extend([] if to_come else [None])
        return found

    path = folder / "gains.json"
    with pytest.MonkeyPatch.context() as patched:
        for room in (descent, quiet, box_design):
            patched.setattr(room, "_WEIGHTS", room._WEIGHTS[:1])
        patched.setattr(exact_design, "_LMI_STATES", 8 if phase.name == "_solved" else 0)
        patched.setattr(exact_design, "beyond_paper", lambda problem: "as if it were, which takes less time")
        patched.setattr(Barrier, "_swept", counted)
        patched.setattr(phase.room, phase.name, pressed)
        code = main(["design", "two-nodes", *LOSSY, *phase.options, "-o", str(path), "--json"])
    answer = capsys.readouterr()
    assert not to_come, f"{phase} was never gone through"
    gains = Gains.load(path) if path.exists() else None
    return Stopped(code, gains, answer.err, json.loads(answer.out or "{}"), len(gradients))


def faults(phase: Phase, signals: int, found: Stopped) -> list[str]:
    """What is not as it should be."""
    if found.code or found.gains is None or not verify(found.gains).holds:
        return [f"no file that holds: {found.code}, {found.said}"]
    how_it_went = [found.gains.solver.status, *(found.result["within"] or {"said": []})["said"]]
    is_left_out, is_at_once = phase.left_out in found.result["left_out"], found.gains.certificate.exact is None
    is_ended = phase.kind != SEARCH or "interrupted" in str(how_it_went)
    wrong = {
        "goes on with the search": found.gradients > 0 or not is_ended,
        "cuts a proof short": phase.kind == PROOF and signals == 1 and not phase.left_out and is_at_once,
        "goes on with a proof": phase.kind == PROOF and signals == 2 and not (is_at_once or is_left_out),
        "goes on comparing": phase.kind == COMPARISON and not is_left_out,
        "does not answer each": [found.said.count(each) for each in (STOPPING, STOPPED, HURRYING)]
        not in ([1, 0, signals - 1], [0, 1, signals - 1]),
    }
    return [fault for fault, is_there in wrong.items() if is_there]


@pytest.mark.parametrize(
    ("phase", "signals"),
    [(phase, signals) for phase in PHASES for signals in ((1,) if phase.kind == COMPARISON else (1, 2))],
    ids=str,
)
def test_signals_in_any_phase_leave_a_file_that_holds(
    phase: Phase, signals: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One ends a search and leaves comparisons out; two cut a proof short."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    assert faults(phase, signals, stopped(phase, signals, tmp_path, capsys)) == []
    assert {number: signal.getsignal(number) for number in before} == before


@pytest.mark.parametrize(
    ("room", "name", "phase", "signals", "fault"),
    [
        (Budget, "check", GRADIENT, 1, "goes on with the search"),
        (conic.Heard, "__call__", SOLVER, 1, "goes on with the search"),
        (Budget, "check_last", CONFIRMED, 2, "goes on with a proof"),
        (Budget, "check_comparison", LOWER_END, 1, "goes on comparing"),
    ],
)
def test_whoever_is_deaf_is_found(
    room: Any,
    name: str,
    phase: Phase,
    signals: int,
    fault: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(room, name, lambda *_, **__: None)
    assert fault in faults(phase, signals, stopped(phase, signals, tmp_path, capsys))


def test_where_nothing_is_found_yet_nothing_is_written_and_that_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """An unstable plant has no gains that ignore it."""
    problem = tmp_path / "unstable.toml"
    problem.write_text(
        'name = "unstable"\nplant = { A = [[1.5]], B = [[1.0, 0.0]], M = [[1.0]] }\nunbiased = true\n'
        'node = [{ name = "1", C = [[1.0]], D = [[0.0, 0.1]], arrival_probability = 1.0 }]\n'
        'topology = [{ name = "alone", adjacency = [[1.0]] }]\n'
        'markov = { transition = [[1.0]], initial = "alone" }\n'
    )
    phase, proper = PHASES[0], exact_design.least_variance_gains
    with pytest.MonkeyPatch.context() as patched:

        def pressed(*given: Any) -> Any:
            for _ in range(2):
                os.kill(os.getpid(), signal.SIGTERM)
            return proper(*given)

        patched.setattr(phase.room, phase.name, pressed)
        assert main(["design", str(problem), "-o", str(tmp_path / "gains.json")]) == 143
    assert capsys.readouterr().err.splitlines()[-2:] == [NOTHING, "peakmesh: terminated"]
    assert not (tmp_path / "gains.json").exists()


def test_a_process_that_is_told_to_end_leaves_a_file(tmp_path: Path) -> None:
    """It waits for a line as it is about to choose, and hears two signals meanwhile."""
    path = tmp_path / "gains.json"
    pipes: dict[str, Any] = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
    with subprocess.Popen([sys.executable, "-c", WAITING, str(path)], text=True, **pipes) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        assert process.stdout.readline() == "choosing\n"
        for number, answer in ((signal.SIGTERM, STOPPING), (signal.SIGINT, HURRYING)):
            process.send_signal(number)
            assert f"{answer}\n" in iter(process.stderr.readline, "")
        _, said = process.communicate("\n", timeout=300)
    assert process.returncode == 0, said
    assert "Traceback" not in said
    assert verify(Gains.load(path)).holds


def test_what_goes_on_after_a_long_search_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    show = command._descent_progress(600.0)
    for seconds, phase in ((1.0, "proving gamma"), (50.0, "proving gamma"), (50.5, "choosing")):
        show(Progress("x", 0.0, 1, 1.0, seconds, 20, phase=phase))
    assert capsys.readouterr().err.splitlines() == ["   50 s  proving gamma", "   50 s  choosing"]
