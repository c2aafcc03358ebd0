"""Signals while gains are designed: whatever comes and how often, there is a file that holds what it says."""

from __future__ import annotations

import signal
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from agent.contract.gains import Gains
from designer.cli import main
from designer.commands import design as command
from designer.commands.stopping import STOPPED, STOPPING
from designer.search import exact_design
from designer.search.descent import Progress


def raising(number: int, function: Callable[..., Any]) -> Callable[..., Any]:
    """The function, before which this signal comes once."""
    to_come = [number]

    def raised(*given: Any, **named: Any) -> Any:
        while to_come:
            signal.raise_signal(to_come.pop())
        return function(*given, **named)

    return raised


@pytest.mark.parametrize("first", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_search_and_a_second_one_nothing(
    first: signal.Signals, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The first comes during the search, the second while its best gains are certified."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    monkeypatch.setattr(command, "_descent_progress", lambda *_, **__: raising(first, lambda progress: None))
    monkeypatch.setattr(exact_design, "certify", raising(signal.SIGINT, exact_design.certify))
    assert main(["design", "two-nodes", "-o", str(tmp_path / "gains.json")]) == 0
    assert capsys.readouterr().err == f"{STOPPING}\n{STOPPED}\n"
    assert Gains.load(tmp_path / "gains.json").solver.status.startswith("interrupted")
    assert main(["verify", str(tmp_path / "gains.json")]) == 0
    assert {number: signal.getsignal(number) for number in before} == before


def test_a_signal_whose_exception_is_lost_ends_the_search_at_its_next_step(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """As in a callback of a library, from which nothing is raised."""
    told: list[Progress] = []

    def tell(progress: Progress) -> None:
        told.append(progress)
        with suppress(KeyboardInterrupt):
            if len(told) == 3:
                signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(command, "_descent_progress", lambda *_, **__: tell)
    assert main(["design", "two-nodes", "-o", str(tmp_path / "gains.json")]) == 0
    assert [progress.steps for progress in told if progress.phase is None] == [1, 2, 3]
    assert Gains.load(tmp_path / "gains.json").solver.status.startswith("interrupted")


@pytest.mark.parametrize("work", ["certify", "recover"])
def test_a_signal_outside_the_search_leaves_a_file(
    work: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """In the proof it ends nothing; before the search it ends what has not begun."""
    monkeypatch.setattr(exact_design, work, raising(signal.SIGINT, getattr(exact_design, work)))
    assert main(["design", "two-nodes", "-o", str(tmp_path / "gains.json")]) == 0
    said, status = capsys.readouterr().err, Gains.load(tmp_path / "gains.json").solver.status
    assert (STOPPED if work == "certify" else STOPPING) in said
    assert status.startswith("converged" if work == "certify" else "interrupted")
    assert main(["verify", str(tmp_path / "gains.json")]) == 0


def test_what_goes_on_after_a_long_search_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    show = command._descent_progress(600.0)
    for seconds, phase in ((1.0, "proving gamma"), (50.0, "proving gamma"), (50.5, "choosing")):
        show(Progress("x", 0.0, 1, 1.0, seconds, 20, phase=phase))
    assert capsys.readouterr().err.splitlines() == ["   50 s  proving gamma", "   50 s  choosing"]


def test_a_signal_before_the_search_leaves_gains_that_ignore_everything(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(exact_design, "_starts", raising(signal.SIGTERM, exact_design._starts))
    assert main(["design", "two-nodes", "-o", str(tmp_path / "gains.json")]) == 0
    gains = Gains.load(tmp_path / "gains.json")
    assert "ignoring all measurements" in gains.solver.status
    assert not any(H_ij.any() for heard in gains.H["linked"].values() for H_ij in heard.values())
    assert main(["verify", str(tmp_path / "gains.json")]) == 0
