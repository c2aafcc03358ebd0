"""`peakmesh simulate`: what thousands of runs say of gamma."""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from agent.commands.options import Subcommands, add_command, count, load_gains, seed
from agent.contract.errors import EXIT_GOOD, EXIT_NO
from agent.contract.files import refuse_overwrite, write_whole

if TYPE_CHECKING:
    from agent.contract.arrays import Array
    from agent.contract.gains import Gains
    from designer.simulation import Ensemble

WORST_CASE = "worst-case"


def add_simulate(commands: Subcommands) -> None:
    """Describe `simulate` to the parser."""
    simulate = add_command(
        commands, "simulate", simulate_command, "many runs at once: the mean square of the errors, held against gamma"
    )
    simulate.add_argument("gains", type=Path, metavar="GAINS", help="gains file, from peakmesh design")
    simulate.add_argument("--runs", type=count, default=1000, metavar="N", help="how many runs (1000)")
    simulate.add_argument("--steps", type=count, default=200, metavar="N", help="steps of each (200)")
    simulate.add_argument("--seed", type=seed, default=0, metavar="N", help="of run 0; run r has N + r (0)")
    simulate.add_argument(
        "--disturbance",
        choices=["problem", WORST_CASE],
        default="problem",
        help="what the problem says, or the sequence of energy 1 that is worst for these gains (problem)",
    )
    simulate.add_argument("--dask", metavar="ADDRESS", help="spread the runs over this Dask cluster")
    simulate.add_argument("--processes", type=count, metavar="N", help="of this machine (one for each core)")
    simulate.add_argument("-o", "--output", type=Path, metavar="FILE", help="a CSV file with a row for each step")
    simulate.add_argument("--force", action="store_true", help="replace the CSV file if it exists")
    simulate.add_argument("--json", action="store_true", help="print one JSON object")


def simulate_command(options: argparse.Namespace) -> int:
    """`peakmesh simulate GAINS`.

    The object of --json: problem, runs, steps, seed, disturbance (its kind), gamma, claimed (whether the file's
    certificate claims gamma), steady (what the mean square comes to in the steady state, computed, where the
    disturbance is white; else null), confidence (of all intervals at once);
    peak and closest, each with step, mean_square (over runs, of |z_tilde(k)|^2), low and high (its interval), energy
    (of w before the step, in the mean over white noise), bound (gamma^2 energy) and least (what the true mean is at
    least, whatever the distribution): the step of the largest mean, and that where the mean is largest relative to
    the bound (null where w is 0); start, what the initial error alone leaves of the root of the
    mean square at most, proved; gain, the root of mean_square / energy at the closest (null with it, or a start);
    refuted
    (whether `least` is above the bound at some step) and refuted_at (the first such step, or null); single, of the
    largest |z_tilde(k)| in single runs the median, p95 and largest, bound (gamma times the root of all energy) and
    above, how many runs exceed that; seconds; output (the CSV file, or null).
    Numbers beyond float64 are null.
    """
    if options.output is not None:
        refuse_overwrite(options.output, force=options.force)
    gains = load_gains(options.gains)
    kind, w = options.disturbance, None
    if kind == WORST_CASE:
        w = _worst_case(gains)
    else:
        kind = gains.problem.disturbance.kind
    began = time.perf_counter()
    from designer.simulation import simulate, steady

    ensemble = simulate(
        gains,
        runs=options.runs,
        steps=options.steps,
        seed=options.seed,
        w=w,
        dask=options.dask,
        processes=options.processes,
        progress=_progress(options.runs),
    )
    if options.output is not None:
        write_whole(options.output, _table(ensemble).encode(), force=options.force)
    facts = {
        "problem": gains.problem.name,
        "runs": options.runs,
        "steps": options.steps,
        "seed": options.seed,
        "disturbance": kind,
        "claimed": gains.certificate.holds,
        "steady": steady(gains) if kind == "white" else None,
        **_facts(ensemble),
        "seconds": time.perf_counter() - began,
        "output": None if options.output is None else str(options.output),
    }
    print(json.dumps(_finite(facts)) if options.json else _text(facts))
    return EXIT_NO if ensemble.refuted_at is not None else EXIT_GOOD


def _worst_case(gains: Gains) -> Array:
    """The stored sequence, of energy 1, or where the file has none that of a new search."""
    from designer.gain.worst_case import worst_for

    return worst_for(gains).w if gains.worst_case is None else gains.worst_case


def _progress(runs: int) -> Callable[[int], None]:
    """Says how many runs are done, every other second."""
    shown = time.monotonic()

    def show(done: int) -> None:
        nonlocal shown
        if done < runs and time.monotonic() >= shown + 2.0:
            shown = time.monotonic()
            print(f"{done} of {runs} runs", file=sys.stderr)

    return show


def _facts(ensemble: Ensemble) -> dict[str, Any]:
    import numpy as np

    from designer.simulation import CONFIDENCE

    peaks, closest = ensemble.peaks, ensemble.closest
    median, p95 = np.quantile(peaks, [0.5, 0.95], method="higher")
    single_bound = float(np.sqrt(ensemble.bound[-1]))
    return {
        "gamma": ensemble.gamma,
        "confidence": CONFIDENCE,
        "start": ensemble.start,
        "peak": _step(ensemble, int(np.argmax(ensemble.mean))),
        "closest": None if closest is None else _step(ensemble, closest),
        "gain": None
        if closest is None or ensemble.start
        else float(np.sqrt(ensemble.mean[closest] / ensemble.energy[closest])),
        "refuted": ensemble.refuted_at is not None,
        "refuted_at": ensemble.refuted_at,
        "single": {
            "median": float(median),
            "p95": float(p95),
            "largest": float(peaks.max()),
            "bound": single_bound,
            "above": int((peaks > single_bound).sum()),
        },
    }


def _step(ensemble: Ensemble, k: int) -> dict[str, Any]:
    return {
        "step": k,
        "mean_square": float(ensemble.mean[k]),
        "low": float(ensemble.low[k]),
        "high": float(ensemble.high[k]),
        "least": float(ensemble.least[k]),
        "energy": float(ensemble.energy[k]),
        "bound": float(ensemble.bound[k]),
    }


def _text(facts: dict[str, Any]) -> str:
    from designer.ladder import rounded_up

    peak, closest, single = facts["peak"], facts["closest"], facts["single"]
    root = "gamma sqrt(energy) + start" if facts["start"] else "gamma sqrt(energy)"
    bound = f"({root})^2" if facts["start"] else "gamma^2 energy"
    last = facts["seed"] + facts["runs"] - 1
    lines = [
        f"{facts['problem']}, {facts['runs']} runs of {facts['steps']} steps, seeds {facts['seed']} to {last}, "
        f"disturbance {facts['disturbance']}, {facts['seconds']:.1f} s",
        f"peak       {_interval(peak, bound)}",
    ]
    if facts["start"]:
        left = rounded_up(facts["start"])
        lines += [f"start      the initial error alone leaves {left} of sqrt(E|z~|^2) at most, which is proved"]
    if facts["steady"] is not None:
        lines += [f"steady     mean |z~|^2 = {facts['steady']:.6g} in the long run, computed from this white noise"]
    if closest is None and facts["start"]:
        lines += ["bound      that of the start alone: there is no disturbance"]
    elif closest is None:
        lines += ["bound      0: no disturbance comes before these steps, and gamma allows for no error without one"]
    else:
        lines += [
            f"closest    {_interval(closest, bound)}, {_of_bound(closest)}",
        ]
    if facts["gain"] is not None:
        lines += [
            f"gain       {facts['gain']:.6g} there, the root of mean over energy; gamma is {facts['gamma']:.6g}"
            + ("" if facts["claimed"] else ", which the file does not claim"),
        ]
    lines += [
        f"one run    largest |z~|: median {single['median']:.4g}, 95 % below {single['p95']:.4g}, "
        f"largest {single['largest']:.4g}; {root} {single['bound']:.4g}",
        f"           {single['above']} of {facts['runs']} runs exceed that; they may: gamma bounds the mean over runs",
    ]
    if facts["refuted"]:
        lines += [f"REFUTED    gamma = {facts['gamma']:.6g}: at step {facts['refuted_at']} the mean square is larger"]
    else:
        lines += ["not refuted, which proves nothing; peakmesh verify does"]
    lines += [
        f"confidence {100.0 * facts['confidence']:.0f} % for all steps at once; "
        "intervals by the central limit theorem,",
        "           upper ends too low where few runs carry the mean;",
        "           what refutes is a lower bound of the mean that holds for every distribution",
    ]
    lines += [f"steps      {facts['output']}"] if facts["output"] is not None else []
    return "\n".join(lines)


def _of_bound(at: dict[str, Any]) -> str:
    ratio = at["mean_square"] / at["bound"]
    return f"{100.0 * ratio:.1f} % of it" if ratio < 10.0 else f"{ratio:.3g} times as much"


def _interval(at: dict[str, Any], bound: str) -> str:
    return (
        f"mean |z~|^2 = {at['mean_square']:.6g} at step {at['step']}, in [{at['low']:.6g}, {at['high']:.6g}]; "
        f"{bound} {at['bound']:.6g}"
    )


def _table(ensemble: Ensemble) -> str:
    """One row for each step; numbers in the shortest decimals that give back the float."""
    columns = (ensemble.mean, ensemble.low, ensemble.high, ensemble.least, ensemble.energy, ensemble.bound)
    rows = zip(range(len(ensemble.mean)), *(column.tolist() for column in columns), strict=True)
    header = "step,mean_square,low,high,least,energy,bound"
    return "\n".join([header, *(",".join(map(repr, row)) for row in rows)]) + "\n"


def _finite(facts: Any) -> Any:
    """The same with None for what JSON has no number for."""
    if isinstance(facts, dict):
        return {key: _finite(value) for key, value in facts.items()}
    return None if isinstance(facts, float) and not math.isfinite(facts) else facts
