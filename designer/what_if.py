"""What if a node or a link were not there: the problem without it, and the price of each.

The certified gamma of a network bounds the errors of all its nodes together, so that of one node less is no measure of
what the others lost. A removal is therefore priced against what the whole network's gains do for the nodes that
remain. Removing a link leaves all nodes, and the comparison is with the whole network's gamma.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from agent.contract.errors import InputError, Unattainable, listed
from agent.contract.gains import Gains, LinkMatrices
from agent.contract.problem import Problem
from designer.gain.exact import exact_gain
from designer.ladder import percent, rounded_up
from designer.lmi.back_off import least_gamma
from designer.model.error_model import StackedGains, error_model, model_of_gains, stacked_gains, stacked_links
from designer.proof.certificate import lyapunov_matrix
from designer.search.descent import NEAR, ROUGH
from designer.search.effort import default_method
from designer.search.starts import least_variance_gains
from designer.workers import each, greet_cluster

_SHARE = 0.5  # of the time of a design that one from near gains takes


# the problem without a part
def without_node(problem: Problem, name: str) -> Problem:
    """The problem without a node and all its links. Its name says so."""
    gone = problem.node_index(name)
    if problem.n == 1:
        raise InputError(f'node "{name}" is the only node of {problem.name}; without it there is no network')
    document = problem.document()
    document["node"] = [node for node in document["node"] if node["name"] != name]
    for topology in document["topology"]:
        topology["adjacency"] = np.delete(np.delete(topology["adjacency"], gone, 0), gone, 1).tolist()
    return _changed(problem, document, name, lambda link: name in (link["receiver"], link["sender"]))


def without_link(problem: Problem, receiver: str, sender: str) -> Problem:
    """The problem in which `receiver` hears `sender` in no mode. The other direction stays."""
    i, j = problem.node_index(receiver), problem.node_index(sender)
    if i == j:
        raise InputError(f"link {receiver}:{sender}: a node always hears itself; name two nodes, A:B where A hears B")
    if j not in problem.ever_heard(i):
        heard = listed(problem.node_names[k] for k in problem.ever_heard(i) if k != i) or "nobody else"
        raise InputError(f'link {receiver}:{sender}: node "{receiver}" hears "{sender}" in no mode; it hears {heard}')
    document = problem.document()
    for topology in document["topology"]:
        topology["adjacency"][i][j] = 0.0
    return _changed(
        problem,
        document,
        f"{receiver}-from-{sender}",
        lambda link: (link["receiver"], link["sender"]) == (receiver, sender),
    )


def _changed(
    problem: Problem, document: dict[str, Any], what: str, is_gone: Callable[[dict[str, Any]], bool]
) -> Problem:
    document["name"] = f"{problem.name}-without-{what}"[:64]
    links = [link for link in document.pop("link", []) if not is_gone(link)]
    return Problem.from_document(document | ({"link": links} if links else {}))


# what each part is worth
class Priced(NamedTuple):
    """One part left out."""

    part: str  # "node" or "link"
    name: str  # of the node, or A:B for what A hears from B
    before: float  # what the whole network's gains do for the nodes that remain; computed, where nodes are fewer
    kept: float | None  # what those gains do without the part; computed; None where the errors are not stable
    gamma: float | None  # certified without the part, designed anew; None where nothing is
    reason: str | None  # why nothing is certified

    @property
    def cost(self) -> float:
        """By what part of it the bound rises; infinite where there is none."""
        return math.inf if self.gamma is None else self.gamma / self.before - 1.0


class PriceTable(NamedTuple):
    """The whole network, and every part that can be left out, the dearest first."""

    problem: str
    method: str
    nodes: int
    gamma: float  # of the whole network, certified
    rows: list[Priced]

    def document(self) -> dict[str, Any]:
        """For --json; a cost of null stands beside a gamma of null."""
        rows = [row._asdict() | {"cost": None if row.gamma is None else row.cost} for row in self.rows]
        return self._asdict() | {"rows": rows}


class _Job(NamedTuple):
    """One design, as a worker process gets it."""

    part: str
    name: str
    before: float
    problem: Problem
    method: str
    start: StackedGains


def price_method(problem: Problem) -> str:
    """The default: exact where all the designs together take at most about ten minutes, else decomposed."""
    return default_method(problem, designs=1.0 + _SHARE * len(_parts(problem)))


def price(
    problem: Problem,
    *,
    method: str,
    dask: str | None = None,
    processes: int | None = None,
    report: Callable[[int, int, str], None] = lambda done, of, what: None,
) -> PriceTable:
    """Design the whole network, then without each part in turn, on the processes of `designer.workers.each`.

    Method "exact" starts each of these from the whole network's gains, unless others are better without the part, and
    ends each search a little before its end. `report` gets how many designs are done, of how many, and the last of
    them in words.
    """
    if dask is not None:
        greet_cluster(dask)  # before the first design, which may take minutes
    parts = _parts(problem)
    whole = _design(problem, method)
    report(1, 1 + len(parts), f"whole network: gamma {rounded_up(whole.certificate.gamma)}")
    jobs = [
        _Job(part, name, _bound_for(whole, rest), rest, method, _gains_left(whole, rest)) for part, name, rest in parts
    ]
    rows = []
    for done, row in enumerate(each(_priced, jobs, dask=dask, processes=processes), 2):
        rows.append(row)
        said = f"gamma {rounded_up(row.gamma)}" if row.gamma is not None else "no bound"
        report(done, 1 + len(parts), f"without {row.part} {row.name}: {said}")
    rows.sort(key=lambda row: -row.cost)
    return PriceTable(problem.name, method, problem.n, whole.certificate.gamma, rows)


def price_text(table: PriceTable) -> str:
    """The table for people, and what its columns compare."""
    lines = [f"{table.problem} by {table.method}: gamma = {rounded_up(table.gamma)} for {table.nodes} nodes, certified"]
    if not table.rows:
        return f"{lines[0]}\nthere is one node and no link: nothing can be left out"
    width = max(12, *(len(f"{row.part} {row.name}") for row in table.rows))
    values = [value for row in table.rows for value in (row.gamma, row.kept, row.before) if value is not None]
    columns = max(8, *(len(rounded_up(value)) for value in values))
    lines.append(f"{'left out':{width}}  {'gamma':{columns}}  {'kept':{columns}}  {'before':{columns}}  cost")
    for row in table.rows:
        cost = "" if row.gamma is None else percent(row.cost)
        gamma, kept = ("no bound" if value is None else rounded_up(value) for value in (row.gamma, row.kept))
        numbers = f"{gamma:{columns}}  {kept:{columns}}  {rounded_up(row.before):{columns}}"
        lines.append(f"{f'{row.part} {row.name}':{width}}  {numbers}  {cost}{row.reason or ''}")
    lines += [
        "gamma      certified, designed anew without the part; it is over the nodes that remain",
        "kept       for those same nodes, by the whole network's gains without the part; computed, not proved",
        "before     for those same nodes, by the whole network's gains; computed, not proved, where a node is gone",
        "link A:B   what A hears from B",
    ]
    return "\n".join(lines)


def _parts(problem: Problem) -> list[tuple[str, str, Problem]]:
    """Every node and every link with the problem that is left without it."""
    nodes = [("node", name, without_node(problem, name)) for name in problem.node_names if problem.n > 1]
    links = [
        ("link", f"{receiver}:{problem.node_names[j]}", without_link(problem, receiver, problem.node_names[j]))
        for i, receiver in enumerate(problem.node_names)
        for j in problem.ever_heard(i)
        if i != j
    ]
    return nodes + links


def _priced(job: _Job) -> Priced:
    """The job's design; that there is no certificate is an answer."""
    bounds = exact_gain(error_model(job.problem, *job.start)).bounds
    kept = None if bounds is None else bounds[1]
    try:
        try:
            gamma = _design(job.problem, job.method, job.start).certificate.gamma
        except Unattainable:
            if job.method != "exact":
                raise
            gamma = _design(job.problem, job.method).certificate.gamma  # the start at hand was a bad one
    except Unattainable as error:
        return Priced(job.part, job.name, job.before, kept, None, str(error))
    return Priced(job.part, job.name, job.before, kept, gamma, None)


def _design(problem: Problem, method: str, start: StackedGains | None = None) -> Gains:
    from designer.search.exact_design import design_exact
    from designer.synthesis import design

    if method == "exact" and start is not None:
        starts, first = _begun(problem, start)
        gains = design_exact(problem, starts=starts, first=first, last=ROUGH)
    else:
        gains = design(problem, method=method, budget=math.inf)
    if gains.solver.status.startswith("interrupted"):  # the best gains so far are no price
        raise KeyboardInterrupt
    return gains


def _begun(problem: Problem, start: StackedGains) -> tuple[dict[str, StackedGains], float]:
    """What a search without a part begins with, and the first mu: the start, which is near, unless others do better."""
    others = least_variance_gains(problem)
    near, far = (exact_gain(error_model(problem, *gains)).high for gains in (start, others))
    return ({"whole network": start}, NEAR) if near <= far else ({"least variance": others}, math.inf)


def _bound_for(whole: Gains, rest: Problem) -> float:
    """What the whole network's gains do for the nodes of `rest`, by the same kind of bound.

    Proved only where all nodes remain; else it is computed in floats.
    """
    problem = whole.problem
    if rest.n == problem.n:
        return whole.certificate.gamma
    kept = np.repeat([name in rest.node_names for name in problem.node_names], problem.nz)
    if whole.certificate.kind == "exact":
        model = model_of_gains(problem, whole.K, whole.H)
        return exact_gain(replace(model, M=model.M[kept])).high
    return least_gamma(error_model(problem, *stacked_gains(whole)).M[kept], lyapunov_matrix(whole))


def _gains_left(whole: Gains, rest: Problem) -> StackedGains:
    """The whole network's gains on what is left; for an estimate that a node no longer hears it takes its own."""
    problem = whole.problem
    K: LinkMatrices = {}
    H: LinkMatrices = {}
    for s, topology in enumerate(rest.topologies):
        mode, before = topology.name, problem.topologies[s].adjacency
        K[mode], H[mode] = {}, {}
        for i, receiver in enumerate(rest.node_names):
            all_K, at = whole.K[mode][receiver], problem.node_index(receiver)
            heard = [rest.node_names[j] for j in rest.neighbours(s, i)]
            lost = [before[at, problem.node_index(name)] * K_ij for name, K_ij in all_K.items() if name not in heard]
            K[mode][receiver] = {name: all_K[name] for name in heard}
            K[mode][receiver][receiver] = all_K[receiver] + sum(lost) / before[at, at]
            H[mode][receiver] = {name: whole.H[mode][receiver][name] for name in heard}
    return stacked_links(rest, K, H)
