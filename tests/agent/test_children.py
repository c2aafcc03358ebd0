"""Processes forked from one that has imported everything: how they begin, how they end, and that nobody is left."""

from __future__ import annotations

import json
import os
import select
import signal
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
from runs import PATIENCE, roles_left, wait_until_gone

from agent.children import Child, Nursery
from agent.contract.errors import RunBroken


@pytest.fixture
def nursery() -> Iterator[Nursery]:
    with closing(Nursery()) as nursery:
        yield nursery


def waiting(nursery: Nursery, gains_path: Path) -> Child:
    """A coordinator that waits for others."""
    child = nursery.start(["coordinator", str(gains_path), "--child"], wants_output=True)
    assert child.output is not None
    assert "listening" in json.loads(child.output.readline())
    return child


def test_children_tell_how_they_end(nursery: Nursery, lone_path: Path) -> None:
    """Their exit code, or the signal that has killed them; what they have said; and ps shows who they are."""
    failed = nursery.start(["run", "nowhere.json"], wants_output=False)
    misused = nursery.start(["plant"], wants_output=False)
    killed, stopped = waiting(nursery, lone_path), waiting(nursery, lone_path)
    assert Path(f"/proc/{killed.pid}/cmdline").read_text().startswith(f"peakmesh coordinator {lone_path}")
    assert len(list(Path(f"/proc/{nursery._process.pid}/task").iterdir())) == 1  # what forks has no other thread
    nursery.kill(killed)
    nursery.kill(stopped, signal.SIGTERM)
    for child in (stopped, killed, misused, failed):  # in whatever order
        assert nursery.wait(child)
    assert [child.code for child in (failed, misused, killed, stopped)] == [2, 2, -signal.SIGKILL, 143]
    assert [child.last_words()[:12] for child in (failed, stopped)] == ["nowhere.json", "terminated"]
    nursery.kill(killed)  # whoever has its number now
    for child in (failed, misused, killed, stopped):
        child.close()


def test_a_nursery_leaves_nobody(lone_path: Path) -> None:
    """Neither a child that stands still, nor itself, nor the folder of their sockets."""
    nursery = Nursery()
    child = waiting(nursery, lone_path)
    os.kill(child.pid, signal.SIGSTOP)
    assert child.pid in roles_left()
    assert nursery.folder.is_dir()
    nursery.close()
    child.close()
    assert child.code == -signal.SIGKILL
    assert roles_left() == {}
    assert not nursery.folder.exists()


def test_a_nursery_ends_in_order_whatever_its_starter_has_not_read(nursery: Nursery) -> None:
    """One that is killed may have been told of children's ends; the nursery's socket is then reset, not just closed."""
    child = nursery.start(["run", "nowhere.json"], wants_output=False)
    assert select.select([nursery._socket], [], [], PATIENCE)[0]  # told, and not read
    nursery._socket.close()
    child.close()
    assert nursery._process.wait(PATIENCE) == 0
    assert not nursery.folder.exists()
    nursery._children.clear()  # as if they had been read: the fixture waits for nobody


def test_children_of_a_nursery_that_is_killed_end(nursery: Nursery, lone_path: Path) -> None:
    """Whoever waits for them is told so, and they end when their input does."""
    child = waiting(nursery, lone_path)
    nursery._process.kill()
    with pytest.raises(RunBroken, match="the process that the roles are forked from has ended"):
        nursery.wait(child)
    with pytest.raises(RunBroken, match="the process that the roles are forked from has ended"):
        nursery.start(["plant"], wants_output=False)
    child.close()
    wait_until_gone([child.pid])


def test_a_nursery_that_cannot_start_says_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "setproctitle.py").write_text("raise ImportError('broken')")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    with closing(Nursery()) as nursery, pytest.raises(RunBroken, match="has ended; it said: ImportError: broken"):
        nursery.start(["plant"], wants_output=False)
