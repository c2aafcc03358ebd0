"""Every picture of a run: what is drawn of an account, and what is said beside it."""

from __future__ import annotations

import numpy as np

from agent.contract.arrays import Array
from agent.contract.problem import Problem
from designer.chance import CONFIDENCE
from designer.replay.topics import Numbers
from designer.report.account import Account, over_nodes
from designer.report.chart import Band, Chart, Level, Line, Map, Mark, Raster
from designer.report.scales import brief

SINGLE = 6  # so many nodes have each a line of their own; of more the range, the median and the worst
WORST = ("worst", "second worst", "third worst")
CLOSE = 5.0  # bounds this many times as large as the errors fit on one linear axis with them
OUTPUTS = 6  # of which there are pictures


def pictures(account: Account) -> list[Chart]:
    """Every picture of a run over its steps, in the order of a report."""
    log, problem = account.log, account.log.gains.problem
    few = problem.n <= SINGLE
    drawn = outputs(problem, log.z if log.has_plant else None, log.z_hat)
    drawn += errors(problem, account.errors, known=log.has_plant) if few else [_sizes(account)]
    if log.has_plant:
        drawn.append(_bounds(account))
    drawn += [_error_map(account), modes(problem, log.mode)]
    if (raster := _losses(account)) is not None:
        drawn.append(raster)
    return [*drawn, _gaps(account)]


def outputs(problem: Problem, z: Array | None, z_hat: Array) -> list[Chart]:
    """z (steps, nz) and every z_hat_i (steps, n nz), a chart for each output: figures 3 and 4 of the paper."""
    of_nodes, found = z_hat.reshape(len(z_hat), problem.n, -1), []
    for row in range(min(problem.nz, OUTPUTS)):
        values = of_nodes[:, :, row]
        marks = _each(problem, values, "ẑ of ") if problem.n <= SINGLE else _range(problem, values, "ẑ of ")
        about = "Dots or the thin line: z, which the nodes cannot see. The rest: each node's estimate of it, ẑ."
        if z is not None:
            marks.append(Line("z of the plant", z[:, row], "plant", "dots or steps"))
        else:
            about = "Each node's estimate ẑ. The true z is not known: real sensors measured it."
        found.append(
            Chart(
                f"outputs{_number(problem, row)}",
                f"What is watched, and what every node takes it for{_of_output(problem, row)}",
                about,
                "ẑ (dimensionless)" if z is None else "z and ẑ (dimensionless)",
                tuple(marks),
                remark=_left_out(problem) if row == 0 else "",
            )
        )
    return found


def errors(problem: Problem, z_tilde: Array, *, known: bool = True) -> list[Chart]:
    """z - z_hat_i of every node, (steps, n, nz), a chart for each output: figures 5 and 6 of the paper."""
    return [
        Chart(
            f"errors{_number(problem, row)}",
            _how_far(known) + _of_output(problem, row),
            "At 0 a node's estimate is right." if known else "At 0 a node's estimate is the median of all nodes.",
            f"{'z − ẑ' if known else 'ẑ − median'} (dimensionless)",
            tuple(_each(problem, z_tilde[:, :, row], "")),
        )
        for row in range(min(problem.nz, OUTPUTS))
    ]


def _sizes(account: Account) -> Chart:
    """Of many nodes: the range of their errors, the median, and the worst by name."""
    problem, sizes, known = account.log.gains.problem, account.sizes, account.log.has_plant
    worst = [
        Line(f"node {problem.node_names[i]} ({which})", sizes[:, i], f"worst-{place}")
        for place, (i, which) in enumerate(zip(account.ranking, WORST, strict=False))
    ]
    return Chart(
        "errors",
        _how_far(known),
        f"At 0 a node's estimate is {'right' if known else 'the median of all nodes'}. "
        "The worst nodes have the largest root mean square over all steps.",
        f"{_size(known)} (dimensionless)",
        (*_range(problem, sizes, ""), *worst),
        from_zero=True,
    )


def _how_far(known: bool) -> str:
    return "How far off every node is" if known else "How far every node is from the others"


def _size(known: bool) -> str:
    return "|z − ẑ|" if known else "|ẑ − median|"


def modes(problem: Problem, mode: Numbers) -> Chart:
    """Figure 2 of the paper; -1, and what is no mode of the problem, is left out."""
    known = (mode >= 0) & (mode < len(problem.topologies))
    return Chart(
        "modes",
        "Which topology the network had",
        "The network switches between its topologies at random; each is drawn below.",
        "topology",
        (Line("topology", np.where(known, mode, np.nan), "plant"),),
        categories=problem.mode_names,
    )


def _bounds(account: Account) -> Chart:
    """|z_tilde(k)| below gamma in the mean, gamma_path of this run, and what single runs keep with a probability."""
    norms = account.log.error_norms()
    marks: list[Mark] = [Line("this run's own bound, γ_path", account.trace.path_bound, "path")]
    about = ["|z̃| is the size of all errors together. It can never be above this run's own bound, γ_path."]
    if account.mean_bound is not None:
        marks.append(Line("bound in the mean, γ", account.mean_bound, "mean"))
        about.append("γ bounds it in the mean over many runs: one run may be above it.")
    if account.verdict.chance is not None:
        name = f"at least {CONFIDENCE:.0%} of such runs stay below at every step"
        marks.append(Level(name, account.verdict.chance.level(), "chance"))
    marks.append(Line("|z̃|, all nodes together", norms, "plant", "dotted steps"))
    highest = max(np.nanmax(mark.values, initial=0.0) for mark in marks if isinstance(mark, Line))
    return Chart(
        "bounds",
        "All errors together, and what bounds them",
        " ".join(about),
        "|z̃| (dimensionless)",
        tuple(marks),
        log=bool(highest > CLOSE * np.nanmax(norms, initial=0.0)),
        from_zero=True,
        remark=_why_no_gamma(account) if account.mean_bound is None else "",
    )


def _why_no_gamma(account: Account) -> str:
    if account.is_as_promised:
        return "No γ is drawn: none is proved for these gains."
    return "No γ is drawn: in this run something happened that it does not cover."


def _error_map(account: Account) -> Chart:
    problem, known = account.log.gains.problem, account.log.has_plant
    many = problem.n > SINGLE
    order = account.ranking if many else range(problem.n)
    return Chart(
        "error-map",
        "Every node's error at every step" if known else "Every node's distance from the others at every step",
        f"The colour says how large it is{'; the node with the largest root mean square is on top' if many else ''}.",
        "node",
        rows=Map(
            f"{_size(known)} (dimensionless)", tuple(problem.node_names[i] for i in order), account.sizes[:, order]
        ),
    )


def _losses(account: Account) -> Chart | None:
    """None where nothing can be lost and nothing was."""
    problem, layers, about = account.log.gains.problem, [], []
    if (problem.beta < 1.0).any() or np.nansum(account.lost):
        layers.append(("measurement lost", "lost", account.lost))
        about.append("A mark: the node's own measurement did not arrive; none: it did.")
    if problem.links or np.nansum(account.done_without):
        layers.append(("message not used", "without", np.minimum(account.done_without, 1.0)))
        about.append("A node that misses a neighbour's message puts its own estimate in its place.")
    if not layers:
        return None
    return Chart(
        "losses",
        "What was lost",
        " ".join(about),
        "node",
        rows=Raster(problem.node_names, tuple(layers)),
    )


def _gaps(account: Account) -> Chart:
    names = {1: "inputs and statements (proof 1)", 2: "one step (proof 2)", 3: "whole run (proof 3)"}
    lines = [Line(names[k], gap, f"proof-{k}", "dots") for k, gap in account.trace.gaps.items()]
    tolerance = account.verdict.tolerance
    return Chart(
        "gaps",
        "How closely the recording follows the mathematics",
        "Each dot: the largest difference at a step between what was recorded and what was computed again, relative to "
        f"the numbers that enter it. Below {brief(tolerance, 2)} it is rounding; at the lower edge there is none.",
        "relative gap",
        (*lines, Level("tolerance", tolerance, "tolerance")),
        log=True,
    )


def _each(problem: Problem, values: Array, word: str) -> list[Mark]:
    """A line for every node. values (steps, n)."""
    return [Line(f"{word}node {name}", values[:, i], f"node-{i}") for i, name in enumerate(problem.node_names)]


def _range(problem: Problem, values: Array, word: str) -> list[Mark]:
    """What lies between all nodes, and their median. values (steps, n)."""
    low, high = over_nodes(np.nanmin, values), over_nodes(np.nanmax, values)
    median = Line("median node", over_nodes(np.nanmedian, values), "median")
    return [Band(f"{word}all {problem.n} nodes", low, high, "range"), median]


def _number(problem: Problem, row: int) -> str:
    return "" if problem.nz == 1 else f"-{row + 1}"


def _of_output(problem: Problem, row: int) -> str:
    return "" if problem.nz == 1 else f": output {row + 1}"


def _left_out(problem: Problem) -> str:
    return "" if problem.nz <= OUTPUTS else f"Outputs {OUTPUTS + 1} to {problem.nz} have no pictures; the map has all."
