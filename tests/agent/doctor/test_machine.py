"""What a machine does not let a run have is found, for as many processes as there are to be."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
from places import ROOT

from agent.doctor import machine
from agent.doctor.findings import State

FEW = 7


def state(what: str, *, processes: int = FEW) -> set[State]:
    return {finding.state for finding in machine.machine(processes) if finding.what == what}


def test_open_files_are_those_of_the_process() -> None:
    """A real limit, in a process of its own: enough for few, too little for many."""
    program = "import sys; from agent.doctor.machine import machine; print(next(machine(int(sys.argv[1]))))"
    limit = machine.FILES + machine.FILES_EACH * FEW
    for processes, wanted in ((FEW, "GOOD"), (FEW + 1, "WRONG")):
        ran = subprocess.run(
            [sys.executable, "-c", program, str(processes)],
            cwd=ROOT,
            capture_output=True,
            text=True,
            check=True,
            preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_NOFILE, (limit, limit)),
        )
        assert f"State.{wanted}" in ran.stdout
        assert f"{limit} allowed" in ran.stdout


def test_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the user, but for root; and of the container, less those that are there."""
    limits = {resource.RLIMIT_NPROC: (200, 200), resource.RLIMIT_NOFILE: (10**6, 10**6)}
    monkeypatch.setattr(resource, "getrlimit", limits.__getitem__)
    monkeypatch.setattr(Path, "read_text", lambda path: {"pids.max": "max", "pids.current": "9"}[path.name])
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    assert machine._threads() == 200
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    assert machine._threads() == float("inf")
    monkeypatch.setattr(Path, "read_text", lambda path: {"pids.max": "100", "pids.current": "9"}[path.name])
    assert machine._threads() == 91
    assert machine._at_least("threads", 91, 92, "ulimit").state is State.WRONG
    assert machine._at_least("threads", 92, 92, "ulimit").state is State.GOOD
    assert machine._at_least("threads", float("inf"), 92, "ulimit").state is State.GOOD


@pytest.mark.parametrize(("available", "wanted"), [(100, "good"), (99, "warning"), (None, "warning")])
def test_memory(available: int | None, wanted: str, monkeypatch: pytest.MonkeyPatch) -> None:
    known = f"MemAvailable: {1024 * (available or 0)} kB\n" if available else "MemFree: 1 kB\n"
    monkeypatch.setattr(Path, "read_text", lambda path: f"MemTotal:  9 kB\n{known}")
    assert machine.memory(100).state == wanted


def test_folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One that is not there, as nobody but root is kept out of the others; and a disk that is full."""
    monkeypatch.chdir(tmp_path)
    assert [finding.state for finding in machine.folders()] == ["good", "good"]
    monkeypatch.setattr(machine.shutil, "disk_usage", lambda folder: SimpleNamespace(free=99e6))
    assert [finding.state for finding in machine.folders()] == ["warning", "warning"]

    def full(dir: str) -> object:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(tempfile, "TemporaryFile", full)
    assert [finding.state for finding in machine.folders()] == ["wrong", "wrong"]
    assert "No space left on device" in next(machine.folders()).said


def test_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    assert machine.workers().state is State.GOOD

    class Context:
        def Lock(self) -> object:
            raise FileNotFoundError(2, "No such file or directory")

    monkeypatch.setattr(machine.multiprocessing, "get_context", lambda kind: Context())
    assert machine.workers().state is State.WARNING


@pytest.mark.parametrize(
    ("now", "kernel", "wanted"),
    [
        (machine.OLDEST, 0, "good"),
        (machine.OLDEST, -1, "good"),  # who does not tell is not accused
        (machine.OLDEST, 5, "warning"),
        (0.0, 0, "wrong"),
    ],
)
def test_clock(now: float, kernel: int, wanted: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(time, "time", lambda: now)
    monkeypatch.setattr(machine, "_adjtimex", lambda: kernel)
    assert machine.clock().state == wanted


def test_the_kernel_is_asked() -> None:
    assert machine._adjtimex() in range(6)


@pytest.mark.parametrize(("late", "wanted"), [(0.0, "good"), (0.02, "warning")])
def test_timer(late: float, wanted: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A clock that stands still but for the sleeps."""
    now = 0.0

    def sleep(seconds: float) -> None:
        nonlocal now
        now += seconds + late

    clock: SimpleNamespace = SimpleNamespace(monotonic=lambda: now, sleep=sleep)
    monkeypatch.setattr(machine, "time", clock)
    assert machine.timer().state == wanted


def test_all_of_it_is_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    whats = {finding.what for finding in machine.machine(FEW)}
    assert whats == {"open files", "threads", "memory", "folder", "workers", "clock", "timer"}
    assert state("open files", processes=10**7) == {State.WRONG}
    assert state("threads", processes=0) == {State.GOOD}
    assert state("memory", processes=10**7) == {State.WARNING}
