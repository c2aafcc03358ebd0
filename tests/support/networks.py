"""Small random problems and gains for tests."""

from __future__ import annotations

from typing import Any

import numpy as np

from agent.contract.arrays import Array
from agent.contract.problem import Problem


def random_problem(
    seed: int, *, n: int = 3, nx: int = 2, nw: int = 2, nz: int = 1, modes: int = 2, lossy: bool = True
) -> Problem:
    """A stable plant, nodes with one or two measurements each, weights other than 1, node 1 without loss."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(nx, nx))
    A *= 0.8 / np.abs(np.linalg.eigvals(A)).max()
    transition = rng.uniform(0.1, 1.0, size=(modes, modes))
    transition /= transition.sum(axis=1, keepdims=True)
    document: dict[str, Any] = {
        "name": f"random-{seed}",
        "plant": {
            "A": A.tolist(),
            "B": rng.normal(size=(nx, nw)).tolist(),
            "M": rng.normal(size=(nz, nx)).tolist(),
        },
        "node": [
            {
                "name": f"n{i}",
                "C": rng.normal(size=(1 + i % 2, nx)).tolist(),
                "D": rng.normal(size=(1 + i % 2, nw)).tolist(),
                "arrival_probability": float(rng.uniform(0.5, 0.95)) if lossy and i else 1.0,
            }
            for i in range(n)
        ],
        "topology": [{"name": f"m{s}", "adjacency": _adjacency(rng, n).tolist()} for s in range(modes)],
        "markov": {"transition": transition.tolist(), "initial": "m0"},
    }
    return Problem.from_document(document)


def real_network(
    problem: Problem,
    *,
    seen: bool | list[str] = False,
    delivery: float | Array | None = None,
    unbiased: bool = False,
    radius: float | None = None,
    weighted: bool = False,
) -> Problem:
    """The problem with what is not in the paper.

    `seen`: the nodes that see their losses, or all; `delivery`: of every link that some topology has, or (n, n) of
    each; `radius`: the spectral radius that A is scaled to; `weighted`: every other node counts less.
    """
    document = problem.document()
    for node in document["node"][1::2] if weighted else ():
        node["weight"] = 0.3
    for node in document["node"]:
        if seen is True or (seen and node["name"] in seen):
            node["loss"] = "seen"
    if delivery is not None:
        names, rho = problem.node_names, np.broadcast_to(delivery, (problem.n, problem.n))
        document["link"] = [
            {"receiver": receiver, "sender": names[j], "delivery_probability": float(rho[i, j])}
            for i, receiver in enumerate(names)
            for j in problem.ever_heard(i)
            if i != j
        ]
    if unbiased:
        document["unbiased"] = True
    if radius is not None:
        A = problem.plant.A
        document["plant"]["A"] = (A * radius / np.abs(np.linalg.eigvals(A)).max()).tolist()
    return Problem.from_document(document)


def real_networks(seed: int, **shape: Any) -> dict[str, Problem]:
    """One random problem with each of what is not in the paper, and with combinations; two links lose messages."""
    base = random_problem(seed, **shape)
    pairs = [(i, j) for i in range(base.n) for j in base.ever_heard(i) if i != j]
    rng = np.random.default_rng(seed)
    rho = np.ones((base.n, base.n))
    for at in rng.permutation(len(pairs))[:2]:
        rho[pairs[at]] = rng.uniform(0.5, 0.9)
    some = list(base.node_names[1::2])
    return {
        "seen": real_network(base, seen=True),
        "links": real_network(base, delivery=rho),
        "some seen, links, weighted": real_network(base, seen=some, delivery=rho, weighted=True),
        "unbiased": real_network(base, unbiased=True),
        "unbiased, some seen, links": real_network(base, seen=some, delivery=rho, unbiased=True),
        "unbiased, seen, links, unstable, weighted": real_network(
            base, seen=True, delivery=rho, unbiased=True, radius=1.1, weighted=True
        ),
    }


def own_noise(problem: Problem) -> Problem:
    """The same with one more w for each measurement, which disturbs nothing else."""
    document, more = problem.document(), sum(len(node.C) for node in problem.nodes)
    document["plant"]["B"] = np.hstack([problem.plant.B, np.zeros((problem.nx, more))]).tolist()
    noise = np.eye(more)
    for node in document["node"]:
        measurements = len(node["C"])
        node["D"] = np.hstack([node["D"], noise[:measurements]]).tolist()
        noise = noise[measurements:]
    return Problem.from_document(document)


def random_gains(problem: Problem, seed: int, *, size: float = 0.3) -> tuple[Array, Array]:
    """K_bar (modes, n nx, n nx) and H_bar (modes, n nx, sum ny) with the sparsity of (9); unbiased where asked."""
    rng = np.random.default_rng(seed)
    K_bar, H_bar = [], []
    for s in range(len(problem.topologies)):
        K_rows, H_rows = [], []
        for i in range(problem.n):
            heard = problem.neighbours(s, i)
            K_rows.append([_block(rng, problem.nx, problem.nx, j in heard, size) for j in range(problem.n)])
            H_rows.append(
                [_block(rng, problem.nx, len(node.C), j in heard, size) for j, node in enumerate(problem.nodes)]
            )
            if problem.unbiased:
                K_rows[i][i] = problem.plant.A - sum(K_rows[i][j] for j in heard if j != i)
        K_bar.append(np.block(K_rows))
        H_bar.append(np.block(H_rows))
    return np.array(K_bar), np.array(H_bar)


def _block(rng: np.random.Generator, rows: int, columns: int, heard: bool, size: float) -> Array:
    return size * rng.normal(size=(rows, columns)) if heard else np.zeros((rows, columns))


def _adjacency(rng: np.random.Generator, n: int) -> Array:
    adjacency = np.where(rng.uniform(size=(n, n)) < 0.5, rng.uniform(0.3, 2.0, size=(n, n)), 0.0)
    np.fill_diagonal(adjacency, rng.uniform(0.5, 1.5, size=n))
    return np.asarray(adjacency)
