"""The problem with what was observed in place of what was assumed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from agent.contract.errors import InputError, counted
from agent.contract.problem import Problem
from designer.identify.counts import Count, Counts
from designer.identify.fit import interval


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
        known = {(link["receiver"], link["sender"]): link for link in document.get("link", ())}
        changed["link"] = [
            known.get((i, j), {"receiver": i, "sender": j}) | {"delivery_probability": share}
            for (i, j), share in rho.items()
        ]
    return Problem.from_document(changed)


def tolerant(problem: Problem, assumed: Problem, counts: Counts, *, level: float) -> Problem:
    """What was `observed` with tolerances that have all true probabilities at once with probability 1 - level at least.

    Each interval has its own with 1 - level / so many (Bonferroni). What is `assumed` never to fail, or never to
    happen, and did not, is left as certain, and what was never tried as it was. A row of Pi is as far off as the
    intervals of its entries let it be.
    """
    nodes, links = problem.nodes, problem.links or ()
    rho = assumed.delivery
    pairs = [(problem.node_index(link.receiver), problem.node_index(link.sender)) for link in links]
    arrived = {j: count for j, count in enumerate(counts.arrivals) if _may_fail(count, assumed.beta[j])}
    delivered = {
        k: counts.deliveries[pair]
        for k, pair in enumerate(pairs)
        if pair in counts.deliveries and _may_fail(counts.deliveries[pair], rho[pair])
    }
    rows = [
        [Count(int(hits), int(exits.sum())) for hits, pi in zip(exits, row, strict=True) if pi > 0.0 or hits]
        for exits, row in zip(counts.transitions, assumed.markov.transition, strict=True)
    ]
    rows = [row if row and row[0].trials else [] for row in rows]
    number = len(arrived) + len(delivered) + sum(len(row) for row in rows if len(row) > 1)
    if not number:
        return problem
    document, each = problem.document(), level / number
    for j, count in arrived.items():
        _may_be(document["node"][j], "arrival_probability", nodes[j].arrival_probability, interval(count, each))
    for k, count in delivered.items():
        _may_be(document["link"][k], "delivery_probability", links[k].delivery_probability, interval(count, each))
    if any(len(row) > 1 for row in rows):
        document["markov"]["tolerance"] = {"transition": [total_variation(row, each) for row in rows]}
    return Problem.from_document(document)


def _may_fail(count: Count, assumed: float) -> bool:
    return count.trials > 0 and (assumed < 1.0 or count.hits < count.trials)


def _may_be(part: dict[str, Any], name: str, value: float, ends: tuple[float, float]) -> None:
    sides = [_above(value - ends[0]), _above(ends[1] - value)]
    part["tolerance"] = part.get("tolerance", {}) | {name: sides}


def total_variation(row: Sequence[Count], level: float) -> float:
    """Half of sum |pi - p| is the sum of what some entries gain, and of what others lose; `level` for each entry.

    Half of that goes to the intervals of the entries, and half to the row: with k entries and N exits, sum |pi - p| is
    eps or more with probability (2^k - 2) exp(-N eps^2 / 2) at most (Weissman et al. 2003). So the lesser holds.
    """
    k, exits = len(row), row[0].trials if row else 0
    if k < 2:
        return 0.0
    ends = [(count.share, *interval(count, level / 2.0)) for count in row]
    gained, lost = sum(high - share for share, _, high in ends), sum(share - low for share, low, _ in ends)
    subsets = k * math.log(2.0) + math.log1p(-(2.0 ** (1 - k)))  # log of 2^k - 2
    of_row = math.sqrt(2.0 / exits * (subsets - math.log(k * level / 2.0))) / 2.0
    return min(_above(min(gained, lost, of_row)), 1.0)


def _above(size: float) -> float:
    """Six decimals, rounded up."""
    return math.ceil(size * 1e6) / 1e6
