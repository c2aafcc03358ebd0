"""Roles as commands, each a process, as on machines of their own: how they find each other, and what they refuse."""

from __future__ import annotations

from pathlib import Path

from runs import (
    PATIENCE,
    line_with,
    peakmesh,
    started,
)

from agent.contract.gains import Gains
from designer.replay import replay


def test_roles_by_hand_with_a_late_recorder(pair_path: Path, tmp_path: Path, pair: Gains) -> None:
    """Roles started one by one as commands, the recorder last, when all the others wait for it: nothing is lost."""
    recording = tmp_path / "run.mcap"
    names = pair.problem.node_names
    with started("coordinator", pair_path, "--steps", 50, "--listen", "tcp/127.0.0.1:0") as coordinator:
        address = line_with(coordinator, "listening at").split()[-1]
        there = [started("node", pair_path, "--node", name, "--connect", address) for name in names]
        with there[0] as a, there[1] as b, started("plant", pair_path, "--connect", address) as plant:
            for _ in range(len(names) + 1):
                line_with(coordinator, "is there")
            with started("recorder", pair_path, "-o", recording, "--connect", address) as recorder:
                for process in (coordinator, a, b, plant, recorder):
                    assert process.wait(PATIENCE) == 0
    assert replay(recording).exit_code == 0


def test_other_gains_are_refused(pair_path: Path, tmp_path: Path, pair: Gains) -> None:
    """A node that runs on other gains than the coordinator is named, and nothing starts."""
    other = tmp_path / "other.json"
    pair.model_copy(update={"method": "other"}).save(other)
    names = pair.problem.node_names
    with started("coordinator", pair_path, "--listen", "tcp/127.0.0.1:0") as coordinator:
        address = line_with(coordinator, "listening at").split()[-1]
        files = {name: other if name == names[1] else pair_path for name in names}
        there = [started("node", files[name], "--node", name, "--connect", address) for name in names]
        recorder = started("recorder", pair_path, "-o", tmp_path / "run.mcap", "--connect", address)
        plant = started("plant", pair_path, "--connect", address)
        with there[0] as a, there[1] as b, plant as c, recorder as d:
            said = line_with(coordinator, "peakmesh: ")
            assert coordinator.wait(PATIENCE) == 2
            assert [line_with(process, "peakmesh: ") for process in (a, b, c, d)] == [said] * 4
            assert [process.wait(PATIENCE) for process in (a, b, c, d)] == [3] * 4
    assert f'node "{names[1]}" runs on other gains' in said
    assert not (tmp_path / "run.mcap").exists()


def test_port_in_use(lone_path: Path) -> None:
    """A port that is taken: exit 2, the address and the cause."""
    with started("coordinator", lone_path, "--listen", "tcp/127.0.0.1:0") as first:
        address = line_with(first, "listening at").split()[-1]
        second = peakmesh("coordinator", lone_path, "--listen", address)
    assert second.returncode == 2
    assert second.stderr == f"peakmesh: cannot listen on {address}: the port is in use; port 0 takes a free one\n"


def test_nobody_listens(pair_path: Path, pair: Gains) -> None:
    """A seed address where nobody is: exit 3, the address, and how long was waited."""
    name = pair.problem.node_names[0]
    done = peakmesh("node", pair_path, "--node", name, "--connect", "tcp/127.0.0.1:1", "--wait", "0.5")
    assert done.returncode == 3
    assert done.stderr.endswith(
        f'peakmesh: nobody of run "{pair.problem.name}" answered at tcp/127.0.0.1:1 within 0.5 s; '
        "is the coordinator running there, under the same --run?\n"
    )


def test_missing_participants_are_named(lone_path: Path) -> None:
    """A coordinator to whom nobody comes says who is missing: exit 3."""
    done = peakmesh("coordinator", lone_path, "--wait", "0.5")
    assert done.returncode == 3
    assert 'node "' in done.stderr
    assert "the plant and the recorder did not join the run within 0.5 s" in done.stderr


def test_unknown_node(pair_path: Path, pair: Gains) -> None:
    """An unknown node: exit 2, and the nodes that there are."""
    for arguments in (
        ("node", pair_path, "--node", "9", "--connect", "tcp/127.0.0.1:1"),
        ("run", pair_path, "--external", "9"),
    ):
        done = peakmesh(*arguments)
        assert done.returncode == 2
        assert 'peakmesh: node "9" does not exist; the problem has nodes' in done.stderr


def test_a_recorder_that_may_not_write_tells_the_others(lone_path: Path, tmp_path: Path) -> None:
    """Nobody waits for it: the coordinator says why there is no run."""
    recording = tmp_path / "run.mcap"
    recording.write_bytes(b"precious")
    with started("coordinator", lone_path, "--wait", PATIENCE) as coordinator:
        address = line_with(coordinator, "listening at").split()[-1]
        recorder = peakmesh("recorder", lone_path, "-o", recording, "--connect", address)
        said = line_with(coordinator, "peakmesh: ")
        assert (recorder.returncode, coordinator.wait(PATIENCE)) == (2, 3)
    why = f"{recording} exists already; give another name, or --force to replace it"
    assert recorder.stderr == f"peakmesh: {why}\n"
    assert said == f"peakmesh: the recorder left before the run had started; it said: {why}\n"
    assert recording.read_bytes() == b"precious"
