"""Runs across hosts: real stacks on a switch, real processes; skipped where network namespaces are not permitted."""

from __future__ import annotations

import contextlib
import re
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from hosts import Hosts
from places import GOLDEN
from runs import PATIENCE, decoded, line_with, logged, started

from agent.authority import Authority
from agent.contract.errors import InputError
from agent.contract.gains import Gains
from agent.contract.keys import ACCOUNT
from agent.contract.messages import Event
from agent.contract.recording.parts import unfinished
from agent.contract.rights import everybody
from designer.replay import replay

SEED = ("--connect", "tcp/10.77.0.1:7447")  # the coordinator, on host 1
ANYWHERE = ("--insecure", "--listen", "tcp/0.0.0.0:0")
LISTEN = ("--insecure", "--listen", "tcp/0.0.0.0:7447")
Words = tuple[object, ...]
Role = tuple[int, list[object]]  # on which host, and its command line


@pytest.fixture(scope="module")
def three() -> Iterator[Hosts]:
    with Hosts(3) as hosts:
        yield hosts


def go(
    hosts: Hosts, roles: dict[str, Role], stack: ExitStack, *, clocks: tuple[float, ...] = (0.0,) * 3
) -> list[subprocess.Popen[str]]:
    """All of them, each a process on its host; `clocks` are by how much those of the hosts are ahead."""
    return [stack.enter_context(hosts.started(host, *words, clock=clocks[host - 1])) for host, words in roles.values()]


def all_well(processes: list[subprocess.Popen[str]]) -> bool:
    """Whether each ends with 0; what they say is shown where not."""
    found = ends(processes)
    assert {code for code, _ in found} == {0}, found
    return True


def ends(processes: list[subprocess.Popen[str]]) -> list[tuple[int, str]]:
    """The exit code of each, and the last line that it said."""
    found = []
    for process in processes:
        code = process.wait(PATIENCE)
        assert process.stderr is not None
        found.append((code, (process.stderr.read().splitlines() or [""])[-1]))
    return found


def test_the_lossy_example_across_three_hosts(three: Hosts, tmp_path: Path) -> None:
    """Over IPv6, with clocks that are minutes apart: everything arrives, and the replay agrees."""
    file, recording = GOLDEN / "zhu2020-lossy.gains.json", tmp_path / "run.mcap"
    gains = Gains.load(file)
    network = ["--connect", "tcp/[fd77::1]:7447", "--insecure", "--listen", "tcp/[::]:0"]
    roles: dict[str, Role] = {
        "coordinator": (1, ["coordinator", file, "--insecure", "--listen", "tcp/[::]:7447", "--steps", 60]),
        "recorder": (1, ["recorder", file, "-o", recording, *network]),
        "plant": (3, ["plant", file, *network]),
    }
    for name in gains.problem.node_names:
        roles[name] = (2 if name in "12" else 3, ["node", file, "--node", name, *network])
    with ExitStack() as stack:
        assert all_well(go(three, roles, stack, clocks=(-1800.0, 0.0, 900.0)))
    verdict = replay(recording)
    assert verdict.exit_code == 0, verdict.text()
    assert (verdict.steps, verdict.missing.total) == (60, 0)
    times = {message.topic: message.publish_time for message in logged(recording)}
    assert times["plant/state"] - times["mode"] > 2600e9  # the clocks were apart


def with_pair(
    file: Path, pair: Gains, recording: Path, network: list[object], *, plan: list[object], listen: Words = LISTEN
) -> dict[str, Role]:
    """Coordinator and recorder on host 1 with the plant, a node on host 2 and one on host 3."""
    first, second = pair.problem.node_names
    return {
        "coordinator": (1, ["coordinator", file, *listen, *plan]),
        "recorder": (1, ["recorder", file, "-o", recording, *network]),
        "plant": (1, ["plant", file, *network]),
        "first": (2, ["node", file, "--node", first, *network]),
        "second": (3, ["node", file, "--node", second, *network]),
    }


def wait_for_accounts(part: Path, count: int) -> None:
    """Until so many nodes have told how it goes, soon after the beginning; what is late then speaks of haste."""
    deadline, told = time.monotonic() + PATIENCE, 0
    while told < count:
        assert time.monotonic() < deadline
        time.sleep(0.1)
        with contextlib.suppress(InputError):  # there is no head of the file yet
            told = sum(message.topic == ACCOUNT for message in logged(part))


def test_a_cable_is_pulled_and_put_back(three: Hosts, pair_path: Path, pair: Gains, tmp_path: Path) -> None:
    """For five seconds, against the clock, with keys: the others go on, and who was cut off is there again."""
    recording, steps, keys = tmp_path / "run.mcap", 160, tmp_path / "keys"
    keys.mkdir()
    Authority.create(keys, pair.problem.name, days=1).issue(everybody(pair.problem), days=1)
    plan = ["--steps", steps, "--period", "100ms", "--seed", 3]
    network = ["--keys", keys, "--connect", "tls/10.77.0.1:7447", "--listen", "tls/0.0.0.0:0"]
    listen = ("--keys", keys, "--listen", "tls/0.0.0.0:7447")
    roles = with_pair(pair_path, pair, recording, network, plan=plan, listen=listen)
    with ExitStack() as stack:
        processes = go(three, roles, stack)
        line_with(processes[0], "the run starts")
        wait_for_accounts(unfinished(recording), 2)
        three.pull(3)
        threading.Event().wait(5.0)
        three.plug(3)
        assert all_well(processes)
    verdict = replay(recording)
    assert verdict.exit_code == 0, verdict.text()
    first, second = (f"node/{name}/estimate" for name in pair.problem.node_names)
    there, late = {first: [], second: []}, set[int]()
    for message in logged(recording):
        document = decoded(message)
        if message.topic in there:
            there[message.topic].append(document.step)
        elif isinstance(document, Event) and document.about == second:
            late.update(document.steps)
    assert sorted(there[first]) == list(range(steps))  # it went on,
    assert late  # without what it should have heard
    assert max(there[second]) == steps - 1


def test_hosts_that_cannot_reach_one_another_find_the_coordinator_by_multicast(
    three: Hosts, lone_path: Path, tmp_path: Path
) -> None:
    """Nobody knows an address; behind a firewall a plant is a client, and nothing is lost."""
    recording, node = tmp_path / "run.mcap", Gains.load(lone_path).problem.node_names[0]
    found = ["--connect", "multicast"]
    roles: dict[str, Role] = {
        "coordinator": (
            1,
            ["coordinator", lone_path, "--insecure", "--listen", "tcp/0.0.0.0:0", "--steps", 60, *found],
        ),
        "recorder": (1, ["recorder", lone_path, "-o", recording, *ANYWHERE, *found]),
        "node": (2, ["node", lone_path, "--node", node, *ANYWHERE, *found]),
        "plant": (3, ["plant", lone_path, "--listen", "none", *found]),
    }
    with three.parted(2, 3), ExitStack() as stack:
        assert all_well(go(three, roles, stack))
    verdict = replay(recording)
    assert (verdict.exit_code, verdict.steps, verdict.missing.total) == (0, 60, 0), verdict.text()


def test_who_forgot_to_listen_for_others_is_named(three: Hosts, pair_path: Path, pair: Gains, tmp_path: Path) -> None:
    """By everybody, with where each of two listens and what would be right; nobody waits for the end of the wait."""
    roles = with_pair(pair_path, pair, tmp_path / "run.mcap", network=[*SEED], plan=["--wait", PATIENCE])
    with ExitStack() as stack:
        (code, said), *others = ends(go(three, roles, stack))
    assert (code, [other for other, _ in others]) == (2, [3] * 4)
    assert {sentence for _, sentence in others} == {said}
    names = r'(the plant|the recorder|node "\w+")'
    assert re.fullmatch(
        rf"peakmesh: {names} and {names} have reached the coordinator, but have no link between them: {names} listens "
        rf"at tcp/127\.0\.0\.1:0, {names} at tcp/127\.0\.0\.1:0; each must listen where the other can connect to, such "
        r"as --listen tcp/0\.0\.0\.0:0, or one take part through the coordinator, --listen none",
        said,
    )


@pytest.mark.parametrize("through", ["router", "coordinator"])
def test_whoever_clients_are_connected_to_passes_everything_on(lone_path: Path, tmp_path: Path, through: str) -> None:
    """The router, of which the coordinator is a client too, or the coordinator; nothing is lost."""
    recording, node = tmp_path / "run.mcap", Gains.load(lone_path).problem.node_names[0]
    coordinator: list[object] = ["coordinator", lone_path, "--steps", 200]
    with ExitStack() as stack:
        hub = ["router"] if through == "router" else coordinator
        first = stack.enter_context(started(*hub, "--listen", "tcp/127.0.0.1:0"))
        place = ["--listen", "none", "--connect", line_with(first, "listening at").split()[-1]]
        roles: list[list[object]] = [
            ["recorder", lone_path, "-o", recording],
            ["node", lone_path, "--node", node],
            ["plant", lone_path],
            *([coordinator] if through == "router" else []),
        ]
        processes = [stack.enter_context(started(*words, *place)) for words in roles]
        assert all_well(processes)
        if through == "router":
            first.terminate()  # its good end
        assert first.wait(PATIENCE) == 0
    verdict = replay(recording)
    assert (verdict.exit_code, verdict.steps, verdict.missing.total) == (0, 200, 0), verdict.text()
