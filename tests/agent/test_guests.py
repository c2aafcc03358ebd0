"""Programs of the user's in place of roles of our own: what they are told, how they end, and that none is left."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from runs import MANY, NURSERY, PATIENCE, program, roles_left, run_here, wait_until_gone

from agent.cli import main
from agent.contract.errors import RunBroken
from agent.contract.gains import Gains
from agent.guests import guests, programs
from designer.replay import replay

OUTLIVE = f"sleep {9_000_000 + os.getpid()}"  # something that a guest leaves behind, and no other test has


def guests_of(gains: Gains, **commands: Any) -> dict[str, list[str]]:
    return guests(gains, **{"nodes": {}, "sensors": {}, "plant": None, **commands})


def role(name: str, *words: str) -> list[str]:
    """The command of a role of our own, as a guest has it: a client, to which nobody has a link but the coordinator.

    Where the run is stands in its environment.
    """
    return program(name, "{gains}", *words, "--listen", "none", "--wait", str(PATIENCE), "--deadline", str(PATIENCE))


def in_a_shell(script: str, command: list[str]) -> list[str]:
    """A shell that has `command` as "$@"."""
    return ["sh", "-c", script, "sh", *command]


def processes(words: str) -> dict[int, str]:
    """Those whose command line has these words, by process id."""
    found = {}
    for entry in Path("/proc").iterdir():
        with contextlib.suppress(OSError, ValueError):
            command = (entry / "cmdline").read_text().replace("\0", " ")
            if words in command and int(entry.name) != os.getpid():
                found[int(entry.name)] = command
    return found


@pytest.fixture(autouse=True)
def patience(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a busy machine a guest takes long to end."""
    monkeypatch.setattr("agent.launch.GUEST_SECONDS", PATIENCE)


def test_what_a_guest_is_told(pair: Gains) -> None:
    """In its command, where that asks for it, and in its environment."""
    found = guests_of(
        pair, nodes={"n0": "true '{node}: x' {gains}{run}"}, sensors={"n1": "true"}, plant=["true", "{address}"]
    )
    told = programs(found, run="r", address="tcp/127.0.0.1:7", gains="a b.json")
    assert {who: program.words for who, program in told.items()} == {
        "node-n0": ["true", "n0: x", "a b.jsonr"],
        "sensor-n1": ["true"],
        "plant": ["true", "tcp/127.0.0.1:7"],
    }
    assert told["sensor-n1"].environment == {
        "PEAKMESH_RUN": "r",
        "PEAKMESH_NODE": "n1",
        "PEAKMESH_CONNECT": "tcp/127.0.0.1:7",
        "PEAKMESH_GAINS": "a b.json",
    }


@pytest.mark.parametrize(
    ("options", "refusal"),
    [
        (["--node", "n7=true"], 'node "n7" does not exist; '),
        (["--node", "n0"], "'n0' is not NODE=COMMAND, such as 2="),
        (["--node", "n0=true", "--node", "n0=true"], "--node n0=...: it is there twice"),
        (
            ["--node", "n0=./nowhere x"],
            'the command of node "n0", ./nowhere, cannot be started: there is no such program',
        ),
        (["--sensor", "n0='"], 'the command of sensor "n0", \', cannot be read: No closing quotation'),
        (["--plant", " "], "--plant is empty; it takes a command"),
        (
            ["--plant", "true", "--period", "1s", "--external", "n0"],
            "the plant is yours, but none takes part in a paced run",
        ),
    ],
)
def test_a_guest_that_cannot_be_is_refused(
    lone_path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], refusal: str
) -> None:
    """In one sentence, before anything is started or written."""
    try:
        code = main(["run", str(lone_path), "-o", str(tmp_path / "run.mcap"), *options])
    except SystemExit as end:  # argparse's
        code = end.code
    assert code == 2
    assert refusal in capsys.readouterr().err.splitlines()[-1]
    assert not list(tmp_path.iterdir())


def test_guests_take_part_and_end_with_the_run(pair_path: Path, pair: Gains, tmp_path: Path) -> None:
    """Node and plant are the user's; what they leave behind goes; a bad end after a good run is told."""
    commands = {
        "nodes": {"n0": in_a_shell(f'{OUTLIVE} & "$@"; echo oh >&2; exit 3', role("node"))},
        "plant": role("plant"),
    }
    warnings = []

    def heed(word: dict[str, Any]) -> None:
        if "started" in word:
            assert processes(OUTLIVE)
        warnings.extend([word["warning"]] if "warning" in word else [])

    recording = tmp_path / "run.mcap"
    summary = run_here(pair_path, recording, steps=40, guests=guests_of(pair, **commands), heed=heed)
    assert (summary["missing"], replay(recording).exit_code) == (0, 0)
    assert len(warnings) == 1, warnings
    assert re.fullmatch(
        r'node "n0" did not end well: its command, sh -c .*, ended with code 3, and said: oh', warnings[0]
    )
    wait_until_gone(list(processes(OUTLIVE)))


def test_a_guest_that_is_lost_ends_the_run(pair_path: Path, pair: Gains, tmp_path: Path) -> None:
    """With the coordinator's sentence, and how its command has ended."""
    command = guests_of(pair, nodes={"n0": in_a_shell('"$@"; exit 7', role("node"))})

    def kill() -> None:
        """The node, not the shell."""
        nodes = processes(f"node {pair_path} --listen none ")
        (pid,) = [pid for pid, words in nodes.items() if words.startswith(sys.executable)]
        os.kill(pid, signal.SIGKILL)

    with pytest.raises(RunBroken) as broken:
        run_here(pair_path, tmp_path / "run.mcap", at=10, do=kill, guests=command)
    assert re.fullmatch(
        r'node "n0" was lost: its process ended, or the network to it failed; the last that is recorded of it is of '
        r"step \d+; its command, sh -c .*, ended with code 7(, and said: Killed)?; what was recorded is in .*run\.mcap",
        str(broken.value),
    )
    assert roles_left() == {}


def test_a_guest_that_ends_before_the_start(lone_path: Path, lone: Gains, tmp_path: Path) -> None:
    """Whatever its code; and a file that is no program is one that ends."""
    (no_program := tmp_path / "node").write_text("#!/nowhere/interpreter\n")
    no_program.chmod(0o755)
    for command, end in (
        (["true"], "its command, true, ended with code 0"),
        (["sh", "-c", "kill -SEGV $$"], "its command, sh .*, died of SIGSEGV"),
        ([str(no_program)], f"its command, {no_program}, ended with code 3, and said: .*No such file.*"),
    ):
        with pytest.raises(RunBroken, match=f'^node "n0" ended before the run had started: {end}$'):
            run_here(lone_path, tmp_path / "run.mcap", guests=guests_of(lone, nodes={"n0": command}))
        assert not (tmp_path / "run.mcap").exists()


def test_a_guest_that_never_joins(lone_path: Path, lone: Gains, tmp_path: Path) -> None:
    """Whoever is missing is named, a guest with its command; it does not stay."""
    command = guests_of(lone, nodes={"n0": ["sh", "-c", f"{OUTLIVE}; true"]})
    with pytest.raises(RunBroken, match="within 3 s") as broken:
        run_here(lone_path, tmp_path / "run.mcap", guests=command, wait=3.0)
    is_named = 'node "n0"' in str(broken.value)  # where the machine is busy it may be others who are late
    assert is_named == bool(re.search(r"; its command, sh .*, had not ended, and was killed$", str(broken.value)))
    wait_until_gone(list(processes(OUTLIVE)))


@pytest.mark.parametrize("whom", ["launcher", "nursery"])
def test_a_guest_ends_with_whoever_has_started_it(lone_path: Path, tmp_path: Path, whom: str) -> None:
    """kill -9 of either leaves neither the guest nor what that has started."""
    words = ["run", lone_path, "--steps", MANY, "--wait", PATIENCE, "-o", tmp_path / "run.mcap"]
    words += ["--node", f"n0=sh -c 'sh -c \"{OUTLIVE}; true\"; true'"]
    with subprocess.Popen(
        [sys.executable, "-m", "agent", *map(str, words)], stdin=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    ) as launcher:
        try:
            deadline = time.monotonic() + PATIENCE
            while len(pids := [pid for pid in processes(OUTLIVE) if pid != launcher.pid]) < 3:
                assert time.monotonic() < deadline
                assert launcher.poll() is None
                time.sleep(0.01)
            (nursery,) = [pid for pid in processes(NURSERY) if _parent(pid) == launcher.pid]
            os.kill(launcher.pid if whom == "launcher" else nursery, signal.SIGKILL)
            wait_until_gone(pids)
        finally:
            launcher.terminate()
            launcher.communicate(timeout=PATIENCE)


def _parent(pid: int) -> int:
    return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])
