"""Where filters were told other probabilities than the network has: against every outcome of one step."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from made_recordings import random_gains, real_problem

from agent.contract.arrays import Array
from agent.contract.problem import Problem
from designer.gain.exact import Operator
from designer.model.error_model import error_model, stacked_gains
from designer.model.mismatch import error_model_of


def other(problem: Problem) -> Problem:
    """The same network with other losses and deliveries."""
    document = problem.document()
    for node in document["node"]:
        node["arrival_probability"] = 0.65
    for number, link in enumerate(document.get("link", ())):
        link["delivery_probability"] = 0.5 + 0.1 * number
    return Problem.from_document(document)


def moment(problem: Problem, told: Array, gains: tuple[Array, Array], Y: Array, s: int, eta: Array, w: Array) -> float:
    """E eta(k+1)'Y eta(k+1) from (1)-(5), by every theta and phi, with what each node computes."""
    (K_bar, H_bar), nx, n = gains, problem.nx, problem.n
    x, e = eta[:nx], eta[nx:].reshape(n, nx)
    x_hat, links = x - e, [(i, j) for i in range(n) for j in problem.neighbours(s, i) if i != j]
    lossy = [(i, j) for i, j in links if problem.delivery[i, j] < 1.0]
    ends = np.cumsum([0] + [len(node.C) for node in problem.nodes])
    total = 0.0
    for outcome in product((0.0, 1.0), repeat=n + len(lossy)):
        theta, phi = outcome[:n], dict(zip(lossy, outcome[n:], strict=True))
        chance = np.prod([b if t else 1.0 - b for t, b in zip(theta, problem.beta, strict=True)])
        chance *= np.prod([problem.delivery[at] if got else 1.0 - problem.delivery[at] for at, got in phi.items()])
        after = np.zeros((n, nx))
        for i in range(n):
            for j in problem.neighbours(s, i):
                node, got = problem.nodes[j], phi.get((i, j), 1.0)
                if node.seen:
                    nu = theta[j] * (node.C @ (x - x_hat[j]) + node.D @ w)
                else:
                    nu = theta[j] * node.C @ x + node.D @ w - told[j] * node.C @ x_hat[j]
                K_ij = K_bar[s, i * nx : (i + 1) * nx, j * nx : (j + 1) * nx]
                H_ij = H_bar[s, i * nx : (i + 1) * nx, ends[j] : ends[j + 1]]
                after[i] += K_ij @ (got * x_hat[j] + (1.0 - got) * x_hat[i]) + got * H_ij @ nu
        x_next = problem.plant.A @ x + problem.plant.B @ w
        eta_next = np.concatenate([x_next, (x_next - after).reshape(-1)])
        total += chance * float(eta_next @ Y @ eta_next)
    return total


@pytest.mark.parametrize("seen", [True, False])
@pytest.mark.parametrize("links", [True, False])
def test_its_moments_are_those_of_every_outcome(seen: bool, links: bool) -> None:
    problem = real_problem(4, seen=seen, links=links, unbiased=False, ny=(1, 2, 1), modes=2)
    truth, gains = other(problem), stacked_gains(random_gains(problem))
    model = error_model_of(truth, problem.beta, *gains)
    rng, operator = np.random.default_rng(0), Operator(model)
    half = rng.normal(size=(model.modes, model.size, model.size))
    S = operator.joint(half @ half.swapaxes(1, 2))
    plain = Operator(error_model(truth, *gains)).joint(half @ half.swapaxes(1, 2))
    for s in range(model.modes):
        eta, w = rng.normal(size=model.size), rng.normal(size=model.nw)
        both = np.concatenate([eta, w])
        right = moment(truth, problem.beta, gains, half[s] @ half[s].T, s, eta, w)
        assert both @ S[s] @ both == pytest.approx(right, rel=1e-12)
        assert both @ plain[s] @ both != pytest.approx(right, rel=1e-3)  # the mutant whose filters know the truth


def test_filters_that_were_told_the_truth_have_the_model_of_the_file() -> None:
    problem = real_problem(4, seen=False, links=True, unbiased=False, ny=(1, 1), modes=2)
    gains = stacked_gains(random_gains(problem))
    assert (error_model_of(problem, problem.beta, *gains).A == error_model(problem, *gains).A).all()
