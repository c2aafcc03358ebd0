"""Ensembles: each run is that run, and what they say of the mean is what the moments of the error model say."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import math
from collections.abc import Callable
from functools import cache
from importlib.resources import files
from itertools import product
from pathlib import Path
from typing import Any

import networks
import numpy as np
import pytest
import runs
from made_recordings import (
    Sent,
    observer_gains,
    random_gains,
    random_problem,
    real_problem,
    record,
    simulate,
    uncertified,
)
from places import ROOT

from agent.contract.arrays import Array
from agent.contract.errors import InputError
from agent.contract.files import canonical
from agent.contract.gains import Certificate, Gains, Solver
from agent.contract.problem import Problem
from designer import simulation
from designer.cli import main
from designer.gain.exact import exact_gain
from designer.gain.worst_case import Disturbance, with_worst_case, worst_for
from designer.model.error_model import ErrorModel, error_model, link_gains, stacked_gains
from designer.replay import log, replay
from designer.simulation import Ensemble, Network, network_of, states

GOLDEN = ROOT / "recordings" / "golden"


def edited(gains: Gains, **changes: Any) -> Gains:
    """The gains with parts of their problem replaced, by their names in the file."""
    problem = Problem.from_document({**gains.problem.document(), **changes})
    return Gains.model_validate({**dict(gains), "problem": problem, "problem_digest": problem.digest()})


def model_of(gains: Gains) -> ErrorModel:
    return error_model(gains.problem, *stacked_gains(gains))


# one run
def assert_is_run(gains: Gains, seed: int, *, modes: list[str], x: Array, x_hat: Array) -> None:
    """Run 3 of an ensemble of 5 has these modes, x (steps, nx) and x_hat (steps, n nx)."""
    network = network_of(gains, steps=len(x))
    size = np.maximum(np.abs(x).max(axis=1), np.abs(x_hat).max(axis=1))
    largest = np.maximum.accumulate(np.maximum(1.0, size))  # a recording knows e = x - x_hat to the rounding of both
    for k, state in enumerate(states(network, range(seed - 3, seed + 2), steps=len(x))):
        e = np.tile(x[k], gains.problem.n) - x_hat[k]
        assert gains.problem.mode_names[state.mode[3]] == modes[k]
        assert np.abs(state.e[3] - e).max() <= 1e-12 * largest[k], k
        if network.carries_plant:
            assert np.abs(state.x[3] - x[k]).max() <= 1e-12 * largest[k], k


def assert_is_made_run(gains: Gains, sent: list[Sent], *, seed: int) -> None:
    """The same of messages in the order of their steps."""

    def column(topic: str, key: str) -> list[Any]:
        return [message.document[key] for message in sent if message.topic == topic]

    x_hat = np.hstack([column(f"node/{name}/estimate", "x_hat") for name in gains.problem.node_names])
    assert_is_run(gains, seed, modes=column("mode", "mode"), x=np.array(column("plant/state", "x")), x_hat=x_hat)


def test_a_run_of_the_ensemble_is_a_recording_of_real_processes() -> None:
    live = log.load(GOLDEN / "zhu2020-lossy.mcap")
    gains = live.gains
    assert live.seed >= 3
    modes = [live.modes.texts[number] for number in live.mode]
    assert_is_run(gains, live.seed, modes=modes, x=live.x, x_hat=live.x_hat)


@pytest.mark.parametrize(
    "disturbance",
    [
        {"kind": "white", "deviation": 2.0},
        {"kind": "damped-sine", "decay": 0.05},
        {"kind": "impulse", "at": 3},
        {"kind": "csv", "file": "w.csv", "values": [[1.0, -2.0, 0.5], [0.0, 3.0, 1.0]]},
        {"kind": "worst-case", "amplitude": 3.0},
    ],
    ids=lambda disturbance: disturbance["kind"],
)
def test_run_r_has_the_draws_of_a_live_run_with_seed_S_plus_r(disturbance: dict[str, Any]) -> None:
    problem = random_problem(5, nx=3, nw=3, ny=(1, 2, 1, 3), modes=3)
    gains = with_worst_case(edited(random_gains(problem), disturbance=disturbance))
    assert_is_made_run(gains, simulate(gains, steps=300, seed=9), seed=9)


@pytest.mark.parametrize(
    ("radius", "seen", "links", "unbiased"),
    [(0.85, *flags) for flags in product((False, True), repeat=3) if any(flags)]
    + [(1.05, True, False, True), (1.05, True, True, True)],
)
def test_a_run_has_the_losses_that_nodes_see_and_the_messages_that_links_lose(
    radius: float, seen: bool, links: bool, unbiased: bool
) -> None:
    """With an unstable plant the errors stay what they are while x grows."""
    problem = real_problem(4, radius=radius, seen=seen, links=links, unbiased=unbiased)
    gains = observer_gains(problem) if unbiased else random_gains(problem)
    assert_is_made_run(gains, simulate(gains, steps=100, seed=11), seed=11)


# the mean over runs
def sticky(**changes: Any) -> Problem:
    """Two nodes that seldom hear each other, the first one with half its measurements lost."""
    document = {
        "name": "sticky",
        "plant": {"A": [[0.95]], "B": [[1.0, 0.0, 0.0]], "M": [[1.0]]},
        "node": [
            {"name": "good", "C": [[1.0]], "D": [[0.0, 0.2, 0.0]], "arrival_probability": 0.5},
            {"name": "poor", "C": [[0.01]], "D": [[0.0, 0.0, 1.0]], "arrival_probability": 1.0},
        ],
        "topology": [{"name": "together", "hears": {"poor": ["good"]}}, {"name": "apart", "hears": {}}],
        "markov": {"transition": [[0.9, 0.1], [0.05, 0.95]], "initial": "together"},
    }
    return Problem.from_document({**document, **changes})


def claiming(gains: Gains, gamma: float) -> Gains:
    """The gains with a certificate of this gamma."""
    return gains.model_copy(
        update={"certificate": gains.certificate.model_copy(update={"gamma": gamma, "holds": True})}
    )


CASES = {
    "paper": lambda: Gains.load(GOLDEN / "zhu2020-lossy.gains.json"),
    "hidden": lambda: observer_gains(networks.random_problem(1)),
    "sticky": lambda: observer_gains(sticky()),
    "seen and lossy links": lambda: observer_gains(
        networks.real_network(networks.random_problem(2), seen=True, delivery=0.7)
    ),
    "some seen, unbiased": lambda: observer_gains(
        networks.real_network(networks.random_problem(3), seen=["n1"], delivery=0.8, unbiased=True)
    ),
    "unstable": lambda: observer_gains(
        networks.real_network(networks.random_problem(0), seen=True, delivery=0.8, unbiased=True, radius=1.05)
    ),
}
DISTURBANCES = [{"kind": "white", "deviation": 0.7}, {"kind": "damped-sine", "decay": 0.1}]


def mean_squares(gains: Gains, *, steps: int) -> Array:
    """E|z_tilde(k)|^2, (steps,), by the moments of (10): no simulation, and none of its arithmetic."""
    model, problem = model_of(gains), gains.problem
    network = network_of(gains, steps=steps)
    noise = [[(a, model.F_i(s, i)) for i, a in enumerate(model.alpha)] for s in range(model.modes)]
    for term in range(0 if model.links is None else len(model.links.mode)):
        assert model.links is not None
        noise[model.links.mode[term]].append((model.links.variance[term], model.V_l(term)))
    p = np.eye(model.modes)[problem.mode_index(problem.markov.initial)]
    m, S = np.zeros((model.modes, model.size)), np.zeros((model.modes, model.size, model.size))
    found = []
    for k in range(steps):
        found.append(float(np.trace(model.M @ S.sum(axis=0) @ model.M.T)))
        m_next, S_next = np.zeros_like(m), np.zeros_like(S)
        w = np.zeros(problem.nw) if isinstance(network.w, float) else network.w[k]
        ww = network.w**2 * np.eye(problem.nw) if isinstance(network.w, float) else np.outer(w, w)
        for s in range(model.modes):
            joint = np.block([[S[s], np.outer(m[s], w)], [np.outer(w, m[s]), p[s] * ww]])
            AB = np.hstack([model.A[s], model.B[s]])
            moved = AB @ joint @ AB.T + sum(variance * V @ joint @ V.T for variance, V in noise[s])
            m_next += np.outer(model.transition[s], AB @ np.concatenate([m[s], p[s] * w]))
            S_next += model.transition[s][:, None, None] * moved
        p, m, S = p @ model.transition, m_next, S_next
    return np.array(found)


def holds(ensemble: Ensemble, truth: Array) -> bool:
    """The intervals of all steps hold these means."""
    rounding = 1e-9 * truth  # where nothing depends on chance
    return bool(((ensemble.low - rounding <= truth) & (truth <= ensemble.high + rounding)).all())


@pytest.mark.parametrize(
    ("case", "disturbance"),
    [*((case, DISTURBANCES[0]) for case in CASES), ("sticky", DISTURBANCES[1]), ("unstable", DISTURBANCES[1])],
)
def test_the_intervals_hold_the_moments_of_the_error_model(case: str, disturbance: dict[str, Any]) -> None:
    gains = edited(CASES[case](), disturbance=disturbance)
    truth = mean_squares(gains, steps=30)
    assert truth[1:].max() > 0.0
    ensemble = simulation.simulate(gains, runs=2000, steps=30, processes=1)
    assert holds(ensemble, truth)
    assert not holds(ensemble, 1.1 * truth)


# what a wrong simulation is found by
def stationary(network: Network) -> Network:
    """Modes that are independent from step to step, each as frequent as in the chain."""
    transition = np.diff(network.cumulative, prepend=0.0, axis=1)
    share = np.linalg.matrix_power(transition, 10_000)
    return dataclasses.replace(network, cumulative=np.cumsum(share, axis=1))


WRONG_NETWORKS: dict[str, Callable[[Network], Network]] = {
    "modes are independent": stationary,
    "another first mode": lambda network: dataclasses.replace(network, initial=1 - network.initial),
    "losses are seen": lambda network: dataclasses.replace(network, seen=np.ones_like(network.seen)),
}
WRONG_DRAWS: dict[str, Callable[[Network], Network]] = {
    "losses too rare": lambda network: dataclasses.replace(network, beta=1.0 - (1.0 - network.beta) * 0.7),
    "losses too frequent": lambda network: dataclasses.replace(network, beta=network.beta * 0.8),
    "no link loses messages": lambda network: dataclasses.replace(network, rho=np.ones_like(network.rho)),
}
WRONG_SEEDS: dict[str, Callable[[range], list[int]]] = {
    "all runs alike": lambda seeds: [seeds[0]] * len(seeds),
}
MUTANTS = [*WRONG_NETWORKS, *WRONG_DRAWS, *WRONG_SEEDS]


def plant_mutant(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the simulation wrong in this way."""
    network, draws = simulation.network_of, simulation._draws
    wrong_network, wrong_draws = WRONG_NETWORKS.get(name), WRONG_DRAWS.get(name)
    wrong_seeds = WRONG_SEEDS.get(name)
    if wrong_network is not None:
        monkeypatch.setattr(simulation, "network_of", lambda *a, **b: wrong_network(network(*a, **b)))
    if wrong_draws is not None:
        monkeypatch.setattr(simulation, "_draws", lambda net, seeds, steps: draws(wrong_draws(net), seeds, steps))
    if wrong_seeds is not None:
        monkeypatch.setattr(simulation, "_draws", lambda net, seeds, steps: draws(net, wrong_seeds(seeds), steps))


LOSSY_LINK = [{"receiver": "poor", "sender": "good", "delivery_probability": 0.5}]


@pytest.mark.parametrize("mutant", ["none", *MUTANTS])
def test_the_moments_find_a_wrong_simulation(mutant: str, monkeypatch: pytest.MonkeyPatch) -> None:
    gains = edited(observer_gains(sticky(link=LOSSY_LINK)), disturbance={"kind": "white", "deviation": 1.0})
    truth = mean_squares(gains, steps=40)
    plant_mutant(mutant, monkeypatch)
    ensemble = simulation.simulate(gains, runs=3000, steps=40, processes=1)
    assert holds(ensemble, truth) == (mutant == "none")


# the worst fixed disturbance
@cache
def case_of(name: str) -> tuple[Gains, Disturbance]:
    """The gains of a case, claiming their exact gain, and the disturbance that is worst for them."""
    gains = CASES[name]()
    return claiming(gains, exact_gain(model_of(gains)).high), worst_for(gains)


def driven(gains: Gains, worst: Disturbance) -> Ensemble:
    return simulation.simulate(gains, runs=3000, steps=len(worst.w) + 5, w=worst.w, processes=1)


def comes_close(ensemble: Ensemble, worst: Disturbance) -> bool:
    """Driven by the worst case, the mean at its peak step is gain^2 within 3 %, and gamma is nowhere exceeded."""
    peak = len(worst.w)
    near = abs(ensemble.mean[peak] / worst.gain**2 - 1.0) < 0.03
    return near and ensemble.mean.argmax() == peak and bool((ensemble.low <= ensemble.bound).all())


@pytest.mark.parametrize("case", CASES)
def test_the_worst_case_comes_close_to_the_gain_and_never_exceeds_gamma(case: str) -> None:
    """And a gamma a tenth below that gain is refuted."""
    gains, worst = case_of(case)
    assert worst.gain <= gains.certificate.gamma
    ensemble = driven(gains, worst)
    assert comes_close(ensemble, worst)
    assert ensemble.refuted_at is None
    too_low = dataclasses.replace(ensemble, gamma=0.9 * worst.gain)
    assert too_low.least[len(worst.w)] > too_low.bound[len(worst.w)]
    assert too_low.refuted_at is not None


@pytest.mark.parametrize("mutant", ["modes are independent", "losses too rare", "losses too frequent"])
def test_the_worst_case_finds_a_wrong_simulation(mutant: str, monkeypatch: pytest.MonkeyPatch) -> None:
    gains, worst = case_of("sticky")
    plant_mutant(mutant, monkeypatch)
    assert not comes_close(driven(gains, worst), worst)


# what is refuted, and what is not
def ensemble_of(sizes: Array, *, gamma: float = 1.0) -> Ensemble:
    """What is said of |z_tilde(k)|^2 = sizes (runs, steps), told in three parts, with energy 1 before every step."""
    runs, steps = sizes.shape
    ignored = math.ceil(math.sqrt(runs * math.log(steps / 0.01) / 2.0))
    found = None
    for rows in np.array_split(sizes, min(3, runs)):
        part = rows.T
        largest, others = simulation._set_apart(part, ignored)
        squares = ((part - part.mean(axis=1, keepdims=True)) ** 2).sum(axis=1)
        tally = simulation.Tally(
            part.shape[1], part.mean(axis=1), squares, largest, others, part.mean(axis=1), np.sqrt(part.max(axis=0))
        )
        found = tally if found is None else simulation._together(found, tally, ignored)
    assert found is not None
    return simulation._ensemble(gamma, found, np.ones(steps))


def test_parts_together_are_the_whole() -> None:
    sizes = np.random.default_rng(1).lognormal(size=(200, 3))
    ensemble = ensemble_of(sizes)
    kept = 200 - math.ceil(math.sqrt(200 * math.log(3 / 0.01) / 2.0))
    half = 2.9352 * sizes.std(axis=0, ddof=1) / math.sqrt(200)  # 1 - 0.01 / 6 of the normal distribution lie below
    assert np.allclose(ensemble.mean, sizes.mean(axis=0), rtol=1e-12)
    assert np.allclose(ensemble.high - ensemble.mean, half, rtol=1e-4)
    assert np.allclose(ensemble.mean - ensemble.low, half, rtol=1e-4)
    assert np.allclose(ensemble.least, np.sort(sizes, axis=0)[:kept].sum(axis=0) / 200, rtol=1e-12)
    assert np.allclose(ensemble.peaks, np.sqrt(sizes.max(axis=1)))


@pytest.mark.parametrize("runs", [2, 10, 100, 1000])
@pytest.mark.parametrize("heavy", [False, True])
def test_chance_does_not_refute_what_is_true(runs: int, heavy: bool) -> None:
    """Means that are attained exactly: by values of which one in fifty is 0, and by heavy tails without variance."""
    rng, refuted = np.random.default_rng(runs), 0
    for _ in range(200):
        u = rng.random((runs, 1))
        sizes = (1.0 - u) ** (-1.0 / 1.5) / 3.0 if heavy else (u < 0.98) / 0.98  # Pareto's, exponent 1.5; both mean 1
        refuted += ensemble_of(sizes).refuted_at is not None
    assert refuted <= 6  # of 200, where one in a hundred is what may happen


def test_what_is_clearly_too_much_is_refuted() -> None:
    sizes = np.random.default_rng(2).exponential(size=(1000, 4)) * [0.5, 0.9, 1.5, 0.1]
    ensemble = ensemble_of(sizes)
    assert ensemble.refuted_at == 2
    assert ensemble_of(sizes, gamma=1.4).refuted_at is None


def exactly_measured() -> Gains:
    """Two nodes that measure w itself: their errors are the rounding of the gains, 2e-17 of w or less."""
    rng = np.random.default_rng(23)
    A, B = np.array([[0.19, 0.075], [-0.02, -0.8]]), rng.normal(size=(2, 2))
    sensor = {"C": np.zeros((2, 2)).tolist(), "D": np.eye(2).tolist(), "arrival_probability": 1.0}
    problem = Problem.from_document(
        {
            "name": "w-measured",
            "plant": {"A": A.tolist(), "B": B.tolist(), "M": [[0.83, 0.83]]},
            "node": [{"name": name, **sensor} for name in "ab"],
            "topology": [{"name": "t", "hears": {"b": ["a"]}}],
            "markov": {"transition": [[1.0]], "initial": "t"},
            "disturbance": {"kind": "white", "deviation": 1.0},
        }
    )  # fmt: skip
    other = B - 0.3 * B
    K = {"t": {"a": {"a": A}, "b": {"a": 0.3 * A, "b": A - 0.3 * A}}}
    H = {"t": {"a": {"a": B}, "b": {"a": 0.3 * B, "b": other}}}
    claim = Certificate(gamma=1e-20, kind="exact", form="summed", holds=True, verified="by hand", margins={})
    solver = Solver(name="none", version="-", status="by hand", iterations=0, seconds=0.0)
    parts = {"problem": problem, "problem_digest": problem.digest(), "method": "given", "seconds": {}}
    return Gains(**parts, K=K, H=H, certificate=claim, solver=solver)


def test_rounding_refutes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Errors of 1e-16 are its own rounding, so nothing is said of a gamma of 1e-20; it knows how much they may be."""
    gains = exactly_measured()
    assert simulation.simulate(gains, runs=400, steps=8).refuted_at is None
    monkeypatch.setattr(simulation, "_rounding", lambda *given: np.zeros(8))
    assert simulation.simulate(gains, runs=400, steps=8).refuted_at is not None


def test_errors_beyond_float64_refute() -> None:
    """Gains that let errors grow without end."""
    K, H = link_gains(sticky(), 3.0 * np.tile(np.eye(2), (2, 1, 1)), np.full((2, 2, 2), 0.5))
    gains = claiming(uncertified(sticky(), K, H, method="none"), 1.0)
    ensemble = simulation.simulate(gains, runs=20, steps=400, w=np.ones((1, 3)), processes=1)
    assert np.isinf(ensemble.mean[-1])
    assert ensemble.refuted_at is not None


def test_nothing_is_refuted_without_a_disturbance() -> None:
    ensemble = simulation.simulate(observer_gains(sticky()), runs=10, steps=5)
    assert ensemble.mean.tolist() == [0.0] * 5
    assert (ensemble.closest, ensemble.refuted_at) == (None, None)


# where the runs are computed
def equal(one: Ensemble, other: Ensemble) -> bool:
    return all(
        np.array_equal(getattr(one, field.name), getattr(other, field.name)) for field in dataclasses.fields(one)
    )


def test_figures_do_not_depend_on_who_computes_them(monkeypatch: pytest.MonkeyPatch, cluster: str) -> None:
    """One process, several, or a cluster."""
    monkeypatch.setattr(simulation, "CHUNK", 30)
    gains, done = CASES["seen and lossy links"](), list[int]()
    gains = edited(gains, disturbance=DISTURBANCES[0])
    alone = simulation.simulate(gains, runs=100, steps=50, seed=3, processes=1, progress=done.append)
    assert done == [30, 60, 90, 100]
    assert equal(alone, simulation.simulate(gains, runs=100, steps=50, seed=3, processes=2))
    assert equal(alone, simulation.simulate(gains, runs=100, steps=50, seed=3, dask=cluster))
    assert not equal(alone, simulation.simulate(gains, runs=100, steps=50, seed=4, processes=1))


def test_numbers_are_drawn_in_blocks_that_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    gains = edited(CASES["hidden"](), disturbance=DISTURBANCES[0])
    whole = simulation.simulate(gains, runs=10, steps=50, processes=1)
    monkeypatch.setattr(simulation, "NUMBERS", 700)
    assert equal(whole, simulation.simulate(gains, runs=10, steps=50, processes=1))


def test_one_run_is_no_ensemble() -> None:
    with pytest.raises(InputError, match="runs is 1; an interval for the mean takes at least 2"):
        simulation.simulate(observer_gains(sticky()), runs=1, steps=5)


# the disturbance kind "worst-case": in a gains file, a live run, a replay
def worst_gains(*, amplitude: float = 2.0, **sizes: Any) -> Gains:
    """Gains of a problem that asks for its worst case, with it."""
    problem = real_problem(2, **sizes)
    document = {**problem.document(), "disturbance": {"kind": "worst-case", "amplitude": amplitude}}
    return with_worst_case(observer_gains(Problem.from_document(document)))


def test_the_worst_case_is_stored_where_it_is_asked_for(tmp_path: Path) -> None:
    gains = worst_gains()
    assert gains.worst_case is not None
    assert (gains.worst_case**2).sum() == pytest.approx(1.0)
    gains.save(tmp_path / "gains.json")
    assert Gains.load(tmp_path / "gains.json") == gains
    asks_for_nothing = observer_gains(real_problem(2))
    assert with_worst_case(asks_for_nothing) is asks_for_nothing
    assert "worst_case" not in asks_for_nothing.document()


def test_a_design_stores_the_worst_case(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    problem = (files("designer.problems") / "two-nodes.toml").read_text()
    head, _, _ = problem.partition("[disturbance]")
    (tmp_path / "problem.toml").write_text(head + '[disturbance]\nkind = "worst-case"\n')
    path = tmp_path / "gains.json"
    assert main(["design", str(tmp_path / "problem.toml"), "--method", "decomposed", "-o", str(path)]) == 0
    gains = Gains.load(path)
    assert gains.worst_case is not None
    assert np.array_equal(gains.worst_case, worst_for(gains).w)


def test_the_worst_case_drives_a_live_run_and_replay_checks_it(tmp_path: Path) -> None:
    """As processes; and the run is that of the ensemble."""
    gains, recording = worst_gains(ny=(1, 2)), tmp_path / "run.mcap"
    gains.save(tmp_path / "gains.json")
    ran = runs.peakmesh("run", tmp_path / "gains.json", "--steps", 40, "--seed", 5, "-o", recording)
    assert ran.returncode == 0, ran.stderr
    assert replay(recording).exit_code == 0
    live = log.load(recording)
    assert gains.worst_case is not None
    assert np.array_equal(live.w[: len(gains.worst_case)], 2.0 * gains.worst_case[: len(live.w)])
    modes = [live.modes.texts[number] for number in live.mode]
    assert_is_run(gains, 5, modes=modes, x=live.x, x_hat=live.x_hat)


def test_replay_finds_another_disturbance_than_the_worst(tmp_path: Path) -> None:
    """A run that is right in all else, but was driven by w of the opposite sign."""
    gains = worst_gains()
    assert gains.worst_case is not None
    opposite = gains.model_copy(update={"worst_case": -gains.worst_case})
    sent = simulate(opposite, steps=30)
    assert replay(record(tmp_path / "true.mcap", opposite, sent, steps=30)).exit_code == 0
    first = replay(record(tmp_path / "false.mcap", gains, sent, steps=30)).first_divergence
    assert first is not None
    assert (first.proof, first.step, first.field) == (1, 0, "w[0]")


def test_gains_that_lack_the_worst_case_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    claiming(worst_gains(ny=(1, 2)), 100.0).model_copy(update={"worst_case": None}).save(tmp_path / "gains.json")
    sentence = 'the problem asks for disturbance kind "worst-case", but the gains have no worst_case; design them again'
    ran = runs.peakmesh("run", tmp_path / "gains.json", "--steps", 40, "-o", tmp_path / "run.mcap")
    assert (ran.returncode, ran.stderr.strip()) == (2, f"peakmesh: {sentence}")
    assert not (tmp_path / "run.mcap").exists()
    assert main(["simulate", str(tmp_path / "gains.json")]) == 2
    assert capsys.readouterr().err == f"peakmesh: {sentence}\n"
    few = ["--runs", "50", "--processes", "1"]
    assert main(["simulate", str(tmp_path / "gains.json"), "--disturbance", "worst-case", *few]) == 0


def test_a_worst_case_for_another_number_of_disturbances_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "gains.json"
    path.write_bytes(canonical(worst_gains().document() | {"worst_case": [[1.0] * 5] * 4}))
    with pytest.raises(InputError, match="worst_case is 4 x 5; it needs a column for each disturbance of the plant, 2"):
        Gains.load(path)


# the command
def simulate_command(folder: Path, *arguments: object, gains: Gains) -> int:
    """`peakmesh simulate`, in this process."""
    gains.save(folder / "gains.json", force=True)
    return main(["simulate", str(folder / "gains.json"), "--processes", "1", *map(str, arguments)])


KEYS = {
    "problem", "runs", "steps", "seed", "disturbance", "gamma", "claimed", "confidence", "peak", "closest", "gain",
    "refuted", "refuted_at", "single", "seconds", "steady", "output", "start",
}  # fmt: skip


def test_the_command_says_the_same_as_object_table_and_text(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    gains, worst = case_of("sticky")
    table = tmp_path / "steps.csv"
    arguments = ("--runs", 300, "--steps", 90, "--seed", 4, "--disturbance", "worst-case")
    assert simulate_command(tmp_path, *arguments, "--json", "-o", table, gains=gains) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts.keys() == KEYS
    assert (facts["refuted"], facts["refuted_at"], facts["disturbance"]) == (False, None, "worst-case")
    assert facts["gain"] == pytest.approx(worst.gain, rel=0.1)
    ensemble = simulation.simulate(gains, runs=300, steps=90, seed=4, w=worst.w)
    rows = list(csv.DictReader(io.StringIO(table.read_text())))
    assert [int(row["step"]) for row in rows] == list(range(90))
    columns = {"mean_square": "mean", **{name: name for name in ("low", "high", "least", "energy", "bound")}}
    for column, field in columns.items():
        assert [float(row[column]) for row in rows] == getattr(ensemble, field).tolist()
    at = facts["peak"]["step"]
    assert facts["peak"] == {key: (int if key == "step" else float)(rows[at][key]) for key in facts["peak"]}
    single = facts["single"]
    assert single["largest"] == ensemble.peaks.max()
    assert single["above"] == (ensemble.peaks > gains.certificate.gamma).sum() > 0
    assert (ensemble.peaks <= single["median"]).mean() >= 0.5
    assert (ensemble.peaks <= single["p95"]).mean() >= 0.95
    assert simulate_command(tmp_path, *arguments, gains=gains) == 0
    text = capsys.readouterr().out
    assert f"mean |z~|^2 = {facts['peak']['mean_square']:.6g} at step {at}" in text
    assert f"{single['above']} of 300 runs exceed that; they may" in text
    assert "not refuted" in text


def test_under_white_noise_the_steady_state_stands_beside_what_runs_came_to(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of the deviation that the problem gives, and within the interval of the last step; under another w it is null."""
    problem = sticky(disturbance={"kind": "white", "deviation": 3.0})
    gains = uncertified(problem, case_of("sticky")[0].K, case_of("sticky")[0].H, method="none")
    ensemble = simulation.simulate(gains, runs=400, steps=60, processes=1)
    steady = simulation.steady(gains)
    assert steady is not None
    assert ensemble.low[-1] < steady < ensemble.high[-1]
    simulate_command(tmp_path, "--runs", 20, "--steps", 60, "--json", gains=gains)
    assert json.loads(capsys.readouterr().out)["steady"] == steady
    simulate_command(tmp_path, "--runs", 20, "--steps", 60, gains=gains)
    assert f"steady     mean |z~|^2 = {steady:.6g} in the long run" in capsys.readouterr().out
    simulate_command(tmp_path, "--runs", 20, "--steps", 60, "--disturbance", "worst-case", "--json", gains=gains)
    assert json.loads(capsys.readouterr().out)["steady"] is None


def test_a_gamma_that_is_too_low_is_refuted_with_exit_code_1(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    gains, worst = case_of("sticky")
    low = claiming(gains, 0.8 * worst.gain)
    assert simulate_command(tmp_path, "--disturbance", "worst-case", gains=low) == 1
    assert f"REFUTED    gamma = {0.8 * worst.gain:.6g}: at step " in capsys.readouterr().out


def test_what_is_beyond_float64_is_null(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    K, H = link_gains(sticky(), 3.0 * np.tile(np.eye(2), (2, 1, 1)), np.full((2, 2, 2), 0.5))
    gains = uncertified(sticky(disturbance={"kind": "impulse"}), K, H, method="none")
    assert simulate_command(tmp_path, "--steps", 400, "--runs", 20, "--json", gains=gains) == 1
    facts = json.loads(capsys.readouterr().out)
    assert facts["peak"]["mean_square"] is None
    assert facts["claimed"] is False
    assert simulate_command(tmp_path, "--steps", 400, "--runs", 20, gains=gains) == 1
    assert "which the file does not claim" in capsys.readouterr().out


def test_a_problem_without_a_disturbance_has_nothing_to_refute(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert simulate_command(tmp_path, "--runs", 10, "--json", gains=observer_gains(sticky())) == 0
    facts = json.loads(capsys.readouterr().out)
    assert (facts["closest"], facts["gain"], facts["refuted"]) == (None, None, False)
    assert simulate_command(tmp_path, "--runs", 10, gains=observer_gains(sticky())) == 0
    assert "gamma allows for no error without one" in capsys.readouterr().out


def test_a_table_is_not_replaced_unasked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table = tmp_path / "steps.csv"
    table.write_text("mine")
    assert simulate_command(tmp_path, "--runs", 10, "-o", table, gains=observer_gains(sticky())) == 2
    assert "exists already" in capsys.readouterr().err
    assert table.read_text() == "mine"
    assert simulate_command(tmp_path, "--runs", 10, "-o", table, "--force", gains=observer_gains(sticky())) == 0
    assert table.read_text().startswith("step,mean_square,low,high,least,energy,bound\n0,0.0,0.0,")


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--runs", "1"], "peakmesh: runs is 1; an interval for the mean takes at least 2\n"),
        (
            ["--dask", "nowhere"],
            "peakmesh: no Dask scheduler answers at nowhere: missing port number in address 'nowhere'\n",
        ),
    ],
)
def test_bad_usage_is_refused_in_one_sentence(
    tmp_path: Path, arguments: list[str], sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert simulate_command(tmp_path, *arguments, gains=observer_gains(sticky())) == 2
    assert capsys.readouterr().err == sentence
