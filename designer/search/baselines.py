"""Gains that others would take, of the form (5) like all, to be compared with: nothing is searched, all is proved."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from agent.contract.errors import Unattainable
from agent.contract.gains import Gains, Solver
from agent.contract.problem import Problem
from designer.model.error_model import StackedGains, link_gains
from designer.model.units import NaturalUnits
from designer.patience import Budget
from designer.search.exact_design import certify, certify_at_once
from designer.search.starts import consensus_gains, diffusion_gains, least_variance_gains

BASELINES: dict[str, Callable[[Problem], StackedGains]] = {
    "least-variance": least_variance_gains,
    "consensus": consensus_gains,
    "diffusion": diffusion_gains,
}


def design_baseline(problem: Problem, method: str, budget: Budget) -> Gains:
    """The gains of one of BASELINES with a certificate; Unattainable where they let errors grow."""
    started, natural = time.perf_counter(), NaturalUnits(problem)
    stacked = BASELINES[method](natural.problem)
    solved = time.perf_counter()
    if not all(np.isfinite(gains).all() for gains in stacked):
        raise Unattainable(f"{method} has no gains for {problem.name}: its Riccati equations have no finite solution")
    K, H = natural.back(*link_gains(natural.problem, *stacked))
    try:
        certificate = budget.to_its_end(
            lambda: certify(problem, K, H, budget=budget), lambda: certify_at_once(problem, K, H)
        )
    except Unattainable as error:
        raise Unattainable(f"{method} is no method for {problem.name}: {error}; --method exact searches") from None
    ended = time.perf_counter()
    return Gains.of(
        problem,
        K,
        H,
        method=method,
        certificate=certificate,
        solver=Solver(
            name="none, numpy",
            version=np.__version__,
            status=f"{method} gains, nothing was searched",
            iterations=0,
            seconds=solved - started,
        ),
        solve=solved - started,
        certify=ended - solved,
    )
