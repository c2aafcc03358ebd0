"""`peakmesh doctor`: what it says, and what it answers."""

from __future__ import annotations

import json
import shutil
import socket
from pathlib import Path

import pytest
from places import GOLDEN

from agent.cli import main
from agent.doctor import machine

GAINS = str(GOLDEN / "zhu2020-lossy.gains.json")


@pytest.fixture(autouse=True)
def enough(monkeypatch: pytest.MonkeyPatch) -> None:
    """Files and threads, whatever this machine has."""
    monkeypatch.setattr(machine, "FILES_EACH", 1)
    monkeypatch.setattr(machine, "THREADS", 1)


def test_a_good_machine(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor"]) == 0
    *lines, last = capsys.readouterr().out.splitlines()
    assert last == "nothing stands in the way of a run"
    assert {line.split()[0] for line in lines} <= {"good", "absent", "warning"}
    assert {"python", "packages", "zenoh", "clock", "memory"} <= {line.split()[1] for line in lines}


def test_what_is_wrong_is_named_at_the_end(capsys: pytest.CaptureFixture[str]) -> None:
    """As text, and as one object; the answer is no."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        words = ["doctor", GAINS, "--listen", f"tcp/127.0.0.1:{server.getsockname()[1]}"]
        assert main(words) == 1
        assert capsys.readouterr().out.endswith("\nlisten: a run would fail\n")
        assert main([*words, "--json"]) == 1
    told = json.loads(capsys.readouterr().out)
    assert told["good"] is False
    assert [finding["what"] for finding in told["findings"] if finding["state"] == "wrong"] == ["listen"]


def test_variables_of_a_service_are_heeded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PEAKMESH_LISTEN", "tcp/0.0.0.0:0")
    assert main(["doctor"]) == 2
    monkeypatch.setenv("PEAKMESH_INSECURE", "1")
    assert main(["doctor"]) == 0


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["no-such-gains.json"], "no-such-gains.json does not exist"),
        (["--connect", "127.0.0.1:7447"], "an address looks like tcp/127.0.0.1:7447"),
        (["--listen", "tcp/0.0.0.0:7447"], "other machines could take part"),
        (["--keys", "no-such-folder"], "--keys no-such-folder: there is no ca.pem in it"),
    ],
)
def test_bad_input(words: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", *words]) == 2
    assert said in capsys.readouterr().err


def test_keys_of_a_node_alone_are_looked_at(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Of a node's machine, on which there are no others; and what does not fit there."""
    keys, own = tmp_path / "keys", tmp_path / "own"
    assert (
        main(
            [
                "keys",
                "init",
                "--problem",
                str(GOLDEN.parents[1] / "designer/problems/zhu2020-lossy.toml"),
                "-o",
                str(keys),
            ]
        )
        == 0
    )
    own.mkdir()
    for name in ("ca.pem", "node-1.pem", "node-1.key"):
        shutil.copy(keys / name, own / name)
    capsys.readouterr()
    assert main(["doctor", GAINS, "--keys", str(own), "--listen", "tls/127.0.0.1:0"]) == 0
    assert "can listen at tls/127.0.0.1:" in capsys.readouterr().out
    (own / "node-1.key").write_bytes((keys / "node-2.key").read_bytes())
    assert main(["doctor", "--keys", str(own)]) == 2
    assert "is not the private key of" in capsys.readouterr().err
