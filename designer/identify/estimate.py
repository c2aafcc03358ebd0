"""The problem with what was observed in place of what was assumed."""

from __future__ import annotations

from agent.contract.errors import InputError, counted
from agent.contract.problem import Problem
from designer.identify.counts import Counts


def observed(problem: Problem, counts: Counts) -> Problem:
    """Shares for probabilities; what was never tried stays as it was. InputError: no problem has such values."""
    document, names = problem.document(), problem.node_names
    nodes = [dict(node) for node in document["node"]]
    for node, count in zip(nodes, counts.arrivals, strict=True):
        if count.trials:
            if not count.hits:
                what = f'no measurement of node "{node["name"]}" arrived in {counted(count.trials, "step")}'
                raise InputError(f"{what}; a problem needs an arrival probability above 0")
            node["arrival_probability"] = count.share
    rho = {(link.receiver, link.sender): link.delivery_probability for link in problem.links or ()}
    for (i, j), count in counts.deliveries.items():
        link = (names[i], names[j])
        if count.trials and not count.hits:
            what = f'no message of node "{names[j]}" reached node "{names[i]}" in {counted(count.trials, "step")}'
            raise InputError(f"{what}; a problem needs a delivery probability above 0")
        if count.trials and (link in rho or count.hits < count.trials):
            rho[link] = count.share
    rows = [
        (exits / exits.sum()).tolist() if exits.sum() else row.tolist()
        for exits, row in zip(counts.transitions, problem.markov.transition, strict=True)
    ]
    changed = document | {"node": nodes, "markov": document["markov"] | {"transition": rows}}
    if rho:
        changed["link"] = [{"receiver": i, "sender": j, "delivery_probability": share} for (i, j), share in rho.items()]
    return Problem.from_document(changed)
