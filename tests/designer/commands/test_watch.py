"""`peakmesh watch` comes to a real run when it likes, shows what is recorded, and leaves as it likes."""

from __future__ import annotations

import argparse
import json
import os
import pty
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from subprocess import Popen
from typing import Any, NoReturn

import numpy as np
import pytest
from here import here
from places import GOLDEN
from roles import Roles
from runs import MANY, PATIENCE, answer, decoded, end_of, line_with, logged, program, run_here, started

from agent.authority import Authority
from agent.contract.errors import Interrupted, RunBroken
from agent.contract.gains import Gains
from agent.contract.messages import Estimate, PlantState
from agent.contract.rights import everybody
from agent.network.arrivals import Arrival
from agent.network.words import Sample, Words
from agent.plan import Pace
from agent.signals import interrupted_through
from designer.commands.watch import _take_in, add_watch
from designer.replay import replay
from designer.watch.scene import Scene

GAINS = GOLDEN / "zhu2020-lossy.gains.json"
NAMES = Gains.load(GAINS).problem.node_names

State = dict[str, Any]


@pytest.fixture
def run(tmp_path: Path) -> Iterator[Roles]:
    """A paced run that goes on until the test ends it."""
    with ExitStack() as stack:
        plan = "--steps", MANY, "--period", "100ms"
        roles = Roles(stack, GAINS, tmp_path / "run.mcap", *plan, run="shown")
        roles.start()
        line_with(roles.coordinator, "the run starts")
        yield roles


def watch_of(run: Roles) -> tuple[object, ...]:
    """The command that watches it."""
    return "watch", "--connect", run.address, "--wait", PATIENCE


def until(process: Popen[str], holds: Callable[[State], bool]) -> Iterator[State]:
    """The states that are printed, up to the first of which it holds."""
    assert process.stdout is not None
    for line in process.stdout:
        state = json.loads(line)
        yield state
        if holds(state):
            return
    raise AssertionError(f"it ended before: {process.communicate()[1]}")


def is_complete(state: State) -> bool:
    return state["ledger"] is not None and all(node["step"] is not None for node in state["nodes"])


def node(state: State, name: str) -> State:
    (found,) = (node for node in state["nodes"] if node["name"] == name)
    return dict(found)


def test_it_watches_a_run_from_the_middle_and_leaves_without_harm(run: Roles, tmp_path: Path) -> None:
    words = watch_of(run)
    with started(*words, "--json") as watch, started(*words) as log:
        states = list(until(watch, is_complete))
        run.nodes[1].kill()
        states += until(watch, lambda state: "node-2" in state["gone"])
        last = node(states[-1], "2")["step"]
        run.node("2")
        states += until(watch, lambda state: node(state, "2")["there"] and node(state, "2")["step"] > last)
        once = answer(here(*words, GAINS, "--once", "--json"))
        assert (once["run"], once["ended"]) == ("shown", None)
        other = tmp_path / "other.json"
        document = Gains.load(GAINS).document()
        document["solver"]["seconds"] += 1.0
        Gains.from_document(document).save(other)
        refused = here(*words, other)
        assert refused.returncode == 2
        assert 'run "shown" has other gains' in refused.stderr
        watch.send_signal(signal.SIGINT)
        assert watch.wait(PATIENCE) == 130
        watched_to_its_end(run, log)
    assert replay(run.recording).agrees
    what_was_shown_is_what_was_recorded(run.recording, [*states, once])


def test_it_watches_a_run_with_keys(tmp_path: Path) -> None:
    """Its certificate lets it see all of the run, which nobody without one sees anything of."""
    keys, problem = tmp_path / "keys", Gains.load(GAINS).problem
    keys.mkdir()
    Authority.create(keys, problem.name, days=1).issue(everybody(problem), days=1)
    with ExitStack() as stack:
        plan = "--steps", MANY, "--period", "100ms"
        run = Roles(stack, GAINS, tmp_path / "run.mcap", *plan, run="shown", keys=keys)
        run.start()
        line_with(run.coordinator, "the run starts")
        with started(*watch_of(run), *run.keys, "--json") as watch:
            states = list(until(watch, is_complete))
        assert states[-1]["run"] == "shown"
        assert not states[-1]["gone"]
        stranger = here("watch", "--connect", run.address, "--wait", "3", "--once")
        assert stranger.returncode != 0
        assert run.coordinator.poll() is None


def watched_to_its_end(run: Roles, log: Popen[str]) -> None:
    """The run is stopped, and whoever still watches it says so and leaves; nothing of it is missing."""
    close_a_terminal_on(run)
    assert run.coordinator.poll() is None
    run.coordinator.send_signal(signal.SIGINT)
    assert run.coordinator.wait(PATIENCE) == 130
    said, _ = log.communicate(timeout=PATIENCE)
    assert all(line.startswith(("step ", "  step ")) for line in said.splitlines())
    run.recorder.wait(PATIENCE)
    end = end_of(run.recording)
    assert end is not None
    assert {value for name, value in end.items() if name.startswith("missing.")} == {"0"}


def close_a_terminal_on(run: Roles) -> None:
    """A watch in a terminal of its own that is closed once it shows the nodes: it ends."""
    pid, terminal = pty.fork()
    if pid == 0:
        os.environ |= {"TERM": "xterm", "COLUMNS": "120", "LINES": "40"}
        os.execv(program()[0], program(*watch_of(run)))
    shown = b""
    while b"innovation" not in shown:
        shown += os.read(terminal, 4096)
    os.close(terminal)
    _, status = os.waitpid(pid, 0)
    assert status  # it was told, or killed


def what_was_shown_is_what_was_recorded(recording: Path, states: list[State]) -> None:
    """Innovations, who was heard, and errors, number by number; what node 2 sent last may have gone here alone."""
    messages = [(message.topic, decoded(message)) for message in logged(recording)]
    z = {said.step: said.z for _, said in messages if isinstance(said, PlantState)}
    made = {(topic.split("/")[1], said.step): said for topic, said in messages if isinstance(said, Estimate)}
    compared = 0
    for state in states:
        for seen in state["nodes"]:
            said = made.get((seen["name"], seen["step"]))
            if said is None:
                assert seen["step"] is None or seen["name"] == "2"
                continue
            assert (seen["heard"], seen["measured"]) == (said.heard, said.measured)
            assert seen["innovation"] == pytest.approx(float(np.linalg.norm(said.innovation)), rel=1e-12)
            if (k := seen["error_step"]) is not None:
                error = float(np.linalg.norm(np.subtract(z[k], made[seen["name"], k].z_hat)))
                assert seen["error"] == pytest.approx(error, rel=1e-12)
                compared += 1
    assert compared >= len(NAMES)


@pytest.mark.usefixtures("ctrl_c")
def test_of_a_run_on_one_machine_everybody_is_seen(tmp_path: Path) -> None:
    """Nobody knows their sockets but by gossip."""
    addresses, states = list[str](), list[State]()

    def heed(word: State) -> None:
        addresses.extend(word.get("listening", []))

    def look() -> None:
        with started("watch", "--connect", addresses[0], "--wait", PATIENCE, "--json") as watch:
            states.extend(until(watch, is_complete))
        os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(Interrupted):
        run_here(GAINS, tmp_path / "run.mcap", at=5, do=look, heed=heed, pace=Pace(0.1))
    assert [node["name"] for node in states[-1]["nodes"] if node["there"]] == list(NAMES)
    assert all(node["error"] is not None for node in states[-1]["nodes"])
    assert replay(tmp_path / "run.mcap").agrees


class Silent:
    """Somebody who looks on, and hears one message."""

    facts, present = None, frozenset[str]()

    def __init__(self, topic: str, payload: bytes) -> None:
        self._arrival = Arrival(Sample(topic, payload, None), 0.0)

    def until(self, deadline: float) -> Iterator[Arrival]:
        yield self._arrival

    def heed(self) -> None:
        return


@pytest.mark.parametrize("topic", ["mode", "nonsense", "event"])
def test_what_is_no_message_is_counted_and_stops_nothing(topic: str) -> None:
    scene = Scene("a-run")
    _take_in(Silent(topic, b"nonsense"), scene, 0.0, "")  # type: ignore[arg-type]
    assert scene.seen().unreadable == 1


@pytest.mark.usefixtures("ctrl_c")
def test_a_signal_that_comes_while_a_message_is_read_is_heeded(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is not taken for what is wrong with the message, and the message is read to its end."""
    words, scene = Words(""), Scene("a-run")

    class Looking(Silent):
        def heed(self) -> None:
            words.take(time.monotonic())

    def signalled(topic: str, payload: bytes) -> NoReturn:
        signal.raise_signal(signal.SIGINT)
        raise RunBroken("it is no message")

    monkeypatch.setattr("agent.contract.keys.decode", signalled)
    with interrupted_through(words.put), pytest.raises(Interrupted):
        _take_in(Looking("mode", b"{}"), scene, 0.0, "")  # type: ignore[arg-type]
    assert scene.seen().unreadable == 1


def test_its_options_may_stand_in_the_environment() -> None:
    parser = argparse.ArgumentParser()
    variables = {"PEAKMESH_RUN": "hall-7", "PEAKMESH_CONNECT": "tcp/a:1 tcp/b:2", "PEAKMESH_ONCE": "1"}
    add_watch(parser.add_subparsers(), variables)
    options = parser.parse_args(["watch", "--run", "hall-8"])
    assert (options.run, options.connect, options.once) == ("hall-8", ["tcp/a:1", "tcp/b:2"], True)


@pytest.mark.parametrize("words", [["--run", "a/b"], ["--connect", "7447"], []])
def test_bad_usage_is_refused(words: list[str]) -> None:
    done = here("watch", *(words if "--connect" in words or not words else [*words, "--connect", "tcp/127.0.0.1:1"]))
    assert (done.returncode, done.stdout) == (2, "")
