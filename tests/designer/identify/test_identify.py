"""Runs whose model is right are refused as rarely as is said, and wrong models are found."""

from __future__ import annotations

import json
import math
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from made_recordings import random_gains, real_problem, record, simulate
from places import ROOT

from agent.contract.errors import EXIT_GOOD, EXIT_INPUT, EXIT_NO
from agent.contract.gains import Gains
from agent.contract.problem import Problem
from designer.box.extent import box_in
from designer.cli import main
from designer.identify.counts import Count, Counts, counts_of, total
from designer.identify.estimate import observed, tolerant, total_variation
from designer.identify.fit import Finding, findings, interval, likelihood_ratio
from designer.problems import find, names
from designer.problems.written import to_toml
from designer.replay.log import load

PROBLEM = real_problem(6, seen=True, links=True, unbiased=False, ny=(1, 1, 1), modes=3)
LEVEL = 0.1
GOLDEN = ROOT / "recordings" / "golden" / "zhu2020-lossy.mcap"


def with_(problem: Problem, *, beta: float | None = None, rho: float | None = None) -> Problem:
    """The problem with other probabilities at its second node, and on its first link."""
    document = problem.document()
    if beta is not None:
        document["node"][1]["arrival_probability"] = beta
    if rho is not None:
        document["link"][0]["delivery_probability"] = rho
    return Problem.from_document(document)


def drawn(problem: Problem, *, logs: int, steps: int, seed: int) -> list[Counts]:
    """Counts of so many runs of the model, the chain step by step."""
    rng, modes = np.random.default_rng(seed), len(problem.mode_names)
    rows = problem.markov.transition.cumsum(axis=1)[:, :-1]
    r, transitions = np.zeros(logs, dtype=np.int64), np.zeros((logs, modes, modes), dtype=np.int64)
    for _ in range(steps):
        to = (rng.random((logs, 1)) >= rows[r]).sum(axis=1)
        np.add.at(transitions, (np.arange(logs), r, to), 1)
        r = to
    arrivals = rng.binomial(steps, problem.beta, (logs, problem.n))
    links = [(problem.node_index(link.receiver), problem.node_index(link.sender)) for link in problem.links or ()]
    return [
        Counts(
            tuple(Count(int(hits), steps) for hits in arrivals[k]),
            {link: Count(int(rng.binomial(steps // 2, problem.delivery[link])), steps // 2) for link in links},
            transitions[k],
        )
        for k in range(logs)
    ]


def accused(problem: Problem, counts: list[Counts]) -> list[list[Finding]]:
    """What does not fit, of every run."""
    return [[found for found in findings(problem, of_run, level=LEVEL) if not found.fits] for of_run in counts]


@pytest.fixture(autouse=True)
def _few_simulated(monkeypatch: pytest.MonkeyPatch) -> None:
    """Enough for the level of these tests."""
    monkeypatch.setattr("designer.identify.fit._SIMULATED", 1_000)


# the test of the test
def test_a_right_model_is_refused_at_the_stated_rate() -> None:
    logs = 300
    refused = sum(map(bool, accused(PROBLEM, drawn(PROBLEM, logs=logs, steps=150, seed=1))))
    rate, error = refused / logs, (LEVEL * (1.0 - LEVEL) / logs) ** 0.5
    assert rate <= LEVEL + 3.0 * error
    assert rate >= LEVEL / 4.0  # and not hardly ever, which anybody could promise


@pytest.mark.parametrize(
    ("wrong", "what"),
    [({"beta": 0.62}, 'arrivals at node "n1"'), ({"rho": 0.35}, "deliveries from")],
)
def test_a_wrong_probability_is_found_and_named(wrong: dict[str, float], what: str) -> None:
    found = accused(PROBLEM, drawn(with_(PROBLEM, **wrong), logs=20, steps=400, seed=2))
    assert sum(any(finding.what.startswith(what) for finding in of_run) for of_run in found) >= 19


def test_a_wrong_row_is_found_and_named() -> None:
    document = PROBLEM.document()
    row = np.array(document["markov"]["transition"][0])
    document["markov"]["transition"][0] = (0.5 * row + 0.5 * np.roll(row, 1)).tolist()
    found = accused(PROBLEM, drawn(Problem.from_document(document), logs=20, steps=600, seed=3))
    assert sum(any(finding.what.endswith('"mode-0"') for finding in of_run) for of_run in found) >= 18


def test_without_a_hand_on_multiplicity_the_rate_is_missed() -> None:
    """The mutant that tests each at the whole level: so the rate above means something."""
    several = drawn(PROBLEM, logs=150, steps=150, seed=1)
    alone = [any(f.p is not None and f.p <= LEVEL for f in findings(PROBLEM, c, level=LEVEL)) for c in several]
    assert sum(alone) / len(alone) > LEVEL + 4.0 * (LEVEL * (1.0 - LEVEL) / len(alone)) ** 0.5


def test_what_cannot_happen_is_no_matter_of_chance() -> None:
    nothing = Counts((Count(0, 0),) * 3, {}, np.zeros((3, 3), dtype=np.int64))
    sure = with_(PROBLEM, beta=1.0)
    lost = nothing._replace(arrivals=(Count(0, 0), Count(999, 1000), Count(0, 0)))
    assert [found.what for found in findings(sure, lost, level=0.001) if not found.fits] == ['arrivals at node "n1"']
    assert likelihood_ratio(np.array([5, 0, 1]), np.array([0.5, 0.5, 0.0]), 100, np.random.default_rng(0)) == 0.0
    assert all(found.fits and found.p is None for found in findings(PROBLEM, nothing, level=0.1))


def test_intervals_hold_the_probability_as_often_as_they_say() -> None:
    """Summed over every outcome of n trials."""
    from scipy.stats import binom

    for n, p in ((1, 0.3), (7, 0.79), (40, 0.02), (40, 0.5)):
        inside = [low <= p <= high for low, high in (interval(Count(k, n), LEVEL) for k in range(n + 1))]
        assert binom.pmf(np.arange(n + 1), n, p)[inside].sum() >= 1.0 - LEVEL
    assert interval(Count(0, 10), 0.1)[0] == 0.0
    assert interval(Count(10, 10), 0.1)[1] == 1.0


def test_the_p_value_of_a_row_is_that_of_enumeration() -> None:
    """Two outcomes, six exits: the probability of every count that is at most as likely by the ratio."""
    from scipy.stats import binom

    pi, n, hits = 0.3, 6, np.arange(7)
    with np.errstate(divide="ignore", invalid="ignore"):
        parts = [np.nan_to_num(k * np.log(k / (n * q))) for k, q in ((hits, pi), (n - hits, 1.0 - pi))]
    ratio = parts[0] + parts[1]
    for k in hits:
        right = binom.pmf(hits, n, pi)[ratio >= ratio[k] - 1e-12].sum()
        p = likelihood_ratio(np.array([k, n - k]), np.array([pi, 1.0 - pi]), 40_000, np.random.default_rng(1))
        assert p == pytest.approx(right, abs=0.012)


# logs
def made(path: Path, *, truth: Problem, steps: int = 400, seed: int = 1, file: Problem = PROBLEM) -> Path:
    """A run of `truth` whose file says that it was one of `file`."""
    sent = simulate(random_gains(truth), steps=steps, seed=seed)
    return record(path, random_gains(file), sent, steps=steps, seed=seed, run=path.stem)


def test_counts_are_those_of_what_was_sent(tmp_path: Path) -> None:
    sent = simulate(random_gains(PROBLEM), steps=200)
    log = load(record(tmp_path / "a.mcap", random_gains(PROBLEM), sent, steps=200))
    counts = counts_of(log)
    arrived = np.array([message.document["arrived"] for message in sent if message.topic == "plant/state"])
    assert counts.arrivals == tuple(Count(int(hits), 200) for hits in arrived.sum(axis=0))
    modes = [message.document["mode"] for message in sent if message.topic == "mode"]
    expected = {pair: list(pairwise(modes)).count(pair) for pair in set(pairwise(modes))}
    names_ = PROBLEM.mode_names
    assert {(s, t): int(counts.transitions[names_.index(s), names_.index(t)]) for s, t in expected} == expected
    assert counts.transitions.sum() == 199
    for (i, j), count in counts.deliveries.items():
        heard = [m.document["heard"] for m in sent if m.topic == f"node/n{i}/estimate"][1:]
        asked = [j in PROBLEM.neighbours(names_.index(mode), i) for mode in modes[:-1]]
        assert count == Count(sum(f"n{j}" in names for names in heard), sum(asked))
    assert total([counts, counts]).arrivals[1] == Count(2 * counts.arrivals[1].hits, 400)


def test_a_real_sensor_tells_of_seen_losses_alone(tmp_path: Path) -> None:
    y = [[1.0] if k % 4 else [] for k in range(40)]
    problem = real_problem(6, seen=True, links=False, unbiased=False, ny=(1, 1, 1), modes=3)
    gains = random_gains(problem)
    sent = simulate(gains, steps=40, real_y={"n1": y, "n0": [[1.0]] * 40})
    log = load(record(tmp_path / "a.mcap", gains, sent, steps=40, external="n0,n1"))
    assert counts_of(log).arrivals[:2] == (Count(0, 0), Count(30, 40))


def test_identify_says_what_does_not_fit(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    wrong = made(tmp_path / "wrong.mcap", truth=with_(PROBLEM, beta=0.5))
    assert main(["identify", str(wrong), "--json"]) == EXIT_NO
    found = json.loads(capsys.readouterr().out)
    assert [finding["what"] for finding in found["findings"] if not finding["fits"]] == ['arrivals at node "n1"']
    right = [str(made(tmp_path / f"{seed}.mcap", truth=PROBLEM, seed=seed)) for seed in (1, 2)]
    assert main(["identify", *right]) == EXIT_GOOD
    assert "2 runs, 800 steps: nothing speaks against the model" in capsys.readouterr().out


def test_the_problem_with_the_estimates_is_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run, output = made(tmp_path / "run.mcap", truth=with_(PROBLEM, beta=0.5)), tmp_path / "problem.toml"
    assert main(["identify", str(run), "-o", str(output)]) == EXIT_NO
    counts, problem = counts_of(load(run)), Problem.load(output)
    assert problem.beta[1] == counts.arrivals[1].share
    for (i, j), count in counts.deliveries.items():
        assert problem.delivery[i, j] == count.share
    exits = counts.transitions
    assert problem.markov.transition == pytest.approx(exits / exits.sum(axis=1, keepdims=True))
    assert (problem.plant.A == PROBLEM.plant.A).all()
    assert main(["identify", str(run), "-o", str(output)]) == EXIT_INPUT
    assert "exists already" in capsys.readouterr().err


def test_runs_of_other_gains_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = made(tmp_path / "run.mcap", truth=PROBLEM, steps=20)
    assert main(["identify", str(run), str(GOLDEN)]) == EXIT_INPUT
    assert "has other gains than" in capsys.readouterr().err


def test_what_never_came_has_no_problem_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    gains, output = random_gains(PROBLEM), tmp_path / "problem.toml"
    sent = [
        message._replace(document=message.document | {"arrived": [1, 0, 1]})
        if message.topic == "plant/state"
        else message
        for message in simulate(gains, steps=30)
    ]
    run = record(tmp_path / "run.mcap", gains, sent, steps=30)
    assert main(["identify", str(run), "-o", str(output)]) == EXIT_INPUT
    assert 'no measurement of node "n1" arrived in 30 steps' in capsys.readouterr().err
    assert not output.exists()
    assert main(["identify", str(run)]) == EXIT_NO


@pytest.mark.parametrize("name", names())
def test_every_problem_is_written_as_it_is_read(name: str, tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text(to_toml(find(name)))
    assert Problem.load(tmp_path / "a.toml").digest() == find(name).digest()


def test_a_disturbance_that_is_a_table_is_written_beside(tmp_path: Path) -> None:
    document = PROBLEM.document()
    document["disturbance"] = {"kind": "csv", "file": "w.csv", "values": [[0.1, 1e-7], [2.5, -3.0]]}
    problem = Problem.from_document(document)
    run = made(tmp_path / "run.mcap", truth=problem, file=problem, steps=60)
    assert main(["identify", str(run), "-o", str(tmp_path / "new.toml")]) == EXIT_GOOD
    assert (Problem.load(tmp_path / "new.toml").disturbance.values == problem.disturbance.values).all()


def test_what_was_observed_of_nothing_is_the_model() -> None:
    nothing = Counts((Count(0, 0),) * 3, {}, np.zeros((3, 3), dtype=np.int64))
    assert observed(PROBLEM, nothing).digest() == PROBLEM.digest()


def test_the_gain_as_observed_is_that_of_filters_with_the_old_beta(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["identify", str(GOLDEN), "--json"]) == EXIT_GOOD
    found, gains = json.loads(capsys.readouterr().out), Gains.load(GOLDEN.with_suffix(".gains.json"))
    low, high = found["exact_as_designed"]
    assert low < high < gains.certificate.gamma
    assert found["exact_as_observed"][1] != pytest.approx(high, rel=1e-3)


def inside(problem: Problem, truth: Problem) -> bool:
    """Whether all true probabilities are within the tolerances of the problem, by their own definition."""
    box = box_in(problem)
    assert box is not None
    ends = {(part.matrix, part.at): (part.low, part.high) for part in box.intervals}
    assert len(ends) == (truth.beta < 1.0).sum() + (truth.delivery < 1.0).sum()
    within = [
        low <= (truth.beta if matrix == "beta" else truth.delivery)[at] <= high
        for (matrix, at), (low, high) in ends.items()
    ]
    assert problem.markov.tolerance is not None
    far = np.abs(problem.markov.transition - truth.markov.transition).sum(axis=1) / 2.0
    return all(within) and bool((far <= problem.markov.tolerance.transition).all())


def test_tolerances_have_all_true_probabilities_at_once_as_often_as_they_say() -> None:
    """At 1 - level or more; and they are not so wide that a wrong truth is in them."""
    every = drawn(PROBLEM, logs=120, steps=400, seed=5)
    found = [tolerant(observed(PROBLEM, counts), PROBLEM, counts, level=LEVEL) for counts in every]
    assert sum(not inside(problem, PROBLEM) for problem in found) <= 12 + 3 * math.sqrt(120 * 0.1 * 0.9)
    wrong = with_(PROBLEM, beta=0.3)
    assert not any(inside(problem, wrong) for problem in found)


def test_the_problem_that_is_written_is_a_box_around_what_was_observed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """So that the next command designs for it."""
    run, path = made(tmp_path / "run.mcap", truth=PROBLEM, steps=200), tmp_path / "new.toml"
    assert main(["identify", str(run), "-o", str(path)]) == EXIT_GOOD
    assert "tolerances of all probabilities at once, at 0.99" in capsys.readouterr().out
    problem = Problem.load(path)
    assert inside(problem, problem)


def test_tolerances_that_are_each_at_the_level_miss_the_truth_more_often() -> None:
    """The mutant without Bonferroni."""
    every = drawn(PROBLEM, logs=120, steps=400, seed=5)
    number = 14  # about what it divides by
    found = [tolerant(observed(PROBLEM, counts), PROBLEM, counts, level=LEVEL * number) for counts in every]
    assert sum(not inside(problem, PROBLEM) for problem in found) > 12 + 3 * math.sqrt(120 * 0.1 * 0.9)


def test_a_row_of_many_modes_is_narrower_than_its_entries_and_misses_as_seldom_as_it_says() -> None:
    """Of 4 entries; what nine times as many exits would say is too narrow."""
    pi, exits, level, rng = np.array([0.5, 0.2, 0.1, 0.2]), 176, 0.2, np.random.default_rng(1)
    drawn_rows = rng.multinomial(exits, pi, size=400)
    far = np.abs(drawn_rows / exits - pi).sum(axis=1) / 2.0
    said = np.array([total_variation([Count(int(hits), exits) for hits in row], level / 4) for row in drawn_rows])
    assert (far > said).mean() <= level
    entries = [interval(Count(int(hits), exits), level / 8) for hits in drawn_rows[0]]
    assert said[0] < 0.8 * sum(high - hits / exits for (_, high), hits in zip(entries, drawn_rows[0], strict=True))
    narrow = np.array([total_variation([Count(int(h), 9 * exits) for h in 9 * row], level / 4) for row in drawn_rows])
    assert (far > narrow).mean() > level
