"""What the machine allows: the same run over raw AF_UNIX sockets.

The same processes, the same messages to the same receivers, the same arithmetic and the same JSON as `peakmesh run`,
over SOCK_SEQPACKET socket pairs with one epoll loop in each process: no middleware, no discovery, no threads. The
recorder counts, and writes nothing.

* strict: mode k, then the measurements of step k, then the estimates; mode k + 1 when the coordinator has heard the
  estimates of all nodes;
* windowed: the recorder acknowledges, and modes and measurements run up to W steps ahead of that, as in peakmesh.
"""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import select
import socket
import time
from collections import deque
from collections.abc import Iterable
from multiprocessing.connection import Connection

import numpy as np

from agent.contract import schedule
from agent.contract.gains import Gains
from agent.contract.keys import COORDINATOR, PLANT, RECORDER, node_who, participants
from agent.contract.messages import Estimate, Measurement, Mode
from agent.filter import innovation, step
from agent.inbox import Inbox
from agent.roles.plant import SimulatedPlant

TIME_LIMIT = 120.0


class Peers:
    """The sockets of one process, by the name of the process at the other end."""

    def __init__(self, sockets: dict[str, socket.socket]) -> None:
        self._sockets = sockets
        self._names = {each.fileno(): name for name, each in sockets.items()}
        self._received: dict[str, deque[bytes]] = {name: deque() for name in sockets}
        self._poll = select.epoll()
        for descriptor in self._names:
            self._poll.register(descriptor, select.EPOLLIN)

    def send(self, message: bytes, receivers: Iterable[str]) -> None:
        for name in receivers:
            self._sockets[name].send(message)

    def take(self, sender: str) -> bytes:
        """The next message of a sender, waiting for it if need be."""
        while not self._received[sender]:
            self.wait()
        return self._received[sender].popleft()

    def wait(self) -> list[str]:
        """Wait until something has come, take in one message of everybody who sent one, and say whose."""
        senders = [self._names[descriptor] for descriptor, _ in self._poll.poll(TIME_LIMIT)]
        for name in senders:
            self._received[name].append(self._sockets[name].recv(65536))
        return senders


def node(peers: Peers, gains: Gains, name: str, steps: int, window: int | None) -> str:
    """A sensor node; returns a digest of all its estimates."""
    problem, own = gains.problem, gains.for_node(name)
    i, inbox = problem.node_index(name), Inbox(own)
    heard_by = [problem.node_names[j] for j in range(problem.n) if i in problem.ever_heard(j) and j != i]
    receivers = [*map(node_who, heard_by), RECORDER, *([] if window else [COORDINATOR])]
    x_hat, made_by, digest = np.zeros(problem.nx), ("", list[str]()), hashlib.sha256()
    for k in range(steps):
        inbox.put(name, Measurement.decode(peers.take(PLANT)))
        assert inbox.y is not None
        sent = Estimate(
            step=k,
            x_hat=x_hat.tolist(),
            innovation=innovation(own, inbox.y, x_hat).tolist(),
            z_hat=(own.M @ x_hat).tolist(),
            mode=made_by[0],
            heard=made_by[1],
        )
        payload = sent.encode()
        peers.send(payload, receivers)
        digest.update(payload)
        inbox.put(name, sent)
        inbox.put("", Mode.decode(peers.take(COORDINATOR)))
        while (sender := inbox.lacking) is not None:
            inbox.put(sender, Estimate.decode(peers.take(node_who(sender))))
        assert inbox.mode is not None
        made_by = (inbox.mode, list(inbox.heard()))
        x_hat = step(own, inbox.mode, inbox.heard())
        inbox.next_step()
    return digest.hexdigest()


def plant(peers: Peers, gains: Gains, steps: int, seed: int) -> str:
    """Publishes the measurements of a step when it sees the mode of that step."""
    simulated = SimulatedPlant(gains.problem, seed=seed)
    for k in range(steps):
        peers.take(COORDINATOR)
        state, measurements = simulated.advance(k)
        for name, measurement in measurements.items():
            peers.send(measurement.encode(), (node_who(name), RECORDER))
        peers.send(state.encode(), (RECORDER,))
    return ""


def recorder(peers: Peers, gains: Gains, steps: int, window: int | None) -> str:
    """Takes in everything and, in the windowed order, acknowledges four times in a window."""
    nodes = [node_who(name) for name in gains.problem.node_names]
    expected = {COORDINATOR: 1, PLANT: len(nodes) + 1, **dict.fromkeys(nodes, 1)}
    received = dict.fromkeys(expected, 0)
    acknowledged = complete = 0
    while complete < steps:
        for sender in peers.wait():
            peers.take(sender)
            received[sender] += 1
        complete = min(received[sender] // count for sender, count in expected.items())
        if window and (complete - acknowledged >= max(1, window // 4) or complete == steps):
            peers.send(json.dumps({"steps": complete}).encode(), (COORDINATOR,))
            acknowledged = complete
    return ""


def coordinator(peers: Peers, gains: Gains, steps: int, seed: int, window: int | None) -> str:
    """Releases the modes; returns the rounds per second."""
    names, chain = gains.problem.mode_names, schedule.modes(gains.problem, seed=seed)
    nodes = [node_who(name) for name in gains.problem.node_names]
    released = complete = 0
    begun = time.perf_counter()
    while complete < steps:
        while released < min(steps, complete + (window or 1)):
            index = next(chain)
            peers.send(Mode(step=released, mode=names[index], index=index).encode(), (*nodes, PLANT, RECORDER))
            released += 1
        if window:
            complete = json.loads(peers.take(RECORDER))["steps"]
        else:
            complete = min(Estimate.decode(peers.take(who)).step for who in nodes) + 1
    return str(steps / (time.perf_counter() - begun))


def _process(
    who: str,
    gains: Gains,
    sockets: dict[str, socket.socket],
    steps: int,
    seed: int,
    window: int | None,
    result: Connection,
) -> None:
    peers = Peers(sockets)
    result.send("ready")
    result.recv()
    match who:
        case "coordinator":
            answer = coordinator(peers, gains, steps, seed, window)
        case "plant":
            answer = plant(peers, gains, steps, seed)
        case "recorder":
            answer = recorder(peers, gains, steps, window)
        case _:
            answer = node(peers, gains, who.removeprefix("node-"), steps, window)
    result.send(answer)
    result.recv()  # stay until everybody has finished


def run(gains: Gains, *, steps: int, seed: int, window: int | None = None) -> tuple[float, dict[str, str]]:
    """Rounds per second of one run, strict or windowed, and a digest of each node's estimates."""
    everybody = participants(gains.problem)
    sockets: dict[str, dict[str, socket.socket]] = {who: {} for who in everybody}
    for index, who in enumerate(everybody):
        for other in everybody[index + 1 :]:
            sockets[who][other], sockets[other][who] = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    context = multiprocessing.get_context("spawn")
    pipes, processes = {}, []
    try:
        for who in everybody:
            pipes[who], theirs = context.Pipe()
            process = context.Process(target=_process, args=(who, gains, sockets[who], steps, seed, window, theirs))
            process.start()
            processes.append(process)
        answers: dict[str, str] = {}
        for word in ("start", "stop"):
            for who in everybody:
                if not pipes[who].poll(TIME_LIMIT):
                    raise RuntimeError(f"{who} did not answer")
                answers[who] = pipes[who].recv()
            for who in everybody:
                pipes[who].send(word)
    finally:
        for process in processes:
            process.join(1.0)
            process.kill()
        for ends in sockets.values():
            for end in ends.values():
                end.close()
    nodes = {name: answers[node_who(name)] for name in gains.problem.node_names}
    return float(answers[COORDINATOR]), nodes
