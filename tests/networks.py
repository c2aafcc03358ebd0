"""Small random problems and gains for tests."""

from __future__ import annotations

from typing import Any

import numpy as np

from agent.contract.arrays import Array
from agent.contract.problem import Problem


def random_problem(
    seed: int,
    *,
    n: int = 3,
    nx: int = 2,
    nw: int = 2,
    nz: int = 1,
    modes: int = 2,
    lossy: bool = True,
    seen: str = "none",
    links: bool = False,
    unbiased: bool = False,
    radius: float = 0.8,
) -> Problem:
    """A plant with this spectral radius, nodes with one or two measurements each, weights other than 1.

    Node 0 loses nothing. `seen` says which nodes know their losses: "none", "some" (every second) or "all"; with
    `links` about half of all links lose messages.
    """
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(nx, nx))
    A *= radius / np.abs(np.linalg.eigvals(A)).max()
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
    for i, node in enumerate(document["node"]):
        if seen == "all" or (seen == "some" and i % 2):
            node["loss"] = "seen"
    if unbiased:
        document["unbiased"] = True
    if links:
        adjacency = np.array([topology["adjacency"] for topology in document["topology"]])
        heard = [(i, j) for i, j in np.argwhere(adjacency.max(axis=0) > 0.0) if i != j]
        lossy_links = [pair for pair in heard if rng.uniform() < 0.5] or heard[:1]
        document["link"] = [
            {"receiver": f"n{i}", "sender": f"n{j}", "delivery_probability": float(rng.uniform(0.5, 0.95))}
            for i, j in lossy_links
        ]
    return Problem.from_document(document)


def real_network(
    problem: Problem,
    *,
    seen: bool | list[str] = False,
    delivery: float | None = None,
    unbiased: bool = False,
    radius: float | None = None,
) -> Problem:
    """The problem with what is not in the paper.

    `seen`: the nodes that see their losses, or all; `delivery`: of every link that some topology has; `radius`: the
    spectral radius that A is scaled to.
    """
    document = problem.document()
    for node in document["node"]:
        if seen is True or (seen and node["name"] in seen):
            node["loss"] = "seen"
    if delivery is not None:
        names = problem.node_names
        document["link"] = [
            {"receiver": receiver, "sender": names[j], "delivery_probability": delivery}
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
