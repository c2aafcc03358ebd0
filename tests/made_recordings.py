"""Recordings for tests: networks, gains and runs made here, node by node and link by link from eqs. (1)-(5)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from agent.contract import messages, schedule
from agent.contract.files import canonical
from agent.contract.gains import Certificate, Gains, LinkMatrices, Solver
from agent.contract.problem import Problem
from agent.contract.recording import Logged, RecordingWriter


class Sent(NamedTuple):
    """A message as it is sent: `document` is its payload."""

    topic: str
    who: str
    number: int
    document: dict[str, Any]


def random_problem(
    seed: int, *, ny: Sequence[int] = (1, 2, 1, 1), modes: int = 3, nx: int = 2, nw: int = 2, nz: int = 1
) -> Problem:
    """A stable plant, nodes with `ny` measurements each, weights that differ, losses at every second node."""
    rng, n = np.random.default_rng(seed), len(ny)
    A = rng.normal(size=(nx, nx))
    A *= 0.85 / np.abs(np.linalg.eigvals(A)).max()
    topologies = []
    for s in range(modes):
        weights = np.where(rng.random((n, n)) < 0.4, rng.uniform(0.5, 1.5, (n, n)).round(2), 0.0)
        np.fill_diagonal(weights, 1.0)
        topologies.append({"name": f"mode-{s}", "adjacency": weights.tolist()})
    transition = rng.dirichlet(np.ones(modes), size=modes)
    return Problem.from_document(
        {
            "name": f"random-{seed}",
            "plant": {
                "A": A.tolist(),
                "B": rng.normal(size=(nx, nw)).tolist(),
                "M": rng.normal(size=(nz, nx)).tolist(),
            },
            "node": [
                {
                    "name": f"n{i}",
                    "C": rng.normal(size=(ny_i, nx)).tolist(),
                    "D": rng.normal(size=(ny_i, nw)).tolist(),
                    "arrival_probability": 0.8 if i % 2 else 1.0,
                }
                for i, ny_i in enumerate(ny)
            ],
            "topology": topologies,
            "markov": {"transition": transition.tolist(), "initial": f"mode-{modes - 1}"},
            "disturbance": {"kind": "white", "deviation": 1.0},
        }
    )


def random_gains(problem: Problem, seed: int = 0) -> Gains:
    """Small gains, so that the errors stay bounded; they are good for nothing else."""
    rng = np.random.default_rng(seed)
    K: LinkMatrices = {}
    H: LinkMatrices = {}
    for s, mode in enumerate(problem.mode_names):
        K[mode], H[mode] = {}, {}
        for i, receiver in enumerate(problem.node_names):
            heard = problem.neighbours(s, i)
            size = 0.5 / len(heard)
            names = [problem.node_names[j] for j in heard]
            K[mode][receiver] = {name: rng.uniform(-size, size, (problem.nx, problem.nx)) for name in names}
            H[mode][receiver] = {
                name: rng.uniform(-size, size, (problem.nx, len(problem.nodes[j].C)))
                for name, j in zip(names, heard, strict=True)
            }
    return Gains(
        problem=problem,
        problem_digest=problem.digest(),
        method="random",
        K=K,
        H=H,
        certificate=Certificate(gamma=1.0, kind="lyapunov", form="full", holds=False, verified="nothing", margins={}),
        solver=Solver(name="none", version="0", status="none", iterations=0, seconds=0.0),
        seconds={"total": 0.0},
    )


def simulate(
    gains: Gains,
    *,
    steps: int,
    seed: int = 1,
    real_y: dict[str, Any] | None = None,
    nudge: tuple[int, str, float] | None = None,
) -> list[Sent]:
    """Every message of a lock-step run.

    `real_y` maps a node to (steps, ny) numbers from a real sensor; `nudge` moves one node's estimate at one step,
    and the run goes on from there.
    """
    problem, real = gains.problem, real_y or {}
    A, B, M = problem.plant.A, problem.plant.B, problem.plant.M
    chain, losses = schedule.modes(problem, seed=seed), schedule.Losses(problem, seed=seed)
    source, sent = schedule.DisturbanceSource(problem, seed=seed), _Numbered()
    x, mode = np.zeros(problem.nx), ""
    x_hat = {name: np.zeros(problem.nx) for name in problem.node_names}
    heard: dict[str, list[str]] = {name: [] for name in problem.node_names}
    sent.add("event", messages.COORDINATOR, step=0, kind="start", who="coordinator", detail="")
    for k in range(steps):
        w, theta = source.at(k), losses.at(k)
        if nudge is not None and nudge[0] == k:
            x_hat[nudge[1]] = x_hat[nudge[1]] + nudge[2]
        arrived = [int(arrives) for arrives in theta]
        sent.add("plant/state", messages.PLANT, step=k, x=x, z=M @ x, w=w, arrived=arrived)
        innovation = {}
        for node, theta_i in zip(problem.nodes, theta, strict=True):
            y = theta_i * (node.C @ x) + node.D @ w
            who = messages.PLANT
            if node.name in real:
                y, who = real[node.name][k], messages.sensor_who(node.name)
            sent.add(messages.measurement(node.name), who, step=k, y=y)
            x_hat_i = x_hat[node.name]
            innovation[node.name] = y - node.arrival_probability * node.C @ x_hat_i
            sent.add(
                messages.estimate(node.name),
                messages.node_who(node.name),
                step=k,
                x_hat=x_hat_i,
                innovation=innovation[node.name],
                z_hat=M @ x_hat_i,
                mode=mode,
                heard=heard[node.name],
            )
        s = next(chain)
        mode = problem.mode_names[s]
        sent.add("mode", messages.COORDINATOR, step=k, mode=mode)
        before, x = x_hat, A @ x + B @ w
        x_hat = {}
        for i, name in enumerate(problem.node_names):
            heard[name] = [problem.node_names[j] for j in problem.neighbours(s, i)]
            a, K, H = problem.topologies[s].adjacency[i], gains.K[mode][name], gains.H[mode][name]
            x_hat[name] = sum(
                (a[problem.node_index(j)] * (K[j] @ before[j] + H[j] @ innovation[j]) for j in heard[name]),
                start=np.zeros(problem.nx),
            )
    sent.add("event", messages.COORDINATOR, step=max(steps - 1, 0), kind="end", who="coordinator", detail="")
    return sent.messages


class _Numbered:
    """Messages, each with its number among its sender's."""

    def __init__(self) -> None:
        self.messages: list[Sent] = []
        self._sent: Counter[str] = Counter()

    def add(self, topic: str, sender: str, /, **document: Any) -> None:
        plain = {key: value.tolist() if isinstance(value, np.ndarray) else value for key, value in document.items()}
        self.messages.append(Sent(topic, sender, self._sent[sender], plain))
        self._sent[sender] += 1


def record(
    path: Path,
    gains: Gains,
    sent: Sequence[Sent],
    /,
    *,
    steps: int,
    seed: int = 1,
    whole: bool = True,
    status: str = "finished",
    end_steps: int | None = None,
    **facts: str,
) -> Path:
    """Write the messages in the order given; returns where they are: `path`, or its .part where not `whole`."""
    run = {"run": "test", "seed": str(seed), "steps": str(steps), "gains": gains.digest(), "external": "", **facts}
    with RecordingWriter(path, run=run, gains=gains) as writer:
        for time, message in enumerate(sent):
            payload = canonical(message.document)
            writer.add(Logged(message.topic, payload, message.number, time, time))
        if whole:
            writer.finish({"status": status, "reason": "", "steps": str(steps if end_steps is None else end_steps)})
    return path if whole else path.with_name(path.name + ".part")
