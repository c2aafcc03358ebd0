"""`peakmesh conform`: our own node and those in plain Python pass; what it prints, and what it refuses."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from places import GOLDEN, ROOT
from runs import PATIENCE, wait_until_gone

from designer.cli import main

PLAIN, PACED = (str(ROOT / "examples" / name) for name in ("plain_node.py", "paced_node.py"))
OURS = [sys.executable, "-m", "agent", "node", "{gains}", "--deadline", str(PATIENCE)]
PATIENT = ["--wait", str(PATIENCE), "--deadline", str(PATIENCE)]
ALL = ["ideal", "lossy", "seen", "links", "unbiased", "sizes", "all"]
MORE = ["later", "twice", "stop", "signal", "lost", "paced", "again"]


def conform(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, dict[str, Any]]:
    code = main(["conform", "--json", *words])
    return code, json.loads(capsys.readouterr().out)


def test_a_node_in_plain_python_passes(capsys: pytest.CaptureFixture[str]) -> None:
    """All of it: two files of zenoh and JSON, told what to be by their environment."""
    code, said = conform(capsys, *PATIENT, "--", sys.executable, PACED)
    assert [trial["trial"] for trial in said["trials"]] == [*ALL, *MORE]
    assert [trial["says"] for trial in said["trials"] if not trial["passed"]] == []
    assert (code, said["passed"]) == (0, True)


def test_our_own_node_passes(capsys: pytest.CaptureFixture[str]) -> None:
    """So what is played for it is what a node meets; it is told by the words of its command, too."""
    trials = ["all", "later", "twice", "signal", "paced", "again"]
    only = [word for trial in trials for word in ("--only", trial)]
    code, said = conform(capsys, *PATIENT, *only, "--", *OURS, "--node", "{node}", "--run", "{run}")
    assert [trial["says"] for trial in said["trials"] if not trial["passed"]] == []
    assert (code, len(said["trials"])) == (0, len(trials))


def test_the_node_of_a_network_of_ones_own(capsys: pytest.CaptureFixture[str]) -> None:
    """As for a device, whose gains stand in its program."""
    own = ["--gains", str(GOLDEN / "zhu2020-lossy.gains.json"), "--node", "2"]
    code, said = conform(capsys, *PATIENT, *own, "--skip", "paced", "--skip", "again", "--", sys.executable, PLAIN)
    assert (code, [trial["trial"] for trial in said["trials"]]) == (0, ["whole", *MORE[:-2]])


def rounding(folder: Path) -> Path:
    """A node that computes in float32."""
    text = Path(PLAIN).read_text()
    old = "reduce(lambda a, b: a + b, (g * v for"
    assert text.count(old) == 1
    small = 'struct.unpack("f", struct.pack("f", g * v))[0]'
    (folder / "node.py").write_text(text.replace(old, f"reduce(lambda a, b: a + b, ({small} for"))
    return folder / "node.py"


def test_other_arithmetic_passes_within_a_tolerance(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    command = ["--only", "lossy", "--", sys.executable, str(rounding(tmp_path))]
    assert conform(capsys, *PATIENT, "--tolerance", "1e-5", *command)[0] == 0
    code, said = conform(capsys, *PATIENT, "--tolerance", "1e-12", *command)
    (trial,) = said["trials"]
    assert (code, said["passed"], trial["passed"]) == (1, False, False)
    assert trial["says"].startswith(f"step {trial['step']}: {trial['field']} is {trial['value']}, must be ")
    assert trial["value"] == pytest.approx(trial["wanted"], rel=1e-5)


def test_people_read_a_line_for_each_trial(capsys: pytest.CaptureFixture[str]) -> None:
    """A node that has no clock says so where a run has one."""
    code = main(["conform", *PATIENT, "--only", "ideal", "--only", "paced", "--", sys.executable, PLAIN])
    first, second, last = capsys.readouterr().out.splitlines()
    assert (code, first) == (1, "pass  ideal    the ideal example: 24 estimates, bit for bit")
    assert second.startswith(
        "FAIL  paced    against the clock, with faults: it ended with code 1 where its estimate of"
    )
    assert "paced_node.py can do that" in second
    assert last == "1 of 2 trials passed"


def test_nothing_is_left_where_it_is_asked_to_end(tmp_path: Path) -> None:
    """The program is one that heeds no signal, and has started another; one sentence, and the signal's exit code."""
    script = tmp_path / "deaf.sh"
    script.write_text(f"trap '' TERM HUP INT\nsleep 9999999 &\necho $$ $! > {tmp_path}/new\n"
                      f"mv {tmp_path}/new {tmp_path}/pids\nwait\n")  # fmt: skip
    command = [sys.executable, "-m", "designer", "conform", "--only", "lossy", *PATIENT, "--", "sh", str(script)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as conform:
        until = time.monotonic() + PATIENCE
        while not (tmp_path / "pids").exists() and time.monotonic() < until:
            time.sleep(0.02)
        conform.terminate()
        _, said = conform.communicate(timeout=PATIENCE)
    assert conform.returncode == 128 + signal.SIGTERM, said
    assert len(said.splitlines()) == 1, said
    wait_until_gone([int(pid) for pid in (tmp_path / "pids").read_text().split()])


def test_what_would_be_tried_is_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["conform", "--list"]) == 0
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == [*ALL, *MORE]


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ([], "there is no command to try: peakmesh conform -- ./my_node"),
        (["--only", "fast", "--", "true"], '--only fast: there is no such trial; there are "ideal"'),
        (["--skip", "slow", "--", "true"], '--skip slow: there is no such trial; there are "ideal"'),
        (["--only", "ideal", "--skip", "ideal", "--", "true"], "--skip leaves nothing to try"),
        (["--node", "1", "--", "true"], "--gains FILE and --node NAME go together"),
        (["--", "./no-such-node"], "./no-such-node, cannot be started: there is no such program"),
        (["--", str(GOLDEN)], "cannot be started"),
    ],
)
def test_what_cannot_be_tried_is_refused(words: list[str], says: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["conform", *words]) == 2
    captured = capsys.readouterr()
    assert (captured.out, says in captured.err) == ("", True), captured.err
