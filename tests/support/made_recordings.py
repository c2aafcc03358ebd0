"""Recordings for tests: networks, gains and runs made here, node by node and link by link from eqs. (1)-(5).

Seen losses, lossy links and unbiased gains too. A run may hold misdeeds, for replay to find.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Container, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from agent.contract import keys, schedule
from agent.contract.files import canonical
from agent.contract.gains import Certificate, Gains, LinkMatrices, Solver
from agent.contract.messages import Evidence, Stamp, digest_of
from agent.contract.problem import Problem
from agent.contract.recording import Logged
from agent.contract.recording.evidence.chains import Chains
from agent.contract.recording.writer import RecordingWriter


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


def real_problem(
    seed: int, *, radius: float = 0.85, seen: bool = True, links: bool = True, unbiased: bool = True, **sizes: Any
) -> Problem:
    """`random_problem` with a plant of this spectral radius, and what real networks have beside it.

    Where losses are `seen`, all that lose measurements see it, and so does the last node, which may lose none. Where
    `links` lose messages, every second one does, and the first node's error counts less than others.
    """
    problem = random_problem(seed, **sizes)
    document = problem.document()
    document["plant"]["A"] = (problem.plant.A * (radius / 0.85)).tolist()
    names = problem.node_names
    heard = [(i, j) for i in range(problem.n) for j in problem.ever_heard(i) if i != j]
    if seen:
        for i, node in enumerate(document["node"]):
            node["loss"] = "seen" if i % 2 or i == problem.n - 1 else "hidden"
    if links:
        document["node"][0]["weight"] = 0.4
        document["link"] = [
            {"receiver": names[i], "sender": names[j], "delivery_probability": 0.6 + 0.1 * (number % 4)}
            for number, (i, j) in enumerate(heard[::2])
        ]
    document["unbiased"] = unbiased
    return Problem.from_document(document)


def observer_gains(problem: Problem) -> Gains:
    """Unbiased gains: each node is a Kalman predictor of what it hears, drawn towards the estimates of the others."""
    A, identity = problem.plant.A, np.eye(problem.nx)
    K: LinkMatrices = {}
    H: LinkMatrices = {}
    for s, topology in enumerate(problem.topologies):
        K[topology.name], H[topology.name] = {}, {}
        for i, receiver in enumerate(problem.node_names):
            heard, a = problem.neighbours(s, i), topology.adjacency[i]
            C = np.vstack([problem.nodes[j].C for j in heard])
            P = identity
            for _ in range(100):
                L = A @ P @ C.T @ np.linalg.inv(C @ P @ C.T + np.eye(len(C)))
                P = A @ P @ A.T + identity - L @ C @ P @ A.T
            others = {problem.node_names[j]: 0.3 * A / (len(heard) - 1) / a[j] for j in heard if j != i}
            weighted = [a[problem.node_index(name)] * block for name, block in others.items()]
            K[topology.name][receiver] = others | {receiver: (A - sum(weighted, start=0.0 * A)) / a[i]}
            columns = np.cumsum([0] + [len(problem.nodes[j].C) for j in heard])
            H[topology.name][receiver] = {
                problem.node_names[j]: L[:, first:end] / a[j]
                for j, first, end in zip(heard, columns[:-1], columns[1:], strict=True)
            }
    return uncertified(problem, K, H, method="observers")


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
    return uncertified(problem, K, H, method="random")


def uncertified(problem: Problem, K: LinkMatrices, H: LinkMatrices, *, method: str) -> Gains:
    """Gains of which nothing is proved."""
    return Gains.of(
        problem,
        K,
        H,
        method=method,
        certificate=Certificate(gamma=1.0, kind="lyapunov", form="full", holds=False, verified="nothing", margins={}),
        solver=Solver(name="none", version="0", status="none", iterations=0, seconds=0.0),
    )


def simulate(
    gains: Gains,
    *,
    steps: int,
    seed: int = 1,
    real_y: dict[str, Any] | None = None,
    nudge: tuple[int, str, float] | None = None,
    events: Sequence[tuple[int, str]] = (),
    uses: Mapping[tuple[int, str, str], bool] | None = None,
    says: Mapping[tuple[int, str, str], bool] | None = None,
    peeks: Container[tuple[int, str]] = (),
    forgets_itself: bool = False,
    misjudges_itself: Mapping[str, float] | None = None,
) -> list[Sent]:
    """Every message of a lock-step run.

    `real_y` maps a node to (steps, ny) numbers from a real sensor, [] where it has none; `nudge` moves one node's
    estimate at one step, and the run goes on from there. `events` are steps and kinds of events of the coordinator
    beside its first and last.

    Misdeeds: `uses` (step, receiver, sender) decides over a message in place of the seed, `says` what the receiver
    tells of it. At (step, node) of `peeks` a node uses the measurement that it lost. Where the gains are unbiased,
    a node that `forgets_itself` draws nothing from x_hat_j - x_hat_i, but takes x_hat_j; one that `misjudges_itself`
    has a K_ii that is off by that share.
    """
    problem, real = gains.problem, real_y or {}
    A, B, M = problem.plant.A, problem.plant.B, problem.plant.M
    chain, losses = schedule.modes(problem, seed=seed), schedule.Losses(problem, seed=seed)
    deliveries = schedule.Deliveries(problem, seed=seed)
    source, sent = schedule.DisturbanceSource(problem, seed=seed, worst_case=gains.worst_case), _Numbered()
    x, mode = problem.initial_error.copy(), ""
    x_hat = {name: np.zeros(problem.nx) for name in problem.node_names}
    heard: dict[str, list[str]] = {name: [] for name in problem.node_names}
    sent.add("event", keys.COORDINATOR, step=0, kind="start", who="coordinator", detail="")
    for k in range(steps):
        w, theta = source.at(k), losses.at(k)
        if nudge is not None and nudge[0] == k:
            x_hat[nudge[1]] = x_hat[nudge[1]] + nudge[2]
        arrived = [int(arrives) for arrives in theta]
        sent.add("plant/state", keys.PLANT, step=k, x=x, z=M @ x, w=w, arrived=arrived)
        innovation = {}
        for node, theta_i in zip(problem.nodes, theta, strict=True):
            y = theta_i * (node.C @ x) + node.D @ w
            who = keys.PLANT
            if node.seen and not theta_i:
                y = np.empty(0)
            if node.name in real:
                y, who = np.asarray(real[node.name][k]), keys.sensor_who(node.name)
            sent.add(keys.measurement(node.name), who, step=k, y=y)
            x_hat_i = x_hat[node.name]
            if (k, node.name) in peeks:
                assert not len(y), "nothing was lost"
                y = node.C @ x + node.D @ w
            if not node.seen:
                innovation[node.name] = y - node.arrival_probability * node.C @ x_hat_i
            else:
                innovation[node.name] = y - node.C @ x_hat_i if len(y) else np.zeros(len(node.C))
            sent.add(
                keys.estimate(node.name),
                keys.node_who(node.name),
                step=k,
                x_hat=x_hat_i,
                innovation=innovation[node.name],
                z_hat=M @ x_hat_i,
                mode=mode,
                heard=heard[node.name],
            )
        s = next(chain)
        mode = problem.mode_names[s]
        for kind in (kind for step, kind in events if step == k):
            sent.add("event", keys.COORDINATOR, step=k, kind=kind, who="coordinator", detail="")
        sent.add("mode", keys.COORDINATOR, step=k, mode=mode, index=s)
        before, x = x_hat, A @ x + B @ w
        phi, x_hat = deliveries.at(k), {}
        for i, name in enumerate(problem.node_names):
            neighbours = {problem.node_names[j]: bool(phi[i, j]) for j in problem.neighbours(s, i)}
            used = {j: (uses or {}).get((k, name, j), delivered) for j, delivered in neighbours.items()}
            heard[name] = [j for j, is_used in used.items() if (says or {}).get((k, name, j), is_used)]
            x_hat[name] = np.zeros(problem.nx)
            for j, is_used in used.items():
                a_ij = problem.topologies[s].adjacency[i, problem.node_index(j)]
                K_ij, H_ij, own = gains.K[mode][name][j], gains.H[mode][name][j], before[name]
                x_hat_j, nu_j = (before[j], innovation[j]) if is_used else (own, 0.0 * innovation[j])
                if not problem.unbiased:
                    x_hat[name] += a_ij * (K_ij @ x_hat_j + H_ij @ nu_j)
                elif j == name:
                    off = (misjudges_itself or {}).get(name, 0.0) * K_ij
                    x_hat[name] += A @ own + a_ij * (off @ own + H_ij @ nu_j)
                else:
                    x_hat[name] += a_ij * (K_ij @ (x_hat_j if forgets_itself else x_hat_j - own) + H_ij @ nu_j)
    sent.add("event", keys.COORDINATOR, step=max(steps - 1, 0), kind="end", who="coordinator", detail="")
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


def whole_run(problem: Problem, steps: int, external: str = "") -> dict[str, int]:
    """How many messages each sender of `simulate` sends."""
    simulated = [name for name in problem.node_names if name not in external.split(",")]
    return {
        keys.COORDINATOR: steps + 2,
        keys.PLANT: steps * (1 + len(simulated)),
        **{keys.node_who(name): steps for name in problem.node_names},
    }


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
    received: Mapping[str, int] | None = None,
    evidence: bool = True,
    void: Mapping[str, str] | None = None,
    **facts: str,
) -> Path:
    """Write the messages in the order given; returns where they are: `path`, or its .part where not `whole`.

    With `evidence` of them, for the first message of every number, as if these had been sent.

    `received` counts each sender's messages, as the recorder does; where it is not given, those of a whole run, and
    of one without a plant where nothing of it is there and no node needs it. `void` are numbers of senders, as the
    recorder writes them, that stand for nothing.
    """
    run = {"run": "test", "seed": str(seed), "steps": str(steps), "gains": gains.digest(), "external": "", **facts}
    chains, numbers = Chains(), set[tuple[str, int]]()
    with RecordingWriter(path, run=run, gains=gains) as writer:

        def put(blocks: Iterable[Evidence | None], time: int) -> None:
            for block in blocks:
                if block is not None and evidence:
                    writer.add(Logged(keys.EVIDENCE, block.encode(), 0, time, time))

        for time, message in enumerate(sent):
            payload = canonical(message.document)
            writer.add(Logged(message.topic, payload, message.number, time, time))
            if (message.who, message.number) not in numbers:
                numbers.add((message.who, message.number))
                stamp = Stamp(message.number, time, message.who, digest_of(message.topic, payload))
                put([chains.add(stamp, message.document["step"])], time)
        if whole:
            put(chains.rest(last=True), len(sent))
            external = facts.get("external", "")
            counts = whole_run(gains.problem, steps, external) if received is None else dict(received)
            if received is None and len(external.split(",")) == gains.problem.n:
                counts = {who: count for who, count in counts.items() if any(message.who == who for message in sent)}
            end = {"status": status, "reason": "", "steps": str(steps if end_steps is None else end_steps)}
            heads = {f"head.{who}": head for who, head in chains.heads().items() if evidence}
            end |= {f"void.{who}": numbers for who, numbers in (void or {}).items()}
            writer.finish(end | {f"received.{who}": str(count) for who, count in counts.items()} | heads)
    return path if whole else path.with_name(path.name + ".part")
