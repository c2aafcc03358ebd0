"""A role tells systemd that it is up."""

from __future__ import annotations

import socket
from pathlib import Path

import pytest

from agent.commands.supervisor import tell_supervisor


@pytest.mark.parametrize("abstract", [False, True])
def test_who_is_up_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, abstract: bool) -> None:
    """To a socket in a file, or to one that is none."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as supervisor:
        supervisor.bind(f"\0{tmp_path.name}-notify" if abstract else str(tmp_path / "notify"))
        name = supervisor.getsockname()
        monkeypatch.setenv("NOTIFY_SOCKET", "@" + name[1:].decode() if abstract else name)
        tell_supervisor("the plant waits for everybody")
        assert supervisor.recv(4096) == b"READY=1\nSTATUS=the plant waits for everybody\n"


@pytest.mark.parametrize("address", [None, "", "/no/such/socket"])
def test_where_nobody_listens_nothing_happens(monkeypatch: pytest.MonkeyPatch, address: str | None) -> None:
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    if address is not None:
        monkeypatch.setenv("NOTIFY_SOCKET", address)
    tell_supervisor("")
