"""A viewer shows a real run to a real client, which is not Foxglove's, and the run does not notice it."""

from __future__ import annotations

import json
import signal
import socket
import struct
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from subprocess import Popen
from typing import Any

import pytest
from here import here
from places import GOLDEN
from roles import Roles
from runs import end_of, freeze, line_with, numbers_of, peakmesh, started, thaw
from websockets import Subprotocol
from websockets.sync.client import ClientConnection, connect

from agent.contract.gains import Gains
from agent.contract.keys import model_of
from designer.replay import replay

GAINS = GOLDEN / "zhu2020-lossy.gains.json"
NAMES = Gains.load(GAINS).problem.node_names
PATIENCE = 60.0  # seconds that a client waits for a message
STEPS = 50


@contextmanager
def viewer(address: str, *words: object) -> Iterator[tuple[Popen[str], str]]:
    """A running viewer and where it serves."""
    with started("live", GAINS, "--connect", address, "--port", 0, *words) as process:
        yield process, line_with(process, "in Foxglove").split()[1]


class Client:
    """Speaks Foxglove's WebSocket protocol, and subscribes to every channel."""

    def __init__(self, socket: ClientConnection) -> None:
        self._socket = socket
        self.channels: dict[int, dict[str, Any]] = {}
        while len(self.channels) < 3 + 2 * len(NAMES):
            said = self._socket.recv(PATIENCE)
            assert isinstance(said, str)
            for channel in json.loads(said).get("channels", []):
                self.channels[channel["id"]] = channel
        wanted = [{"id": number, "channelId": number} for number in self.channels]
        self._socket.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))

    def messages(self) -> Iterator[tuple[str, bytes]]:
        """Topic and payload of each message, until the server goes."""
        for data in self._socket:
            if isinstance(data, bytes) and data[0] == 1:
                (number, _), payload = struct.unpack_from("<IQ", data, 1), data[13:]
                yield self.channels[number]["topic"], payload


@contextmanager
def client_of(url: str) -> Iterator[Client]:
    with connect(url, subprotocols=[Subprotocol("foxglove.sdk.v1")], close_timeout=0.1) as websocket:
        yield Client(websocket)


@pytest.fixture
def roles(tmp_path: Path) -> Iterator[Callable[[int], Roles]]:
    with ExitStack() as stack:
        yield lambda steps: Roles(stack, GAINS, tmp_path / "run.mcap", "--steps", steps)


def test_a_client_gets_every_message_of_a_run(roles: Callable[[int], Roles]) -> None:
    """z and every z_hat among them, bit for bit as they are recorded; the viewer ends with the run."""
    run = roles(STEPS)
    with viewer(run.address) as (process, url), client_of(url) as client:
        for channel in client.channels.values():
            model = model_of(channel["topic"])
            assert model is not None
            assert (channel["encoding"], channel["schemaEncoding"]) == ("json", "jsonschema")
            assert json.loads(channel["schema"]) == model.model_json_schema()
            assert channel["schemaName"] == f"peakmesh.{model.__name__}"
        run.start()
        messages = client.messages()
        received = {(topic, json.loads(said)["step"]): said for topic, said in messages if topic != "event"}
        assert run.coordinator.wait(PATIENCE) == 0
        assert process.wait(PATIENCE) == 0
    assert received == numbers_of(run.recording)
    assert len(received) == STEPS * (2 + 2 * len(NAMES))
    assert all("z" in json.loads(received["plant/state", k]) for k in range(STEPS))
    assert all("z_hat" in json.loads(received[f"node/{n}/estimate", k]) for k in range(STEPS) for n in NAMES)


def test_it_comes_late_and_is_killed_and_the_run_does_not_notice(roles: Callable[[int], Roles]) -> None:
    run = roles(1_000_000)
    run.start()
    line_with(run.coordinator, "the run starts")
    freeze(run.nodes[0].pid)  # so that the run waits while the viewer starts
    with viewer(run.address) as (process, url), client_of(url) as client:
        thaw(run.nodes[0].pid)
        lacking = {"mode", "plant/state", *(f"node/{name}/estimate" for name in NAMES)}
        for topic, _ in client.messages():
            lacking.discard(topic)
            if not lacking:
                break
        process.kill()
    run.coordinator.send_signal(signal.SIGINT)
    assert run.coordinator.wait(PATIENCE) == 130
    run.recorder.wait(PATIENCE)
    end = end_of(run.recording)
    assert end is not None
    assert end["status"] == "stopped"
    assert {value for name, value in end.items() if name.startswith("missing.")} == {"0"}
    assert replay(run.recording).agrees


def test_it_is_stopped_by_a_signal(roles: Callable[[int], Roles]) -> None:
    run = roles(STEPS)
    with viewer(run.address) as (process, _):
        process.send_signal(signal.SIGINT)
        assert process.wait(PATIENCE) == 130
    assert run.coordinator.poll() is None


def test_without_a_run_it_says_so() -> None:
    with socket.socket() as nobody:
        nobody.bind(("127.0.0.1", 0))
        address = f"tcp/127.0.0.1:{nobody.getsockname()[1]}"
        done = peakmesh("live", GAINS, "--connect", address, "--port", 0, "--wait", 0.2)
    assert done.returncode == 3
    assert 'peakmesh: the coordinator of run "zhu2020-lossy" was not found within 0.2 s' in done.stderr


def test_a_port_that_is_taken_is_named() -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        done = peakmesh("live", GAINS, "--connect", "tcp/127.0.0.1:1", "--port", port, "--wait", 5)
    assert (done.returncode, done.stdout) == (2, "")
    assert f"127.0.0.1:{port} cannot be listened on" in done.stderr
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize("words", [["--port", "70000"], ["--port", "x"], ["--run", "a/b"], ["--connect", "7447"], []])
def test_bad_usage_is_refused(words: list[str]) -> None:
    given = words if "--connect" in words or not words else [*words, "--connect", "tcp/127.0.0.1:1"]
    done = here("live", GAINS, *given)
    assert (done.returncode, done.stdout) == (2, "")
