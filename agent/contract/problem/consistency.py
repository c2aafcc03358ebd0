"""What must hold between the parts of a problem. Checks raise ValueError: what, where, the value, what is right."""

from __future__ import annotations

from collections.abc import Sequence

from agent.contract.arrays import shape_text
from agent.contract.errors import counted, listed
from agent.contract.problem.disturbance import Disturbance, Samples
from agent.contract.problem.parts import LossyLink, MarkovChain, Node, Plant, Topology

ROW_SUM_TOLERANCE = 1e-9


def check_nodes(nodes: Sequence[Node], plant: Plant) -> None:
    """Names differ; every C_i and D_i fits the plant."""
    refuse_duplicates("node", [node.name for node in nodes])
    nx, nw = plant.B.shape
    for node in nodes:
        if node.C.shape[1] != nx:
            raise ValueError(
                f'node "{node.name}": C is {shape_text(node.C)}; the plant has {counted(nx, "state")}, '
                f"so C needs {counted(nx, 'column')}"
            )
        if node.D.shape[1] != nw:
            raise ValueError(
                f'node "{node.name}": D is {shape_text(node.D)}; the plant has {counted(nw, "disturbance")}, '
                f"so D needs {counted(nw, 'column')}"
            )


def check_topologies(topologies: Sequence[Topology], nodes: Sequence[str]) -> None:
    """Names differ; a_ij for every two nodes, none negative; every node hears itself."""
    refuse_duplicates("topology", [topology.name for topology in topologies])
    n = len(nodes)
    for topology in topologies:
        adjacency, where = topology.adjacency, f'topology "{topology.name}": adjacency'
        if adjacency.shape != (n, n):
            raise ValueError(f"{where} is {shape_text(adjacency)}; for {counted(n, 'node')} it must be {n} x {n}")
        for i, receiver in enumerate(nodes):
            for j, sender in enumerate(nodes):
                if adjacency[i, j] < 0.0:
                    raise ValueError(
                        f'{where} gives "{receiver}" hearing "{sender}" the weight {adjacency[i, j]}; '
                        "a weight is 0 or positive"
                    )
            if adjacency[i, i] == 0.0:
                raise ValueError(f'{where} has 0 for "{receiver}" itself; a node hears itself, a_ii = 1')


def check_links(links: Sequence[LossyLink], nodes: Sequence[str], topologies: Sequence[Topology]) -> None:
    """Each joins two nodes of which one hears the other in some topology, and is there once."""
    known: set[tuple[str, str]] = set()
    for link in links:
        where = f'link from "{link.sender}" to "{link.receiver}"'
        for name in (link.sender, link.receiver):
            if name not in nodes:
                raise ValueError(f'{where}: node "{name}" does not exist; the problem has nodes {listed(nodes)}')
        if link.sender == link.receiver:
            raise ValueError(f"{where}: a node has its own numbers always; name two nodes")
        i, j = nodes.index(link.receiver), nodes.index(link.sender)
        if not any(topology.adjacency[i, j] > 0.0 for topology in topologies):
            raise ValueError(f'{where}: "{link.receiver}" hears "{link.sender}" in no topology')
        if (link.receiver, link.sender) in known:
            raise ValueError(f"{where} is there twice; give it one delivery_probability")
        known.add((link.receiver, link.sender))


def check_stability(plant: Plant, *, unbiased: bool, hidden: Sequence[str]) -> None:
    """The errors of an unstable plant must not contain its state. `hidden`: nodes that do not know what they lose."""
    radius = plant.spectral_radius
    if radius < 1.0 or (unbiased and not hidden):
        return
    if unbiased:
        raise ValueError(
            f"plant: A is unstable, its spectral radius is {radius:.6g}, and "
            f'node "{hidden[0]}" does not know which of its measurements are lost: '
            'its errors then contain the state; give it loss = "seen"'
        )
    raise ValueError(
        f"plant: A is unstable: its spectral radius is {radius:.6g} and must be below 1, because the errors "
        "contain the state; an unstable plant needs unbiased = true, "
        'and loss = "seen" at every node that loses measurements'
    )


def check_markov(markov: MarkovChain, modes: Sequence[str]) -> None:
    """pi_st for every two topologies, each row a probability distribution; r(0) is one of them."""
    transition = markov.transition
    if transition.shape != (len(modes), len(modes)):
        raise ValueError(
            f"markov: transition is {shape_text(transition)}; "
            f"for {counted(len(modes), 'topology')} it must be {len(modes)} x {len(modes)}"
        )
    for name, row in zip(modes, transition, strict=True):
        if (row < 0.0).any() or (row > 1.0).any():
            wrong = row[(row < 0.0) | (row > 1.0)][0]
            raise ValueError(f'markov: transition, row of "{name}", holds {wrong}; a probability lies in [0, 1]')
        if abs(row.sum() - 1.0) > ROW_SUM_TOLERANCE:
            raise ValueError(f'markov: transition, row of "{name}", sums to {row.sum():.12g}; it must sum to 1')
    sizes = None if markov.tolerance is None else markov.tolerance.transition
    if isinstance(sizes, list) and len(sizes) != len(modes):
        raise ValueError(
            f"markov: tolerance of transition has {counted(len(sizes), 'entry')}; it is a number, or one for each of "
            f"{counted(len(modes), 'topology')}"
        )
    if markov.initial not in modes:
        raise ValueError(f'markov: initial "{markov.initial}" is no topology; the topologies are {listed(modes)}')


def check_disturbance(disturbance: Disturbance, plant: Plant) -> None:
    """A CSV file has a column for each component of w."""
    nw = plant.B.shape[1]
    if isinstance(disturbance, Samples) and disturbance.values.shape[1] != nw:
        raise ValueError(
            f'disturbance: "{disturbance.file}" has {counted(disturbance.values.shape[1], "column")}; '
            f"the plant has {counted(nw, 'disturbance')}"
        )


def refuse_duplicates(kind: str, names: Sequence[str]) -> None:
    """No two nodes, no two topologies have the same name."""
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f'{kind} "{name}" is there {names.count(name)} times; names must differ')
