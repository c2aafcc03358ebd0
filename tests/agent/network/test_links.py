"""Links of a run on one machine: as data, and what they carry."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from made_recordings import random_problem
from networks import random_problem as dense_problem
from places import ROOT
from runs import PATIENCE

from agent.contract.keys import COORDINATOR, PLANT, RECORDER, node_who, participants
from agent.contract.messages import Control
from agent.contract.problem import Problem
from agent.network.bus import Bus
from agent.network.configuration import Network, zenoh_configuration
from agent.network.links import Sockets, linked, sockets
from agent.network.words import RunClosed
from benchmarks.replay import ring

HUBS = {COORDINATOR, PLANT, RECORDER}
PROBLEMS = [ring(9).problem, dense_problem(4, n=6, modes=3), random_problem(3, ny=(1, 1, 1, 1), modes=2)]


@pytest.mark.parametrize("problem", PROBLEMS)
def test_links_are_where_messages_flow(problem: Problem) -> None:
    """The hubs deal with everybody, two nodes with each other where one hears the other in some mode."""
    everybody = set(participants(problem))
    for hub in HUBS:
        assert linked(problem, hub) == everybody - {hub}
    for i, name in enumerate(problem.node_names):
        near = {
            node_who(other)
            for j, other in enumerate(problem.node_names)
            if i != j and (j in problem.ever_heard(i) or i in problem.ever_heard(j))
        }
        assert linked(problem, node_who(name)) == HUBS | near


def test_links_grow_with_neighbours_and_not_with_nodes() -> None:
    for n in (9, 40):
        problem = ring(n).problem
        assert {len(linked(problem, node_who(name))) for name in problem.node_names} == {3 + 4}


@pytest.mark.parametrize("problem", PROBLEMS)
def test_of_two_that_deal_with_each_other_one_connects(problem: Problem) -> None:
    """One of them, not both; nobody connects to anybody else, and everybody listens at an address of their own."""
    places = {who: sockets(problem, who, Path("/run/x")) for who in participants(problem)}
    owners = {place.listen: who for who, place in places.items()}
    assert len(owners) == len(places)
    made = [frozenset((who, owners[address])) for who, place in places.items() for address in place.connect]
    wanted = {frozenset((who, other)) for who in places for other in linked(problem, who)}
    assert len(made) == len(set(made))
    assert set(made) == wanted


def drain(bus: Bus) -> None:
    while bus.receive(timeout=PATIENCE) is not None:
        pass


def test_peers_pass_on_neither_tokens_nor_words(tmp_path: Path) -> None:
    """What the start barrier relies on: a token is seen over the link to whoever shows it, or not at all.

    The plant is linked with the coordinator, and that with the recorder. What passed through the coordinator would have
    come to the plant before the coordinator's own word.
    """
    addresses = {who: f"unixsock-stream/{tmp_path / who}" for who in HUBS}

    def place(who: str, *others: str) -> Network:
        return Network("", (), PATIENCE, sockets=Sockets(addresses[who], tuple(addresses[other] for other in others)))

    with (
        Bus(place(COORDINATOR), run="test", who=COORDINATOR) as coordinator,
        Bus(place(PLANT, COORDINATOR), run="test", who=PLANT) as plant,
        Bus(place(RECORDER, COORDINATOR), run="test", who=RECORDER) as recorder,
    ):
        for bus in (coordinator, plant):
            bus.enter()
        list(plant.meet([COORDINATOR]))
        list(coordinator.meet([PLANT]))
        recorder.enter()
        list(coordinator.meet([RECORDER]))
        assert RECORDER in coordinator.present
        coordinator.order(Control(order="stop", steps=1, seed=0, window=1, external=[], reason="enough"))
        with pytest.raises(RunClosed, match="enough"):
            drain(plant)
        assert plant.present == {COORDINATOR, PLANT}


def test_strangers_find_everybody(tmp_path: Path) -> None:
    """A sensor, a viewer, a second process of a name: whoever connects to the coordinator gets links with the others.

    It does where its id is greater than theirs, which zenoh draws.
    """
    hub, other = (f"unixsock-stream/{tmp_path / who}" for who in (COORDINATOR, PLANT))
    inside = Network("", (), PATIENCE, sockets=Sockets(other, (hub,)))
    least = int(zenoh_configuration(inside, run="test")["id"], 16)
    assert max(least.to_bytes(16, order)[:4] for order in ("little", "big")) == bytes(4)
    with (
        Bus(Network(wait=PATIENCE, sockets=Sockets(hub, ())), run="test", who=COORDINATOR) as coordinator,
        Bus(inside, run="test", who=PLANT) as plant,
    ):
        plant.enter()
        (address,) = coordinator.locators()
        with Bus(Network(connect=(address,), wait=PATIENCE), run="test", who=RECORDER) as stranger:
            stranger.enter()
            assert list(stranger.meet([PLANT])) == [PLANT]
            assert list(plant.meet([RECORDER])) == [RECORDER]


THREADS = """
import sys, time
from pathlib import Path
from agent.network.bus import Bus
from agent.network.configuration import Network
with Bus(Network(routes=sys.argv[1] == "router"), run="test", who=sys.argv[1]):
    pools = set()
    while not pools:  # a new thread has no name yet
        names = [(task / "comm").read_text().strip() for task in Path("/proc/self/task").iterdir()]
        pools = {name.partition("-")[0] for name in names if "-" in name}
        time.sleep(0.01)
print(*pools)
"""


@pytest.mark.parametrize(("who", "one"), [("plant", True), ("coordinator", False), ("router", False)])
def test_who_passes_nothing_on_has_one_pool_of_threads(who: str, one: bool) -> None:
    """Zenoh reads the variable that asks for it once; a version that no longer does makes this fail."""
    done = subprocess.run(
        [sys.executable, "-c", THREADS, who], cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE, check=True
    )
    assert (done.stdout.split() == ["rx"]) == one, done.stdout
