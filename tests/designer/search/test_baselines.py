"""Gains to be compared with: certified like all, what they are made of, and refused in a sentence where errors grow."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from networks import random_problem, real_networks

from agent.contract.errors import Unattainable
from agent.contract.problem import Problem
from designer.cli import main
from designer.gain.noise import steady_state
from designer.ladder import rounded_up
from designer.model.error_model import error_model, stacked_gains
from designer.problems import find
from designer.proof.certificate import verify
from designer.search import baselines
from designer.search.baselines import BASELINES
from designer.search.starts import consensus_gains, diffusion_gains
from designer.synthesis import design


@pytest.mark.parametrize("method", BASELINES)
def test_a_baseline_is_certified_like_every_design(method: str) -> None:
    problem = real_networks(4)["unbiased, some seen, links"]
    gains = design(problem, method=method)
    assert gains.method == method
    assert verify(gains).holds
    assert gains.certificate.floor is not None
    assert gains.certificate.exact is not None


def test_gains_of_least_variance_have_the_least_noise() -> None:
    """Of the methods; and not the least gamma."""
    problem = find("zhu2020-lossy")
    noise, gamma = {}, {}
    for method in (*BASELINES, "decomposed"):
        gains = design(problem, method=method)
        found = steady_state(error_model(problem, *stacked_gains(gains)), initial=0)
        assert found is not None
        noise[method], gamma[method] = found.total, gains.certificate.gamma
    assert min(noise, key=lambda method: noise[method]) == "least-variance"
    assert gamma["least-variance"] == pytest.approx(0.2558, rel=1e-3)
    assert gamma["decomposed"] == pytest.approx(0.3163, rel=1e-3)
    assert noise["decomposed"] == pytest.approx(0.1304, rel=1e-2)


def test_diffusion_is_the_mean_of_what_each_filter_makes_alone() -> None:
    """Each x_hat_j moves by A and by its own gain, the one that it has where it is alone, and all are shared."""
    problem = random_problem(8)
    K_bar, H_bar = diffusion_gains(problem)
    nx, at = problem.nx, np.cumsum([0, *(len(node.C) for node in problem.nodes)])
    for j, node in enumerate(problem.nodes):
        document = problem.document()
        alone = Problem.from_document(
            document
            | {
                "node": [document["node"][j]],
                "topology": [{"name": "m0", "adjacency": [[1.0]]}],
                "markov": {"transition": [[1.0]], "initial": "m0"},
            }
        )
        _, own = consensus_gains(alone)
        for s in range(2):
            for i in range(problem.n):
                heard, rows = problem.neighbours(s, i), slice(i * nx, (i + 1) * nx)
                share = 1.0 / len(heard) if j in heard else 0.0
                columns = slice(int(at[j]), int(at[j]) + len(node.C))
                np.testing.assert_allclose(K_bar[s, rows, j * nx : (j + 1) * nx], share * problem.plant.A)
                np.testing.assert_allclose(H_bar[s, rows, columns], share * own[0], atol=1e-12)


def test_a_baseline_that_lets_errors_grow_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    """In a sentence, and for a reason of its own; nothing is relaxed to find another."""
    with pytest.raises(Unattainable, match=r"consensus is no method for zhu2020-ideal: .* not mean-square stable"):
        design(find("zhu2020-ideal"), method="consensus")
    problem = find("inverted-pendulum")
    K_bar, H_bar = diffusion_gains(problem)
    monkeypatch.setitem(baselines.BASELINES, "diffusion", lambda problem: (K_bar, np.full_like(H_bar, np.inf)))
    with pytest.raises(Unattainable, match="diffusion has no gains for inverted-pendulum: its Riccati"):
        design(problem, method="diffusion")


def test_analyse_ranks_gains_against_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A file and methods, the least gamma first, those without one last, each with its noise; as text and as JSON."""
    monkeypatch.chdir(tmp_path)
    for method in ("diffusion", "least-variance"):
        assert main(["design", "zhu2020-ideal", "--method", method, "-o", f"{method}.json"]) == 0
    words = ["analyse", "zhu2020-ideal", "--gains", "diffusion.json"]
    words += ["--against", "consensus", "--against", "least-variance.json", "--against", "least-variance"]
    capsys.readouterr()
    assert main([*words, "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["against"]
    assert [row["gains"] for row in rows] == ["least-variance.json", "least-variance", "diffusion.json", "consensus"]
    assert rows[0]["gamma"] == rows[1]["gamma"] < rows[2]["gamma"]
    assert rows[0]["white_noise"] == rows[1]["white_noise"] < rows[2]["white_noise"]
    assert (rows[3]["gamma"], rows[3]["white_noise"]) == (None, None)
    assert main(words) == 0
    table = capsys.readouterr().out.partition("\n\n")[2].splitlines()
    assert [line.split()[0] for line in table] == ["gamma,", *(rounded_up(row["gamma"]) for row in rows[:3]), "-"]
    assert "consensus: consensus is no method for zhu2020-ideal" in table[4]
    assert main([*words, "--against", "magic"]) == 2
    assert '--against magic: neither a file nor a method; the methods are "theorem2"' in capsys.readouterr().err
