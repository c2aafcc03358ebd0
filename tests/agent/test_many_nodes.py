"""A dozen nodes on a ring: real processes, and the links that they have."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest
from runs import children, run_here

from agent.contract.errors import Interrupted
from agent.contract.keys import COORDINATOR, node_who, participants
from agent.network.links import linked
from benchmarks.replay import ring
from designer.replay import replay


def connections(pid: int) -> int:
    """How many Unix sockets of a process are connected."""
    table = [line.split() for line in Path("/proc/net/unix").read_text().splitlines()[1:]]
    connected = {f"socket:[{inode}]" for *_, kind, state, inode in (row[:7] for row in table) if state == "03"}
    folder = Path(f"/proc/{pid}/fd")
    return sum(os.readlink(folder / fd) in connected for fd in os.listdir(folder))


def test_nodes_have_links_with_those_they_deal_with(tmp_path: Path) -> None:
    """Seven each, not fourteen; nothing is missing, and what was recorded agrees."""
    gains, path, recording = ring(12), tmp_path / "gains.json", tmp_path / "run.mcap"
    gains.save(path)
    found: dict[str, int] = {}

    def look() -> None:
        for pid, command in children(os.getpid()).items():
            if "--child" in command:
                who = node_who(command[command.index("--node") + 1]) if "--node" in command else command[1]
                found[who] = connections(pid)
        os.kill(os.getpid(), signal.SIGTERM)

    with pytest.raises(Interrupted):
        run_here(path, recording, at=10, do=look)
    assert found == {who: len(linked(gains.problem, who)) for who in participants(gains.problem)}
    assert found["node-1"] == 7
    assert found[COORDINATOR] == 14
    verdict = replay(recording)
    assert (verdict.exit_code, verdict.first_divergence, verdict.missing.total) == (3, None, 0)  # cut short
